//! A recording -> one picture, array or document a map.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::{Args, ValueEnum};
use clearway_client::{Layer, MapView};

use super::recording::Recording;
use super::{document, npy, progress_bar};
use clearway_client::picture::{self, Style};

/// Export the maps of a recording, one file a map.
///
/// Files are named by the map's sequence in six digits: png and json `<sequence>_<layer>.<format>`; npy
/// `<sequence>_<layer>_<channel>.npy` (NumPy 1.0, shape (rows, columns)) and one `<sequence>_<layer>.json` with
/// geometry, pose, stamps and class legend. Pictures look from above: vehicle in the middle, forward up, left left.
#[derive(Args)]
pub struct Options {
    /// The MCAP file; one cut by a crash gives what it holds.
    recording: PathBuf,
    /// The layer, such as drivability.
    #[arg(long)]
    layer: String,
    #[arg(long, value_enum)]
    format: Format,
    /// The folder to write to; made if absent.
    #[arg(long)]
    out: PathBuf,
    /// The vehicle, where the recording has several.
    #[arg(long)]
    vehicle: Option<String>,
    #[command(flatten)]
    drawing: Drawing,
}

/// What a map is written as.
#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// A picture from above.
    Png,
    /// NumPy arrays, one a channel, and a document.
    Npy,
    /// One document, cells included.
    Json,
}

/// How pictures are drawn.
#[derive(Args)]
pub struct Drawing {
    /// Edge of a picture, pixels.
    #[arg(long, default_value_t = 800, value_parser = clap::value_parser!(u32).range(16..=8192))]
    pixels: u32,
    /// Show the ground this far around, metres; the whole grid unless given.
    #[arg(long, value_parser = metres)]
    range: Option<f64>,
    /// Draw a ring every so many metres.
    #[arg(long, value_name = "METRES", value_parser = metres)]
    rings: Option<f64>,
    /// Leave out the mark where the vehicle stands.
    #[arg(long)]
    no_vehicle: bool,
}

impl Drawing {
    /// As the painter takes it.
    pub fn style(&self) -> Style {
        let Self { pixels, range, rings, no_vehicle } = *self;
        Style { pixels, range_m: range, rings_m: rings, vehicle: !no_vehicle }
    }
}

fn metres(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|_| "not a number of metres".to_owned())?;
    if (0.1..=10_000.0).contains(&value) { Ok(value) } else { Err("0.1 to 10000 m is allowed".into()) }
}

/// Exports.
///
/// # Errors
/// What cannot be read or written; an unknown layer or vehicle, with those there are.
pub fn run(options: &Options) -> Result<()> {
    let Options { recording: file, layer, format, out, vehicle, .. } = options;
    let length = fs::metadata(file).with_context(|| format!("open {}", file.display()))?.len();
    let mut recording = Recording::open(file)?;
    let style = options.drawing.style();
    let progress = progress_bar(length);
    let mut maps = 0_u64;
    let mut only_vehicle: Option<String> = vehicle.clone();
    let mut vehicles = Vec::new();
    while let Some(message) = recording.next() {
        let message = message.with_context(|| file.display().to_string())?;
        progress.set_position(recording.bytes_read);
        let Some((of_vehicle, of_layer)) = message.map_of() else { continue };
        if !vehicles.iter().any(|known| known == of_vehicle) {
            vehicles.push(of_vehicle.to_owned());
        }
        if of_layer != layer {
            continue;
        }
        match &only_vehicle {
            None => only_vehicle = Some(of_vehicle.to_owned()),
            Some(only) if only == of_vehicle => {}
            Some(_) if vehicle.is_some() => continue,
            Some(only) => bail!("{} has maps of {only} and {of_vehicle}: name one with --vehicle", file.display()),
        }
        let map =
            MapView::decode(message.data.clone()).with_context(|| format!("{}, {}", file.display(), message.topic))?;
        if maps == 0 {
            fs::create_dir_all(out).with_context(|| format!("make the folder {}", out.display()))?;
        }
        write(&map, map.layer(layer)?, *format, &style, out)?;
        maps += 1;
        progress.set_message(format!("{maps} maps"));
    }
    progress.finish_and_clear();
    if let Some(cut) = &recording.cut {
        eprintln!("clearway: {} is {cut}; exported what it holds", file.display());
    }
    if maps == 0 {
        let layers = recording.layers();
        if layers.is_empty() {
            bail!("{} has no maps", file.display());
        }
        if !layers.contains(layer) {
            bail!("{} has no layer {layer:?}; it has {}", file.display(), layers.join(", "));
        }
        match vehicle {
            Some(name) if !vehicles.contains(name) => {
                bail!("{} has no vehicle {name:?} with maps; it has {}", file.display(), vehicles.join(", "))
            }
            _ => bail!("{} has layer {layer:?}, but no map in it", file.display()),
        }
    }
    println!("{maps} maps of {layer} in {}", out.display());
    Ok(())
}

/// Writes one map's files.
fn write(map: &MapView, layer: &Layer, format: Format, style: &Style, out: &Path) -> Result<()> {
    let stem = format!("{:06}_{}", map.sequence(), layer.name);
    let write = |name: String, bytes: Vec<u8>| {
        let path = out.join(name);
        fs::write(&path, bytes).with_context(|| format!("write {}", path.display()))
    };
    match format {
        Format::Png => write(format!("{stem}.png"), picture::png(layer, style)?),
        Format::Json => write(format!("{stem}.json"), serde_json::to_vec(&document::layer(map, layer, true))?),
        Format::Npy => {
            for channel in &layer.channels {
                write(format!("{stem}_{}.npy", channel.name), npy::encode(&channel.cells, layer.grid.shape()))?;
            }
            write(format!("{stem}.json"), serde_json::to_vec_pretty(&document::layer(map, layer, false))?)
        }
    }
}

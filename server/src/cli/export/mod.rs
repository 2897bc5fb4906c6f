//! `clearway export`: a recording -> a picture, arrays or a document for each map, or one MCAP file for viewers.
//!
//! | file | in -> out |
//! |---|---|
//! | `layer_json` | a layer -> JSON |
//! | `npy` | the cells of a channel -> a NumPy file |
//! | `scans` | the events of a recording -> the points of each scan |
//! | `viewer_file` | maps, points -> an MCAP file for viewers |

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::{Args, ValueEnum};
use clearway_client::{Channel, Layer, MapView};

use self::viewer_file::{Dialect, ViewerFile};
use super::output::{print_line, progress_bar};
use crate::encode::picture::{self, Style};
use crate::record::mcap_reader::{McapReader, Message};

pub mod layer_json;
pub mod npy;
mod scans;
mod viewer_file;

/// Export the maps of a recording: files for each map, or one MCAP file for viewers.
///
/// Names of the files begin with the map's sequence number in six digits. png and json write
/// `<sequence>_<layer>.<format>`; npy writes `<sequence>_<layer>_<channel>.npy` (NumPy 1.0, shape (rows, columns)) and
/// `<sequence>_<layer>.json` with geometry, pose, stamps and class legend. Pictures show the map from above, with the
/// vehicle in the middle, forward up and left on the left.
///
/// foxglove and ros2 write one new MCAP file with every layer of every vehicle and the sensors' points: foxglove has
/// coloured grids and transforms, ros2 has occupancy grids (0 free, 100 occupied, -1 unknown), tf and odometry.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway export drive.mcap --layer drivability --format png --out maps
  clearway export drive.mcap --format foxglove --out drive.foxglove.mcap")]
pub struct Options {
    /// The recording (MCAP); a file that is cut off is exported as far as it goes.
    recording: PathBuf,
    /// The layer, such as drivability; for foxglove and ros2 all layers if absent.
    #[arg(long, required_if_eq_any([("format", "png"), ("format", "npy"), ("format", "json")]))]
    layer: Option<String>,
    /// Format of the files.
    #[arg(long, value_enum)]
    format: Format,
    /// The folder to write to, which is created if needed; for foxglove and ros2 the new file.
    #[arg(long)]
    out: PathBuf,
    /// The vehicle, if the recording has several.
    #[arg(long)]
    vehicle: Option<String>,
    /// For foxglove and ros2: leave out the sensors' points, which are most of the file.
    #[arg(long)]
    no_points: bool,
    #[command(flatten)]
    drawing: DrawingOptions,
}

/// Format in which maps are written.
#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// A picture from above.
    Png,
    /// NumPy arrays, one for each channel, and a JSON document.
    Npy,
    /// A JSON document with the cells.
    Json,
    /// One MCAP file with Foxglove's messages.
    Foxglove,
    /// One MCAP file with ROS 2 messages.
    Ros2,
}

/// Encodes one layer as files: the end of each file's name, and its bytes.
type Encoder = fn(&MapView, &Layer, &Style) -> Result<Vec<(String, Vec<u8>)>>;

/// Destination of the maps.
enum Output {
    Files(Encoder),
    Viewer(Box<ViewerFile>),
}

impl Output {
    fn new(options: &Options) -> Result<Self> {
        let viewer = |dialect| ViewerFile::create(&options.out, dialect, !options.no_points).map(Box::new);
        Ok(match options.format {
            Format::Png => Self::Files(png),
            Format::Npy => Self::Files(npy),
            Format::Json => Self::Files(json),
            Format::Foxglove => Self::Viewer(viewer(Dialect::Foxglove)?),
            Format::Ros2 => Self::Viewer(viewer(Dialect::Ros2)?),
        })
    }
}

/// The options for drawing pictures.
#[derive(Args)]
pub struct DrawingOptions {
    /// Edge of a picture, in pixels.
    #[arg(long, default_value_t = 800, value_parser = clap::value_parser!(u32).range(16..=8192))]
    pixels: u32,
    /// Distance from the vehicle to the picture's edge, in metres; the whole grid if absent.
    #[arg(long, value_parser = metres)]
    range: Option<f64>,
    /// Draw a ring at each multiple of this distance from the vehicle.
    #[arg(long, value_name = "METRES", value_parser = metres)]
    rings: Option<f64>,
    /// Leave out the vehicle.
    #[arg(long)]
    no_vehicle: bool,
}

impl DrawingOptions {
    /// The style of these options.
    pub fn style(&self) -> Style {
        let Self { pixels, range, rings, no_vehicle } = *self;
        Style { pixels, range_m: range, rings_m: rings, vehicle: !no_vehicle }
    }
}

fn metres(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|_| "not a number of metres".to_owned())?;
    if (0.1..=10_000.0).contains(&value) { Ok(value) } else { Err("0.1 to 10000 m is allowed".into()) }
}

/// Exports the maps of the recording.
///
/// # Errors
/// If a file cannot be read or written; for an unknown layer or vehicle with the names of those in the recording.
pub fn run(options: &Options) -> Result<()> {
    let Options { recording: file, layer, out, vehicle, .. } = options;
    let length = fs::metadata(file).with_context(|| format!("open {}", file.display()))?.len();
    let mut recording = McapReader::salvage(file)?;
    let mut output = Output::new(options)?;
    let style = options.drawing.style();
    let progress = progress_bar(length);
    let mut maps = 0_u64;
    let mut vehicles: Vec<String> = Vec::new();
    while let Some(message) = recording.next() {
        let message = message?;
        progress.set_position(recording.bytes_read());
        let Some(of_vehicle) = message.vehicle() else { continue };
        if vehicle.as_ref().is_some_and(|only| only != of_vehicle) {
            continue;
        }
        if let Output::Viewer(viewer) = &mut output {
            viewer.write_event(&message, recording.header())?;
        }
        let Some((_, of_layer)) = message.map_of() else { continue };
        if layer.as_ref().is_some_and(|only| only != of_layer) {
            continue;
        }
        if !vehicles.iter().any(|known| known == of_vehicle) {
            vehicles.push(of_vehicle.to_owned());
        }
        let map = decode(&message, file)?;
        let of_layer = map.layer(of_layer)?;
        match &mut output {
            Output::Viewer(viewer) => viewer.write_map(&map, of_layer, message.log_ns)?,
            Output::Files(_) if vehicles.len() > 1 => {
                bail!("{} has maps of {}: name one with --vehicle", file.display(), vehicles.join(" and "))
            }
            Output::Files(files) => {
                if maps == 0 {
                    fs::create_dir_all(out).with_context(|| format!("create the folder {}", out.display()))?;
                }
                write(&format!("{:06}_{}", map.sequence(), of_layer.name), files(&map, of_layer, &style)?, out)?;
            }
        }
        maps += 1;
        progress.set_message(format!("{maps} maps"));
    }
    progress.finish_and_clear();
    if let Output::Viewer(viewer) = output {
        viewer.finish().with_context(|| format!("write {}", out.display()))?;
    }
    if let Some(cut) = recording.incomplete() {
        eprintln!("clearway: {} is {cut}; the maps before that are exported", file.display());
    }
    if maps == 0 {
        bail!("{}", nothing_exported(file, &recording, layer.as_deref(), vehicle.as_deref()));
    }
    print_line(&format!("{maps} maps of {} in {}", layer.as_deref().unwrap_or("all layers"), out.display()))?;
    Ok(())
}

fn decode(message: &Message, file: &Path) -> Result<MapView> {
    MapView::decode(message.data.clone()).with_context(|| format!("{}, {}", file.display(), message.channel.topic))
}

/// The reason why there was no map to export.
fn nothing_exported(file: &Path, recording: &McapReader, layer: Option<&str>, vehicle: Option<&str>) -> String {
    let (file, layers, vehicles) = (file.display(), recording.layers(), recording.vehicles());
    let absent = |name: Option<&str>, known: &[String]| {
        name.filter(|name| !known.iter().any(|known| known == name)).map(str::to_owned)
    };
    if layers.is_empty() {
        return format!("{file} has no maps");
    }
    if let Some(name) = absent(layer, &layers) {
        return format!("{file} has no layer {name:?}; it has {}", layers.join(", "));
    }
    match absent(vehicle, &vehicles) {
        Some(name) => format!("{file} has no vehicle {name:?} with maps; it has {}", vehicles.join(", ")),
        None => format!("{file} has no map of this layer and vehicle"),
    }
}

/// Writes the files of one layer to the folder `out`; `stem` is the beginning of their names.
fn write(stem: &str, files: Vec<(String, Vec<u8>)>, out: &Path) -> Result<()> {
    files.into_iter().try_for_each(|(ending, bytes)| {
        let path = out.join(format!("{stem}{ending}"));
        fs::write(&path, bytes).with_context(|| format!("write {}", path.display()))
    })
}

fn png(_: &MapView, layer: &Layer, style: &Style) -> Result<Vec<(String, Vec<u8>)>> {
    Ok(vec![(".png".into(), picture::png(layer, style)?)])
}

fn json(map: &MapView, layer: &Layer, _: &Style) -> Result<Vec<(String, Vec<u8>)>> {
    Ok(vec![(".json".into(), serde_json::to_vec(&layer_json::layer(map, layer, true))?)])
}

fn npy(map: &MapView, layer: &Layer, _: &Style) -> Result<Vec<(String, Vec<u8>)>> {
    let array = |channel: &Channel| (format!("_{}.npy", channel.name), npy::encode(&channel.cells, layer.grid.shape()));
    let document = serde_json::to_vec_pretty(&layer_json::layer(map, layer, false))?;
    Ok(layer.channels.iter().map(array).chain([(".json".into(), document)]).collect())
}

//! `clearway export`: a recording -> pictures, arrays or documents for each map, or one MCAP file for viewers.
//!
//! | file | in -> out |
//! |---|---|
//! | `drawing` | options -> the style of pictures |
//! | `gif` | the maps of a layer -> one GIF |
//! | `layer_json` | a layer -> JSON |
//! | `npy` | the cells of a channel -> a NumPy file |
//! | `sheet` | the maps of a layer -> one picture of many |
//! | `scans` | the events of a recording -> the points of each scan |
//! | `viewer_file` | maps, points -> an MCAP file for viewers |

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::{Args, ValueEnum};
use clearway_client::{Channel, Layer, MapView};

use self::gif::Gif;
use self::sheet::Sheet;
use self::viewer_file::{Dialect, ViewerFile};
use crate::cli::shared::exit::Exit;
use crate::cli::shared::files;
use crate::cli::shared::output::{counted, print_line, progress_bar, usage_error};
use clearway_daemon::encode::picture::{self, Style};
use clearway_journal::mcap_reader::{McapReader, Message};
pub use drawing::DrawingOptions;

mod drawing;
mod gif;
pub mod layer_json;
pub mod npy;
mod scans;
mod sheet;
mod viewer_file;

/// Export the maps of a recording: files for each map, or one MCAP file for viewers.
///
/// Names of the files begin with the map's sequence number in six digits, and contain the layer. png and json write
/// `<sequence>_<layer>.<format>`, png with --channel `<sequence>_<layer>_<channel>.png`; npy writes
/// `<sequence>_<layer>_<channel>.npy` (NumPy 1.0, shape (rows, columns)) and `<sequence>_<layer>.json` with geometry,
/// pose, stamps and class legend; sheet writes `sheet_<layer>.png`, gif `drive_<layer>.gif`, at
/// the speed of the drive. Pictures show the map from above, with
/// the vehicle in the middle, forward up and left
/// on the left, and under it the stamp, the sensors that are partial, the legend and a scale.
///
/// foxglove and ros2 write one new MCAP file with the layers of every vehicle and the sensors' points: foxglove has
/// coloured grids, scenes of the safe points and transforms, ros2 has occupancy grids (0 free, 100 occupied, -1
/// unknown), markers and poses of the safe points, tf and odometry.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway export drive.mcap --layer drivability --format png --out maps
  clearway export drive.mcap --layer terrain --channel roughness --format png --out maps
  clearway export drive.mcap --format png --rings 10 --out maps
  clearway export drive.mcap --layer drivability --format sheet --pixels 240 --out maps
  clearway export drive.mcap --layer speed --format gif --pixels 400 --out films
  clearway export drive.mcap --format foxglove --out drive.foxglove.mcap")]
pub struct Options {
    /// The recording (MCAP); a file that is cut off is exported as far as it goes.
    recording: PathBuf,
    /// Layers, such as drivability, separated by commas; all if absent. `clearway info` lists those of a recording.
    #[arg(long = "layer", alias = "layers", value_name = "LAYER", value_delimiter = ',')]
    layers: Vec<String>,
    /// Format of the files.
    #[arg(long, value_enum)]
    format: Format,
    /// The folder to write to, which is created if needed; for foxglove and ros2 the new file.
    #[arg(long, value_name = "PATH")]
    out: PathBuf,
    /// The vehicle; needed for png, npy and json if the recording has several.
    #[arg(long, value_name = "NAME")]
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
    /// Pictures from above.
    Png,
    /// One picture for each layer, with up to 24 maps of the drive side by side.
    Sheet,
    /// One film for each layer.
    Gif,
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
    /// By layer.
    Sheets(BTreeMap<String, Sheet>),
    /// By layer.
    Gifs(BTreeMap<String, Gif>),
    Viewer(Box<ViewerFile>),
}

impl Output {
    fn new(options: &Options) -> Result<Self> {
        let viewer = |dialect| ViewerFile::create(&options.out, dialect, !options.no_points).map(Box::new);
        Ok(match options.format {
            Format::Png => Self::Files(png),
            Format::Sheet => Self::Sheets(BTreeMap::new()),
            Format::Gif => Self::Gifs(BTreeMap::new()),
            Format::Npy => Self::Files(npy),
            Format::Json => Self::Files(json),
            Format::Foxglove => Self::Viewer(viewer(Dialect::Foxglove)?),
            Format::Ros2 => Self::Viewer(viewer(Dialect::Ros2)?),
        })
    }
}

/// Refuses options that the format does not use.
fn check(options: &Options) -> Result<()> {
    if let Some(option) =
        options.drawing.first_given().filter(|_| !matches!(options.format, Format::Png | Format::Sheet | Format::Gif))
    {
        return Err(usage_error(format!("{option} is for pictures: it needs --format png, sheet or gif")));
    }
    if options.no_points && !matches!(options.format, Format::Foxglove | Format::Ros2) {
        return Err(usage_error("--no-points needs --format foxglove or ros2; other formats have no points"));
    }
    Ok(())
}

/// Checks, before anything is written, that the recording has a map of each layer. The recording is read until all have
/// been seen, which is seldom far.
fn check_layers(options: &Options) -> Result<()> {
    let Options { recording: file, layers, vehicle, .. } = options;
    let mut recording = McapReader::open(file)?;
    let mut absent: Vec<&String> = layers.iter().collect();
    while let Some(name) = absent.first() {
        let Some(message) = recording.next() else {
            bail!("{}", nothing_exported(file, &recording, Some(name), vehicle.as_deref()));
        };
        let message = message?;
        if vehicle.as_ref().is_none_or(|only| message.vehicle() == Some(only))
            && let Some((_, layer)) = message.map_of()
        {
            absent.retain(|name| *name != layer);
        }
    }
    Ok(())
}

/// Exports the maps of the recording.
///
/// # Errors
/// If a file cannot be read or written; for an unknown layer or vehicle with the names of those in the recording.
pub fn run(options: &Options) -> Result<Exit> {
    check(options)?;
    let Options { recording: file, layers, out, vehicle, .. } = options;
    let (_, length) = files::open(file)?;
    check_layers(options)?;
    let style = options.drawing.style();
    let values = channel_values(options, &style)?;
    let mut recording = McapReader::open(file)?;
    let mut output = Output::new(options)?;
    let progress = progress_bar(length);
    // Number of maps, by layer.
    let mut maps: BTreeMap<String, u64> = BTreeMap::new();
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
        let Some((_, layer)) = message.map_of() else { continue };
        if !layers.is_empty() && !layers.iter().any(|name| name == layer) {
            continue;
        }
        let style = match &values {
            Some(of_layers) => match of_layers.get(layer) {
                Some(values) => Style { values: *values, ..style.clone() },
                None => continue,
            },
            None => style.clone(),
        };
        if !vehicles.iter().any(|known| known == of_vehicle) {
            vehicles.push(of_vehicle.to_owned());
        }
        let map = decode(&message, file)?;
        let of_layer = map.layer(layer)?;
        match &mut output {
            Output::Viewer(viewer) => viewer.write_map(&map, of_layer, message.log_ns)?,
            Output::Files(_) | Output::Sheets(_) | Output::Gifs(_) if vehicles.len() > 1 => {
                bail!("{} has maps of {}: name one with --vehicle", file.display(), vehicles.join(" and "))
            }
            Output::Sheets(sheets) => {
                let style = Style { caption: picture::caption(map.header(), layer), ..style };
                let sheet = sheets.entry(layer.to_owned()).or_default();
                sheet.push(|| picture::of_layer(of_layer, &style))?;
            }
            Output::Gifs(gifs) => {
                let style = Style { caption: picture::caption(map.header(), layer), ..style };
                let drawn = picture::of_layer(of_layer, &style)?;
                if !gifs.contains_key(layer) {
                    files::create_folder(out)?;
                    let name = format!("drive_{layer}{}", ending(&style, "gif"));
                    gifs.insert(layer.to_owned(), Gif::create(&out.join(name))?);
                }
                gifs.get_mut(layer).into_iter().try_for_each(|gif| gif.push(&drawn, map.header().capture_end_ns))?;
            }
            Output::Files(encode) => {
                let encoded = encode(&map, of_layer, &style)?;
                if maps.is_empty() {
                    files::create_folder(out)?;
                }
                write(&format!("{:06}_{layer}", map.sequence()), encoded, out)?;
            }
        }
        *maps.entry(layer.to_owned()).or_default() += 1;
        progress.set_message(counted(maps.values().sum(), "map"));
    }
    progress.finish_and_clear();
    // Number of maps on each sheet.
    let mut shown: BTreeMap<String, usize> = BTreeMap::new();
    match output {
        Output::Files(_) => {}
        Output::Gifs(gifs) => gifs.into_values().try_for_each(Gif::finish)?,
        Output::Viewer(viewer) => viewer.finish().with_context(|| format!("write {}", out.display()))?,
        Output::Sheets(sheets) => {
            files::create_folder(out)?;
            for (layer, sheet) in sheets {
                shown.insert(layer.clone(), sheet.shown());
                write(&format!("sheet_{layer}"), vec![(ending(&style, "png"), sheet.finish().to_png()?)], out)?;
            }
        }
    }
    let incomplete = recording.incomplete();
    if let Some(incomplete) = &incomplete {
        eprintln!("clearway: {} is not whole: {incomplete}; the maps of the rest are exported", file.display());
    }
    if maps.is_empty() {
        bail!("{}", nothing_exported(file, &recording, None, vehicle.as_deref()));
    }
    for (layer, maps) in &maps {
        let shown = shown.get(layer).map_or(String::new(), |shown| format!("{shown} of "));
        print_line(&format!("{shown}{} of {layer} in {}", counted(*maps, "map"), out.display()))?;
    }
    Ok(Exit::from_incomplete(incomplete.is_some()))
}

/// The least and the greatest value of the channel that is drawn in all maps, by layer that has it; `None` if classes
/// are drawn.
fn channel_values(options: &Options, style: &Style) -> Result<Option<BTreeMap<String, Option<[f64; 2]>>>> {
    let Some(channel) = &style.channel else { return Ok(None) };
    let Options { recording: file, layers, vehicle, .. } = options;
    let mut found: BTreeMap<String, Option<[f64; 2]>> = BTreeMap::new();
    let mut refused = None;
    for message in McapReader::open(file)? {
        let message = message?;
        let Some((_, layer)) = message.map_of() else { continue };
        let is_of_vehicle = vehicle.as_ref().is_none_or(|only| message.vehicle() == Some(only));
        if !is_of_vehicle || !layers.is_empty() && !layers.iter().any(|name| name == layer) {
            continue;
        }
        match picture::values(decode(&message, file)?.layer(layer)?, channel) {
            Ok(values) => {
                let known = found.entry(layer.to_owned()).or_default();
                *known = match (*known, values) {
                    (Some(a), Some(b)) => Some([a[0].min(b[0]), a[1].max(b[1])]),
                    (a, b) => a.or(b),
                };
            }
            Err(error) if layers.is_empty() => refused = Some(error),
            Err(error) => return Err(error.into()),
        }
    }
    match refused {
        Some(error) if found.is_empty() => Err(error).context(format!("no layer has the channel {channel:?}")),
        _ => Ok(Some(found)),
    }
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
        return format!("{file} has no maps; if it has events, `clearway replay {file} --record NEW.mcap` makes them");
    }
    if let Some(name) = absent(layer, &layers) {
        return format!("{file} has no layer {name:?}; it has {}", layers.join(", "));
    }
    match absent(vehicle, &vehicles) {
        Some(name) => format!("{file} has no vehicle {name:?} with maps; it has {}", vehicles.join(", ")),
        None => format!("{file} has no map of the layer {} of this vehicle", layer.unwrap_or("(any)")),
    }
}

/// Writes the files of one layer to the folder `out`; `stem` is the beginning of their names.
fn write(stem: &str, encoded: Vec<(String, Vec<u8>)>, out: &Path) -> Result<()> {
    encoded.into_iter().try_for_each(|(ending, bytes)| {
        let path = out.join(format!("{stem}{ending}"));
        files::write_new(&path, &bytes)
    })
}

fn png(map: &MapView, layer: &Layer, style: &Style) -> Result<Vec<(String, Vec<u8>)>> {
    let style = Style { caption: picture::caption(map.header(), &layer.name), ..style.clone() };
    Ok(vec![(ending(&style, "png"), picture::png(layer, &style)?)])
}

/// The end of the name of a picture: it names the channel if the style does.
fn ending(style: &Style, extension: &str) -> String {
    style.channel.as_ref().map_or(format!(".{extension}"), |channel| format!("_{channel}.{extension}"))
}

fn json(map: &MapView, layer: &Layer, _: &Style) -> Result<Vec<(String, Vec<u8>)>> {
    Ok(vec![(".json".into(), serde_json::to_vec(&layer_json::layer(map, layer, true))?)])
}

fn npy(map: &MapView, layer: &Layer, _: &Style) -> Result<Vec<(String, Vec<u8>)>> {
    let array = |channel: &Channel| (format!("_{}.npy", channel.name), npy::encode(&channel.cells, layer.grid.shape()));
    let document = serde_json::to_vec_pretty(&layer_json::layer(map, layer, false))?;
    Ok(layer.channels.iter().map(array).chain([(".json".into(), document)]).collect())
}

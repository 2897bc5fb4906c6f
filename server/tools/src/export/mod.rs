//! A recording -> pictures, arrays or documents for each map, or one MCAP file for viewers.
//!
//! | file | in -> out |
//! |---|---|
//! | [`layer_json`] | a layer -> JSON |
//! | [`npy`] | the cells of a channel -> a NumPy file |
//! | `plans` | the events of a recording -> the plans of the vehicle's planners |
//! | `scans` | the events of a recording -> the points of each scan |
//! | `viewer_file` | maps, points -> an MCAP file for viewers |

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::ValueEnum;
use clearway_client::{Layer, MapView, v1};
use clearway_daemon::base::files;
use clearway_journal::mcap_reader::{McapReader, Message};
use clearway_proto::plan;

use self::plans::plan_of;
use self::viewer_file::{Dialect, ViewerFile};
use crate::picture::{self, PictureStyle};

pub mod layer_json;
pub mod npy;
mod plans;
mod scans;
mod viewer_file;

/// Options of an export: recording, layers, format and target.
#[derive(Clone, Debug)]
pub struct ExportOptions {
    /// Path of the recording, an MCAP file.
    pub recording: PathBuf,
    /// Names of the layers; all if empty.
    pub layers: Vec<String>,
    /// Format of the files.
    pub format: ExportFormat,
    /// The folder to write to, which is created if needed; for foxglove and ros2 the new file.
    pub out: PathBuf,
    /// The vehicle; needed for png, npy and json if the recording has several.
    pub vehicle: Option<String>,
    /// True if files for viewers have the sensors' points.
    pub with_points: bool,
    /// How pictures are drawn.
    pub style: PictureStyle,
}

/// Format in which maps are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ExportFormat {
    /// Pictures from above.
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

/// Counts of what was exported.
#[derive(Clone, Debug, Default)]
pub struct Exported {
    /// Number of maps, by layer.
    pub maps: BTreeMap<String, u64>,
    /// Why the recording is not whole; `None` if it is.
    pub incomplete: Option<String>,
}

impl ExportOptions {
    /// The layer and the name of its vehicle, if a message is a map that is exported.
    fn map_of<'a>(&self, message: &'a Message) -> Option<(&'a str, &'a str)> {
        let (vehicle, (_, layer)) = (message.vehicle()?, message.map_of()?);
        let is_wanted = self.vehicle.as_ref().is_none_or(|only| only == vehicle)
            && (self.layers.is_empty() || self.layers.iter().any(|name| name == layer));
        is_wanted.then_some((vehicle, layer))
    }

    fn decode(&self, message: &Message) -> Result<MapView> {
        let place = || format!("{}, {}", self.recording.display(), message.channel.topic);
        MapView::decode(message.data.clone()).with_context(place)
    }

    /// Checks, before anything is written, that the recording has a map of each layer. The recording is read until all
    /// have been seen, which is seldom far.
    fn check_layers(&self) -> Result<()> {
        let mut recording = McapReader::open(&self.recording)?;
        let mut absent: BTreeSet<&str> = self.layers.iter().map(String::as_str).collect();
        while let Some(name) = absent.first() {
            let Some(message) = recording.next() else { bail!("{}", self.nothing(&recording, Some(name))) };
            if let Some((_, layer)) = self.map_of(&message?) {
                absent.remove(layer);
            }
        }
        Ok(())
    }

    /// The style of the pictures of each layer that has the channel; `None` if classes are drawn. A channel's colours
    /// have the same values in all pictures of a layer: its least and its greatest value in all maps.
    fn channel_styles(&self) -> Result<Option<BTreeMap<String, PictureStyle>>> {
        let Some(channel) = self.style.channel.as_ref().filter(|_| self.format == ExportFormat::Png) else {
            return Ok(None);
        };
        let (mut styles, mut refused) = (BTreeMap::new(), None);
        for message in McapReader::open(&self.recording)? {
            let message = message?;
            let Some((_, layer)) = self.map_of(&message) else { continue };
            match picture::values(self.decode(&message)?.layer(layer)?, channel) {
                Ok(values) => {
                    let style: &mut PictureStyle = styles.entry(layer.to_owned()).or_insert_with(|| self.style.clone());
                    style.values = match (style.values, values) {
                        (Some(a), Some(b)) => Some([a[0].min(b[0]), a[1].max(b[1])]),
                        (a, b) => a.or(b),
                    };
                }
                Err(error) if self.layers.is_empty() => refused = Some(error),
                Err(error) => return Err(error),
            }
        }
        match refused {
            Some(error) if styles.is_empty() => Err(error).context(format!("no layer has the channel {channel:?}")),
            _ => Ok(Some(styles)),
        }
    }

    /// The reason why there was no map to export.
    fn nothing(&self, recording: &McapReader, layer: Option<&str>) -> String {
        let (file, layers, vehicles) = (self.recording.display(), recording.layers(), recording.vehicles());
        let absent = |name: Option<&str>, known: &[String]| {
            name.filter(|name| !known.iter().any(|known| known == name)).map(str::to_owned)
        };
        if layers.is_empty() {
            return format!(
                "{file} has no maps; if it has events, `clearway replay {file} --record NEW.mcap` makes them"
            );
        }
        if let Some(name) = absent(layer, &layers) {
            return format!("{file} has no layer {name:?}; it has {}", layers.join(", "));
        }
        match absent(self.vehicle.as_deref(), &vehicles) {
            Some(name) => format!("{file} has no vehicle {name:?} with maps; it has {}", vehicles.join(", ")),
            None => format!("{file} has no map of the layer {} of this vehicle", layer.unwrap_or("(any)")),
        }
    }

    /// The files of one layer of a map: the end of each file's name, and its bytes.
    fn encode(
        &self,
        map: &MapView,
        layer: &Layer,
        style: &PictureStyle,
        plan: Option<&v1::Plan>,
    ) -> Result<Vec<(String, Vec<u8>)>> {
        match self.format {
            ExportFormat::Json => Ok(vec![(".json".into(), serde_json::to_vec(&layer_json::layer(map, layer, true))?)]),
            ExportFormat::Npy => {
                let arrays = layer
                    .channels
                    .iter()
                    .map(|channel| (format!("_{}.npy", channel.name), npy::encode(&channel.cells, layer.grid.shape())));
                let document = serde_json::to_vec_pretty(&layer_json::layer(map, layer, false))?;
                Ok(arrays.chain([(".json".into(), document)]).collect())
            }
            _ => {
                let header = map.header();
                let plan = plan.and_then(|of| plan::over(of, header.capture_end_ns, header.map_from_ego.as_ref()));
                let style = PictureStyle { plan, ..style.clone() };
                let ending = style.channel.as_ref().map_or(".png".into(), |channel| format!("_{channel}.png"));
                Ok(vec![(ending, picture::png(header, layer, &style)?)])
            }
        }
    }
}

/// Exports the maps of a recording. `progress` is called with the bytes read and the number of maps exported.
///
/// # Errors
/// If a file cannot be read or written; for an unknown layer or vehicle, with the names in the recording.
pub fn export(options: &ExportOptions, mut progress: impl FnMut(u64, u64)) -> Result<Exported> {
    let ExportOptions { recording: file, out, .. } = options;
    files::open(file)?;
    options.check_layers()?;
    let styles = options.channel_styles()?;
    let mut recording = McapReader::open(file)?;
    let create = |dialect| ViewerFile::create(out, dialect, options.with_points, recording.header());
    let mut viewer = match options.format {
        ExportFormat::Foxglove => Some(create(Dialect::Foxglove)?),
        ExportFormat::Ros2 => Some(create(Dialect::Ros2)?),
        _ => None,
    };
    let (mut exported, mut vehicles, mut plans) = (Exported::default(), BTreeSet::new(), BTreeMap::new());
    while let Some(message) = recording.next() {
        let message = message?;
        progress(recording.bytes_read(), exported.maps.values().sum());
        let is_of_vehicle = options.vehicle.as_ref().is_none_or(|only| message.vehicle() == Some(only));
        if let Some(viewer) = viewer.as_mut().filter(|_| is_of_vehicle) {
            viewer.write_event(&message, recording.header())?;
        } else if let Some(plan) = plan_of(&message) {
            plans.insert(message.journal_of().map(str::to_owned), plan);
        }
        let Some((vehicle, name)) = options.map_of(&message) else { continue };
        let Some(style) = styles.as_ref().map_or(Some(&options.style), |styles| styles.get(name)) else { continue };
        vehicles.insert(vehicle.to_owned());
        let map = options.decode(&message)?;
        let layer = map.layer(name)?;
        match &mut viewer {
            Some(viewer) => viewer.write_map(&map, layer, message.log_ns)?,
            None if vehicles.len() > 1 => {
                let names: Vec<String> = vehicles.into_iter().collect();
                bail!("{} has maps of {}: name one with --vehicle", file.display(), names.join(" and "))
            }
            None => write_files(
                &format!("{:06}_{name}", map.sequence()),
                options.encode(&map, layer, style, plans.get(&Some(vehicle.to_owned())))?,
                out,
            )?,
        }
        *exported.maps.entry(name.to_owned()).or_default() += 1;
    }
    if let Some(viewer) = viewer {
        viewer.finish().with_context(|| format!("write {}", out.display()))?;
    }
    if exported.maps.is_empty() {
        bail!("{}", options.nothing(&recording, None));
    }
    Ok(Exported { incomplete: recording.incomplete(), ..exported })
}

/// Writes the files of one layer to the folder `out`; `stem` is the beginning of their names.
fn write_files(stem: &str, encoded: Vec<(String, Vec<u8>)>, out: &Path) -> Result<()> {
    files::create_folder(out)?;
    encoded.into_iter().try_for_each(|(ending, bytes)| files::write_new(&out.join(format!("{stem}{ending}")), &bytes))
}

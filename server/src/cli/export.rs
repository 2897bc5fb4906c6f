//! `clearway export`: a recording -> pictures, arrays or documents for each map, or one MCAP file for viewers.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use clearway_tools::export::{ExportFormat, ExportOptions, Exported, export};

use crate::arguments::pictures::PictureOptions;
use crate::terminal::{Exit, counted, print_line, progress_bar, usage_error};
use clearway_daemon::base::files;

/// Export the maps of a recording: files for each map, or one MCAP file for viewers.
///
/// Names of the files begin with the map's sequence number in six digits, and contain the layer. png and json write
/// `<sequence>_<layer>.<format>`, png with --channel `<sequence>_<layer>_<channel>.png`; npy writes
/// `<sequence>_<layer>_<channel>.npy` (NumPy 1.0, shape (rows, columns)) and `<sequence>_<layer>.json` with geometry,
/// pose, stamps and class legend. Pictures show the map from above, with the vehicle in the middle, forward up and left
/// on the left, and under it the stamp, the sensors that are partial, the legend and a scale.
///
/// foxglove and ros2 write one new MCAP file with the layers of every vehicle and the sensors' points: foxglove has
/// coloured grids, scenes of the safe points and transforms, ros2 has occupancy grids (0 to 50 free, 100 occupied, -1
/// unknown), clouds of obstacles and ground, markers and poses of the safe points, tf and odometry.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway export drive.mcap --layer freespace --format png --out maps
  clearway export drive.mcap --layer terrain --channel roughness --format png --out maps
  clearway export drive.mcap --format foxglove --out drive.foxglove.mcap")]
pub struct ExportArguments {
    /// The recording (MCAP); a file that is cut off is exported as far as it goes.
    recording: PathBuf,
    /// Layers, such as freespace, separated by commas; all if absent. `clearway info` lists the layers.
    #[arg(long = "layer", alias = "layers", value_name = "LAYER", value_delimiter = ',')]
    layers: Vec<String>,
    /// Format of the files.
    #[arg(long, value_enum)]
    format: ExportFormat,
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
    pictures: PictureOptions,
}

/// Exports the maps and prints their numbers.
pub fn run(arguments: ExportArguments) -> Result<Exit> {
    let ExportArguments { recording, layers, format, out, vehicle, no_points, pictures } = arguments;
    if let Some(option) = pictures.first_given().filter(|_| format != ExportFormat::Png) {
        return Err(usage_error(format!("{option} is for pictures: it needs --format png")));
    }
    if no_points && !matches!(format, ExportFormat::Foxglove | ExportFormat::Ros2) {
        return Err(usage_error("--no-points needs --format foxglove or ros2; other formats have no points"));
    }
    let (_, length) = files::open(&recording)?;
    let style = pictures.style();
    let options = ExportOptions { recording, layers, format, out, vehicle, with_points: !no_points, style };
    let bar = progress_bar(length);
    let Exported { maps, incomplete } = export(&options, |bytes, maps| {
        bar.set_position(bytes);
        bar.set_message(counted(maps, "map"));
    })?;
    bar.finish_and_clear();
    if let Some(incomplete) = &incomplete {
        let file = options.recording.display();
        eprintln!("clearway: {file} is not whole: {incomplete}; the maps of the rest are exported");
    }
    for (layer, maps) in &maps {
        print_line(&format!("{} of {layer} in {}", counted(*maps, "map"), options.out.display()))?;
    }
    Ok(Exit::from_incomplete(incomplete.is_some()))
}

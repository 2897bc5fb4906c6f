//! `clearway get`: a server -> its newest map, printed or written to a file.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use clap::Args;
use clearway_client::{Layer, MapView, now_ns};
use clearway_tools::export::{layer_json, npy};
use clearway_tools::picture::{self, PictureStyle};
use serde_json::{Value, json};

use crate::arguments::pictures::PictureOptions;
use crate::connect::{ServerOptions, newest};
use crate::terminal::{Exit, age_text, print_line, usage_error};
use clearway_daemon::base::files;

/// Get the newest map: print one layer's classes and metrics, or write the layer to a file.
///
/// If the map is stale, the output and the picture say STALE, and the exit code is 4.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway get
  clearway get --wait
  clearway get --layer freespace --out newest.png
  clearway get --layer occupancy --out newest.npy
  clearway get --json")]
pub struct GetArguments {
    #[command(flatten)]
    server: ServerOptions,
    /// The vehicle, if the server has several.
    #[arg(long, value_name = "NAME", default_value = "", hide_default_value = true)]
    vehicle: String,
    /// The layer; the first of the map if absent.
    #[arg(long)]
    layer: Option<String>,
    /// Write the layer to this file, which is replaced if it exists: .png (a picture), .npy (the channel `class`, or
    /// the first), .json (everything).
    #[arg(long, value_name = "FILE.png|.npy|.json")]
    out: Option<PathBuf>,
    /// Wait for a fresh map, for at most this time (30 s if no time is given): the server may still start, or wait for
    /// its sensors.
    #[arg(long, value_name = "SECONDS", num_args = 0..=1, require_equals = true, default_missing_value = "30")]
    wait: Option<f64>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    drawing: PictureOptions,
}

/// Gets the newest map.
pub async fn run(options: &GetArguments) -> Result<Exit> {
    let format = options.out.as_deref().map(Format::from_name).transpose()?;
    if let Some(option) = options.drawing.first_given().filter(|_| format != Some(Format::Png)) {
        return Err(usage_error(format!("{option} is for pictures: it needs --out FILE.png")));
    }
    let GetArguments { layer, out, json, drawing, .. } = options;
    let map = newest(&options.server, &options.vehicle, layer.as_deref(), options.wait.unwrap_or_default()).await?;
    let layer = match layer {
        Some(name) => map.layer(name)?,
        None => map.layers().first().context("the map has no layer")?,
    };
    let Some((file, format)) = out.as_ref().zip(format) else {
        let now_ns = now_ns();
        let text = if *json { format!("{:#}", document(&map, layer, now_ns)) } else { text(&map, layer, now_ns) };
        print_line(&text)?;
        return Ok(Exit::from_stale(map.is_stale(now_ns)));
    };
    let (age_ms, stale) = (map.age_ms(now_ns()), map.is_stale(now_ns()));
    let bytes = match format {
        Format::Png => picture::png(map.header(), layer, &PictureStyle { stale, ..drawing.style() })?,
        Format::Npy => {
            let channel = layer.channel("class").or(layer.channels.first()).context("the layer has no channel")?;
            npy::encode(&channel.cells, layer.grid.shape())
        }
        Format::Json => serde_json::to_vec(&layer_json::layer(&map, layer, true))?,
    };
    files::write(file, &bytes)?;
    print_line(&if *json {
        json!({
            "vehicle": map.vehicle(), "sequence": map.sequence(), "layer": layer.name, "age_ms": age_ms, "stale": stale,
            "file": file,
        })
        .to_string()
    } else {
        let said = if stale { ", STALE" } else { "" };
        let age = age_text(age_ms);
        let (vehicle, sequence, name) = (map.vehicle(), map.sequence(), &layer.name);
        format!("{vehicle} #{sequence:06}: {name}, {age}{said}, written to {}", file.display())
    })?;
    Ok(Exit::from_stale(stale))
}

/// Format of the file.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Format {
    Png,
    Npy,
    Json,
}

impl Format {
    /// The format that the end of a file's name gives.
    fn from_name(file: &Path) -> Result<Self> {
        match file.extension().and_then(|extension| extension.to_str()).unwrap_or("") {
            "png" => Ok(Self::Png),
            "npy" => Ok(Self::Npy),
            "json" => Ok(Self::Json),
            other => Err(usage_error(format!(
                "--out {}: the name ends in {other:?}; .png, .npy and .json are allowed",
                file.display()
            ))),
        }
    }
}

/// The header, geometry, legend and metrics of one layer.
fn document(map: &MapView, layer: &Layer, now_ns: i64) -> Value {
    let mut document = layer_json::layer(map, layer, false);
    document["age_ms"] = map.age_ms(now_ns).into();
    document["stale"] = map.is_stale(now_ns).into();
    document
}

/// A line for the map as `watch` prints it, the share of each class, and the metrics.
fn text(map: &MapView, layer: &Layer, now_ns: i64) -> String {
    let stale = if map.is_stale(now_ns) { "  STALE" } else { "" };
    let (rows, columns) = layer.grid.shape();
    let mut lines = vec![
        format!("{} #{:06}  age {:7.1} ms{stale}", map.vehicle(), map.sequence(), map.age_ms(now_ns)),
        format!("layer {}: {rows} rows, {columns} columns", layer.name),
    ];
    if let Some(class) = layer.channel("class") {
        let cells = class.cells.len();
        for (number, entry) in layer.legend.iter().enumerate() {
            let count = (0..cells).filter(|&cell| class.cells.get(cell) == i32::try_from(number).ok()).count();
            lines.push(format!(
                "  {:<18} {:5.1} % of the cells",
                entry.name,
                100.0 * count as f64 / cells.max(1) as f64
            ));
        }
    }
    lines.extend(layer.metrics.iter().map(|(name, value)| format!("  {name} {value}")));
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_end_of_a_name_gives_the_format() {
        let format = |name: &str| Format::from_name(Path::new(name));
        assert!(format("a.png").unwrap() == Format::Png && format("b.npy").unwrap() == Format::Npy);
        assert!(format("c.json").unwrap() == Format::Json);
        assert!(format("d.jpg").unwrap_err().to_string().contains(".png, .npy and .json are allowed"));
    }
}

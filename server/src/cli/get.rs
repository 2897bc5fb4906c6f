//! `clearway get`: a server -> its newest map, printed or written to a file.

use std::fs;
use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use clap::Args;
use clearway_client::now_ns;

use super::connection::{ServerOptions, explain};
use super::export::{DrawingOptions, layer_json, npy};
use super::output::{block_on, print_line};
use crate::encode::picture;

/// Get the newest map: print its header and metrics, or write one layer to a file.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway get
  clearway get --layer drivability --out newest.png --rings 10
  clearway get --layer occupancy --out newest.npy")]
pub struct Options {
    #[command(flatten)]
    server: ServerOptions,
    /// The vehicle, if the server has several.
    #[arg(long, default_value = "", hide_default_value = true)]
    vehicle: String,
    /// The layer; the first of the map if absent.
    #[arg(long)]
    layer: Option<String>,
    /// Write the layer to this file: .png (a picture), .npy (the channel `class`, or the first), .json (everything).
    #[arg(long, value_name = "FILE.png|.npy|.json")]
    out: Option<PathBuf>,
    #[command(flatten)]
    drawing: DrawingOptions,
}

/// Gets the newest map.
///
/// # Errors
/// [`ClientError`](clearway_client::ClientError) if the server refuses or does not answer; if the file cannot be
/// written.
pub fn run(options: &Options) -> Result<()> {
    block_on(get(options))
}

async fn get(options: &Options) -> Result<()> {
    let Options { server, vehicle, layer, out, drawing } = options;
    let extension = out.as_ref().map(|out| out.extension().and_then(|e| e.to_str()).unwrap_or("").to_owned());
    if let (Some(out), Some(extension)) = (out, &extension)
        && !matches!(extension.as_str(), "png" | "npy" | "json")
    {
        bail!("--out {}: the name ends in {extension:?}; .png, .npy and .json are allowed", out.display());
    }
    let client = server.connect().await?;
    let layers: Vec<String> = layer.iter().cloned().collect();
    let map = client.newest(vehicle, &layers).await.map_err(explain)?;
    let layer = match layer {
        Some(name) => map.layer(name)?,
        None => map.layers().first().context("the map has no layer")?,
    };
    let Some(out) = out else {
        let mut document = layer_json::layer(&map, layer, false);
        document["age_ms"] = map.age_ms(now_ns()).into();
        document["stale"] = map.is_stale(now_ns()).into();
        print_line(&serde_json::to_string_pretty(&document)?)?;
        return Ok(());
    };
    let bytes = match extension.as_deref() {
        Some("png") => picture::png(layer, &drawing.style())?,
        Some("npy") => {
            let channel = layer.channel("class").or(layer.channels.first()).context("the layer has no channel")?;
            npy::encode(&channel.cells, layer.grid.shape())
        }
        _ => serde_json::to_vec(&layer_json::layer(&map, layer, true))?,
    };
    fs::write(out, bytes).with_context(|| format!("write {}", out.display()))?;
    let age = map.age_ms(now_ns());
    print_line(&format!(
        "{} #{:06}: {}, {age:.0} ms old, written to {}",
        map.vehicle(),
        map.sequence(),
        layer.name,
        out.display()
    ))?;
    Ok(())
}

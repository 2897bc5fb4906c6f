//! The newest map, printed or written to a file.

use std::fs;
use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use clap::Args;
use clearway_client::now_ns;

use super::export::Drawing;
use super::{Server, document, npy, say};
use crate::encode::picture;

/// Get the newest map: its figures, or with --out one layer as a file.
#[derive(Args)]
pub struct Options {
    #[command(flatten)]
    server: Server,
    /// The vehicle, where the server has several.
    #[arg(long, default_value = "")]
    vehicle: String,
    /// The layer; the server's first unless given.
    #[arg(long)]
    layer: Option<String>,
    /// Write the layer here: .png (a picture), .npy (channel `class`, or the first), .json (all of it).
    #[arg(long, value_name = "FILE.png|.npy|.json")]
    out: Option<PathBuf>,
    #[command(flatten)]
    drawing: Drawing,
}

/// Gets.
///
/// # Errors
/// What the server says, or what cannot be written.
pub async fn run(options: Options) -> Result<()> {
    let Options { server, vehicle, layer, out, drawing } = options;
    let extension = out.as_ref().map(|out| out.extension().and_then(|e| e.to_str()).unwrap_or("").to_owned());
    if let (Some(out), Some(extension)) = (&out, &extension)
        && !matches!(extension.as_str(), "png" | "npy" | "json")
    {
        bail!("--out {}: the name ends in {extension:?}; .png, .npy and .json are allowed", out.display());
    }
    let client = server.connect().await?;
    let layers: Vec<String> = layer.iter().cloned().collect();
    let map = client.newest(&vehicle, &layers).await?;
    let layer = match &layer {
        Some(name) => map.layer(name)?,
        None => map.layers().first().context("the map has no layer")?,
    };
    let Some(out) = out else {
        let mut document = document::layer(&map, layer, false);
        document["age_ms"] = map.age_ms(now_ns()).into();
        document["stale"] = map.is_stale(now_ns()).into();
        say(&serde_json::to_string_pretty(&document)?)?;
        return Ok(());
    };
    let bytes = match extension.as_deref() {
        Some("png") => picture::png(layer, &drawing.style())?,
        Some("npy") => {
            let channel = layer.channel("class").or(layer.channels.first()).context("the layer has no channel")?;
            npy::encode(&channel.cells, layer.grid.shape())
        }
        _ => serde_json::to_vec(&document::layer(&map, layer, true))?,
    };
    fs::write(&out, bytes).with_context(|| format!("write {}", out.display()))?;
    let age = map.age_ms(now_ns());
    say(&format!(
        "{} sequence {}, {}, age {age:.0} ms, in {}",
        map.vehicle(),
        map.sequence(),
        layer.name,
        out.display()
    ))?;
    Ok(())
}

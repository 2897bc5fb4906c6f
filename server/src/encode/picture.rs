//! One layer of a map -> a PNG: seen from above, the vehicle in the middle, forward up, left on the left.
//!
//! The picture rotates with the vehicle: up is ahead, not north. It shows the classes in the colours of the layer's
//! legend, or one channel: ids in one colour each, other values from dark to light. The PNG's text `Comment` names the
//! channel, its least and greatest value and its unit. Safe points of the layer are drawn as lines between linked
//! points, in a band as wide as their radii. A strip under the picture shows the legend of the classes or the colour
//! bar of the channel, a scale bar and which direction is up, unless the style leaves it out. The picture of a stale
//! map has a red frame and the word STALE.

mod canvas;
mod colours;
mod error;
mod safe_paths;
mod stale;

use clearway_proto::map::Layer;

use super::legend;
use canvas::Canvas;
pub(crate) use colours::Colours;
use colours::UNKNOWN;
pub use error::PictureError;

/// Colour of the rings.
const RING: [u8; 3] = [112, 116, 124];
/// Colour of the vehicle's mark.
const VEHICLE: [u8; 3] = [244, 244, 248];
/// Half the length and half the width of the vehicle's mark, in metres: those of a car.
const VEHICLE_HALF_M: (f64, f64) = (2.2, 0.9);

/// How a picture is drawn.
#[derive(Clone, Debug)]
pub struct Style {
    /// Edge of the map in the picture, in pixels.
    pub pixels: u32,
    /// Distance from the vehicle to the edge of the picture, in metres; `None` shows the whole grid.
    pub range_m: Option<f64>,
    /// Distance between two rings, in metres; `None` draws none.
    pub rings_m: Option<f64>,
    /// True if the vehicle is marked.
    pub vehicle: bool,
    /// Name of the channel; `None` shows the classes, or the first channel of a layer without classes.
    pub channel: Option<String>,
    /// True if the strip with the legend is under the map.
    pub legend: bool,
    /// True if the map is stale: the picture says so across the map.
    pub stale: bool,
}

/// Draws a layer and encodes the picture.
///
/// # Errors
/// [`PictureError::NoChannel`] if the style names a channel that the layer does not have, [`PictureError::Encoding`] if
/// the picture is larger than PNG allows.
pub fn png(layer: &Layer, style: &Style) -> Result<Vec<u8>, PictureError> {
    let colours = Colours::of(layer, style.channel.as_deref())?;
    let side = style.pixels as usize;
    let range_m = style.range_m.unwrap_or(layer.grid.range_m_max());
    let mut canvas = Canvas { side, range_m, rgb: vec![UNKNOWN; side * side] };
    for index in 0..side * side {
        let (x_m, y_m) = canvas.point(index);
        let on_ring = style.rings_m.is_some_and(|every| {
            let rings = x_m.hypot(y_m) / every;
            rings > 0.5 && (rings - rings.round()).abs() * every < 0.5 * canvas.pixel_m()
        });
        canvas.rgb[index] = if on_ring {
            RING
        } else {
            layer.grid.cell_at(x_m, y_m).map_or(UNKNOWN, |cell| colours.of_cell(layer, cell))
        };
    }
    safe_paths::draw(&mut canvas, &layer.points);
    if style.vehicle {
        for index in 0..side * side {
            let (x_m, y_m) = canvas.point(index);
            if x_m.abs() < VEHICLE_HALF_M.0 && y_m.abs() < VEHICLE_HALF_M.1 {
                canvas.rgb[index] = VEHICLE;
            }
        }
    }
    if style.stale {
        stale::draw(&mut canvas);
    }
    let metres = canvas.pixel_m();
    let (mut width, mut height, mut rgb) = (side, side, canvas.rgb);
    if style.legend {
        let strip = legend::strip(&colours.legend(layer), side, metres);
        // A strip that needs more width leaves a margin beside the map.
        let margin = vec![[0; 3]; strip.width - side];
        rgb = rgb.chunks(side).flat_map(|row| row.iter().chain(&margin)).copied().collect();
        rgb.extend(strip.rgb);
        (width, height) = (strip.width, side + strip.height);
    }
    let mut file = Vec::new();
    let mut encoder = png::Encoder::new(&mut file, width as u32, height as u32);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    if let Some(text) = colours.text(layer) {
        encoder.add_text_chunk("Comment".into(), text)?;
    }
    let mut writer = encoder.write_header()?;
    writer.write_image_data(rgb.as_flattened())?;
    writer.finish()?;
    Ok(file)
}

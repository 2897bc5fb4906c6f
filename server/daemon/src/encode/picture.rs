//! One layer of a map -> a PNG: seen from above, the vehicle in the middle, forward up, left on the left.
//!
//! The picture rotates with the vehicle: up is ahead, not north. It shows the classes in the colours of the layer's
//! legend, or one channel: ids in one colour each, other values from dark to light. The PNG's text `Comment` names the
//! channel, its least and greatest value and its unit. Safe points of the layer are drawn as lines between linked
//! points, in a band as wide as their radii. A strip under the picture shows the legend of the classes or the colour
//! bar of the channel, a scale bar and which direction is up, unless the style leaves it out. The picture of a stale
//! map has a red frame and the word STALE. [`of_change`] draws where two maps of one layer differ.

mod canvas;
pub mod change;
mod colours;
mod error;
mod image;
mod safe_paths;
mod stale;

use std::time::{Duration, UNIX_EPOCH};

use clearway_proto::map::{Layer, SafePoint};
use clearway_proto::v1;

use super::legend::{self, Legend};
use super::palette::Rgb;
use canvas::Canvas;
use clearway_journal::compare::change::Change;
pub(crate) use colours::Colours;
use colours::UNKNOWN;
pub use error::PictureError;
pub use image::Picture;

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
    /// Values of the first and the last colour of the channel; `None`: the least and the greatest of the layer.
    pub values: Option<[f64; 2]>,
    /// True if the strip with the legend is under the map.
    pub legend: bool,
    /// Lines of text over the legend, such as the stamp of the map; they need the strip.
    pub caption: Vec<String>,
    /// True if the map is stale: the picture says so across the map.
    pub stale: bool,
}

impl Default for Style {
    /// 800 pixels, ours, because that fits a screen; the whole grid, the classes, the vehicle and the legend.
    fn default() -> Self {
        Self {
            pixels: 800,
            range_m: None,
            rings_m: None,
            vehicle: true,
            channel: None,
            values: None,
            legend: true,
            caption: Vec::new(),
            stale: false,
        }
    }
}

/// Draws a layer and encodes the picture.
///
/// # Errors
/// As [`of_layer`] and [`Picture::to_png`].
pub fn png(layer: &Layer, style: &Style) -> Result<Vec<u8>, PictureError> {
    of_layer(layer, style)?.to_png()
}

/// Draws a layer.
///
/// # Errors
/// [`PictureError::NoChannel`] if the style names a channel that the layer does not have.
pub fn of_layer(layer: &Layer, style: &Style) -> Result<Picture, PictureError> {
    let colours = Colours::of(layer, style.channel.as_deref(), style.values)?;
    let range_m = style.range_m.unwrap_or(layer.grid.range_m_max());
    let colour_at = |x_m, y_m| layer.grid.cell_at(x_m, y_m).map_or(UNKNOWN, |cell| colours.of_cell(layer, cell));
    let picture = draw(range_m, style, &layer.points, &colours.legend(layer), colour_at);
    Ok(Picture { comment: colours.text(layer), ..picture })
}

/// The least and the greatest value of a channel of a layer; `None` if no cell has one, and for classes and ids.
///
/// # Errors
/// [`PictureError::NoChannel`] if the layer does not have it.
pub fn values(layer: &Layer, channel: &str) -> Result<Option<[f64; 2]>, PictureError> {
    Ok(match Colours::of(layer, Some(channel), None)? {
        Colours::Values(_, least, greatest) if least <= greatest => Some([least, greatest]),
        _ => None,
    })
}

/// The lines under a picture of a map: vehicle, layer, sequence and stamp; then the sensors that are not whole, with
/// `partial` and why, or their state.
pub fn caption(header: &v1::Header, layer: &str) -> Vec<String> {
    let end_ns = u64::try_from(header.capture_end_ns).unwrap_or(0);
    let stamp = humantime::format_rfc3339_millis(UNIX_EPOCH + Duration::from_nanos(end_ns));
    let mut lines = vec![format!("{} {layer} {} {stamp}", header.vehicle, header.sequence)];
    for sensor in &header.sensors {
        match (&*sensor.partial, &*sensor.state) {
            ("", "ok") => {}
            ("", state) => lines.push(format!("{}: {state}", sensor.name)),
            (partial, _) => lines.push(format!("{}: partial, {partial}", sensor.name)),
        }
    }
    lines
}

/// Draws where the classes of a layer differ from those of the same layer of another map, `before`.
pub fn of_change(before: &Layer, after: &Layer, style: &Style) -> Picture {
    let range_m = style.range_m.unwrap_or(after.grid.range_m_max());
    let colour = |x_m, y_m| change::colour(Change::at(before, after, x_m, y_m));
    draw(range_m, style, &[], &change::legend(), colour)
}

/// Draws `range_m` around the vehicle: the colour of each point of the ego frame, rings, safe points, the vehicle, and
/// the strip with the legend.
fn draw(
    range_m: f64,
    style: &Style,
    points: &[SafePoint],
    legend: &Legend,
    colour_at: impl Fn(f64, f64) -> Rgb,
) -> Picture {
    let side = style.pixels as usize;
    let mut canvas = Canvas { side, range_m, rgb: vec![UNKNOWN; side * side] };
    for index in 0..side * side {
        let (x_m, y_m) = canvas.point(index);
        let on_ring = style.rings_m.is_some_and(|every| {
            let rings = x_m.hypot(y_m) / every;
            rings > 0.5 && (rings - rings.round()).abs() * every < 0.5 * canvas.pixel_m()
        });
        canvas.rgb[index] = if on_ring { RING } else { colour_at(x_m, y_m) };
    }
    safe_paths::draw(&mut canvas, points);
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
    let mut picture = Picture { width: side, height: side, rgb: canvas.rgb, comment: None };
    if style.legend {
        let strip = legend::strip(&style.caption, legend, side, metres);
        // A strip that needs more width leaves a margin beside the map.
        picture = picture.widened(strip.width);
        picture.rgb.extend(strip.rgb);
        picture.height += strip.height;
    }
    picture
}

//! One layer of a map -> a PNG: seen from above, the vehicle in the middle, forward up, left on the left.
//!
//! The picture rotates with the vehicle: up is ahead, not north. It shows the classes in the colours of the layer's
//! legend, or one channel: ids in one colour each, other values from dark to light. Safe points of the layer are drawn
//! as lines between linked points, and circles with their radii; over them the path of a plan, its footprint at the
//! end, and its goal. Under the map stand the stamp, what the colours mean and a scale bar; the PNG's text `Comment`
//! has the channel, its least and greatest value and its unit. The picture of a stale map has a red frame and the word
//! STALE.
//!
//! | file | in -> out |
//! |---|---|
//! | [`image`] | pixels -> a PNG; text, rectangles and pictures in a picture |
//! | `legend` | a map, lines -> the picture with the lines and a scale bar under it |

pub mod image;
mod legend;

use std::time::{Duration, UNIX_EPOCH};

use anyhow::{Context, Result};
use clearway_daemon::viewer::colours::{Colours, UNKNOWN};
use clearway_daemon::viewer::palette::Rgb;
use clearway_daemon::viewer::safe_paths;
use clearway_proto::map::{Layer, SafePoint};
use clearway_proto::{plan, v1};

use image::{LETTER, Picture};
use legend::Swatch;

/// Colour of the vehicle's mark.
const VEHICLE: Rgb = [244, 244, 248];
/// Half the length and half the width of the vehicle's mark, in metres, as of a car.
const VEHICLE_HALF_M: (f64, f64) = (2.2, 0.9);
/// Colours of the links of safe points, and of the circles with their radii.
const LINK: Rgb = [255, 225, 77];
const CIRCLE: Rgb = [200, 200, 210];
/// Colour of a plan.
const PLAN: Rgb = [255, 79, 216];
/// Colour of the frame of a stale map and of the ground of its word.
const STALE: Rgb = [200, 24, 24];
/// Word on a stale map.
const STALE_WORD: &str = "STALE";

/// How a picture is drawn.
#[derive(Clone, Debug)]
pub struct PictureStyle {
    /// Edge of the map in the picture, in pixels.
    pub pixels: u32,
    /// Distance from the vehicle to the edge of the map, in metres.
    pub range_m: f64,
    /// Name of the channel; `None` shows the classes, or the first channel of a layer without classes.
    pub channel: Option<String>,
    /// Values of the first and the last colour of the channel; `None`: the least and the greatest of the layer.
    pub values: Option<[f64; 2]>,
    /// The plan that is drawn over the map, in the ego frame.
    pub plan: Option<v1::Plan>,
    /// True if the map is stale.
    pub stale: bool,
}

impl Default for PictureStyle {
    /// The classes in 800 pixels, which fit a screen, and 60 m by 60 m, in which a car is seen; both ours.
    fn default() -> Self {
        Self { pixels: 800, range_m: 30.0, channel: None, values: None, plan: None, stale: false }
    }
}

fn of_layer(header: &v1::Header, layer: &Layer, style: &PictureStyle) -> Result<Picture> {
    let mut colours = match &style.channel {
        Some(name) => of_channel(layer, name)?,
        None => Colours::of_layer(layer),
    };
    if let (Colours::Values { least, greatest, .. }, Some(values)) = (&mut colours, style.values) {
        [*least, *greatest] = values;
    }
    let comment = scale_text(&colours, layer);
    let mut lines: Vec<_> = caption(header, &layer.name).into_iter().map(|line| (Swatch::None, line)).collect();
    match (&colours, &comment) {
        (Colours::Classes(_, colours), _) => {
            let classes = layer.legend.iter().zip(colours);
            lines.extend(classes.map(|(class, colour)| (Swatch::Colour(*colour), class.name.clone())));
        }
        (Colours::Values { .. }, Some(text)) => lines.push((Swatch::Scale, text.clone())),
        (_, text) => lines.extend(text.iter().map(|text| (Swatch::None, text.clone()))),
    }
    let colour_at = |x_m, y_m| layer.grid.cell_at(x_m, y_m).map_or(UNKNOWN, |cell| colours.of_cell(layer, cell));
    Ok(Picture { comment, ..draw(style, &layer.points, lines, colour_at) })
}

/// Draws a layer of the map with this header, and encodes the picture.
///
/// # Errors
/// If the style names a channel that the layer does not have; as [`Picture::to_png`].
pub fn png(header: &v1::Header, layer: &Layer, style: &PictureStyle) -> Result<Vec<u8>> {
    of_layer(header, layer, style)?.to_png().context("encode the picture")
}

fn of_channel(layer: &Layer, channel: &str) -> Result<Colours> {
    Colours::of_channel(layer, channel).with_context(|| {
        let present = layer.channels.iter().map(|channel| &*channel.name).collect::<Vec<_>>().join(", ");
        format!("layer {} has no channel {channel:?}; it has {present}", layer.name)
    })
}

/// The least and the greatest value of a channel of a layer; `None` if no cell has one, and for classes and ids.
///
/// # Errors
/// If the layer does not have the channel.
pub fn values(layer: &Layer, channel: &str) -> Result<Option<[f64; 2]>> {
    Ok(match of_channel(layer, channel)? {
        Colours::Values { least, greatest, .. } if least <= greatest => Some([least, greatest]),
        _ => None,
    })
}

/// The channel that a picture shows, with the values of its first and last colour; `None` for classes.
fn scale_text(colours: &Colours, layer: &Layer) -> Option<String> {
    match *colours {
        Colours::Classes(..) | Colours::None => None,
        Colours::Ids(index) => Some(format!("{}: one colour for each id", layer.channels[index].name)),
        Colours::Values { index, least, greatest } => {
            let channel = &layer.channels[index];
            let (name, unit) =
                (&channel.name, if channel.unit.is_empty() { "" } else { &*format!(" {}", channel.unit) });
            // 0.01 in single precision is a little less than 0.01.
            let digits = (-f64::from(channel.scale).log10() - 1e-6).ceil().clamp(0.0, 6.0) as usize;
            Some(match least <= greatest {
                true => format!("{name}: dark {least:.digits$}{unit} to light {greatest:.digits$}{unit}"),
                false => format!("{name}: unknown in all cells"),
            })
        }
    }
}

/// The lines under a picture of a map: vehicle, layer, sequence and stamp; then the sensors that are not whole, with
/// `partial` and why, or their state.
fn caption(header: &v1::Header, layer: &str) -> Vec<String> {
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

/// Draws the colour of each point of the ego frame, safe points, the vehicle, the plan, and the lines under the map.
fn draw(
    style: &PictureStyle,
    points: &[SafePoint],
    mut lines: Vec<(Swatch, String)>,
    colour_at: impl Fn(f64, f64) -> Rgb,
) -> Picture {
    let (side, range_m) = (style.pixels as usize, style.range_m);
    let pixel_m = 2.0 * range_m / side as f64;
    let metres = |pixel: usize| range_m - (pixel as f64 + 0.5) * pixel_m;
    let mut map = Picture::new(side, side, UNKNOWN);
    for (index, pixel) in map.rgb.iter_mut().enumerate() {
        *pixel = colour_at(metres(index / side), metres(index % side));
    }
    // Column and row, from the upper left.
    let pixel = |x_m: f64, y_m: f64| [range_m - y_m, range_m - x_m].map(|m| m / pixel_m);
    for (strokes, colour, width) in [(safe_paths::circles(points), CIRCLE, 1), (safe_paths::links(points), LINK, 2)] {
        for ends in strokes.chunks_exact(2) {
            draw_line(&mut map, pixel(ends[0][0], ends[0][1]), pixel(ends[1][0], ends[1][1]), colour, width);
        }
    }
    for [from, to] in style.plan.iter().flat_map(plan::lines) {
        draw_line(&mut map, pixel(from[0], from[1]), pixel(to[0], to[1]), PLAN, 3);
    }
    let [left, top] = pixel(VEHICLE_HALF_M.0, VEHICLE_HALF_M.1).map(|pixel| pixel.max(0.0).round() as usize);
    let [width, height] = [VEHICLE_HALF_M.1, VEHICLE_HALF_M.0].map(|half| (2.0 * half / pixel_m).round() as usize);
    map.fill((left, top), (width, height), VEHICLE);
    if style.stale {
        mark_stale(&mut map);
    }
    lines.extend(style.plan.iter().map(|of| (Swatch::Colour(PLAN), format!("plan {} {}", of.planner, of.text))));
    legend::with_lines(&map, lines, pixel_m)
}

/// Draws a straight line; what lies outside the map is left out.
fn draw_line(map: &mut Picture, from: [f64; 2], to: [f64; 2], colour: Rgb, width: usize) {
    let (across, down) = (to[0] - from[0], to[1] - from[1]);
    let steps = across.abs().max(down.abs()).ceil().clamp(1.0, 4.0 * map.width as f64);
    for step in 0..=steps as u32 {
        let share = f64::from(step) / steps;
        let [x, y] = [from[0] + share * across, from[1] + share * down].map(|pixel| pixel - (width - 1) as f64 / 2.0);
        if x >= 0.0 && y >= 0.0 {
            map.fill((x as usize, y as usize), (width, width), colour);
        }
    }
}

/// Draws a red frame, and the word STALE at the upper edge, as large as a third of the map allows.
fn mark_stale(map: &mut Picture) {
    let side = map.width;
    let frame = (side / 100).max(1);
    for (corner, size) in [((0, 0), (side, frame)), ((0, 0), (frame, side))] {
        map.fill(corner, size, STALE);
        map.fill((side - size.0, side - size.1), size, STALE);
    }
    let dot = (side / 3 / (STALE_WORD.len() * LETTER)).max(1);
    let (width, height) = (STALE_WORD.len() * LETTER * dot, LETTER * dot);
    let left = side.saturating_sub(width) / 2;
    map.fill((left, 0), (width, height + dot), STALE);
    map.write((left, dot), dot, STALE_WORD, [255; 3]);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_word_and_the_frame_of_a_stale_map_are_drawn() {
        for side in [16, 93, 800] {
            let mut map = Picture::new(side, side, [0; 3]);
            mark_stale(&mut map);
            assert!([side * (side - 1), side * side - 1].iter().all(|&index| map.rgb[index] == STALE));
            assert!(map.rgb.contains(&[255; 3]), "{side}");
        }
    }
}

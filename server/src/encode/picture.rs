//! One layer of a map -> a PNG: seen from above, the vehicle in the middle, forward up, left on the left.
//!
//! The picture rotates with the vehicle: up is ahead, not north. Classes have the colours of the layer's legend; a
//! layer without classes is drawn from its first channel, dark to light.

use clearway_proto::legend::Class;
use clearway_proto::map::Layer;

/// Colour of the ground outside the grid, and of cells without a value: the colour of class `unknown` in every legend.
const UNKNOWN: [u8; 3] = [58, 63, 70];
/// Colour of the rings.
const RING: [u8; 3] = [112, 116, 124];
/// Colour of the vehicle's mark.
const VEHICLE: [u8; 3] = [244, 244, 248];
/// Half the length and half the width of the vehicle's mark, in metres: those of a car.
const VEHICLE_HALF_M: (f64, f64) = (2.2, 0.9);

/// How a picture is drawn.
#[derive(Clone, Copy, Debug)]
pub struct Style {
    /// Edge of the picture, in pixels.
    pub pixels: u32,
    /// Distance from the vehicle to the edge of the picture, in metres; `None` shows the whole grid.
    pub range_m: Option<f64>,
    /// Distance between two rings, in metres; `None` draws none.
    pub rings_m: Option<f64>,
    /// True if the vehicle is marked.
    pub vehicle: bool,
}

/// Draws a layer and encodes the picture.
///
/// # Errors
/// [`png::EncodingError`] if the picture is larger than PNG allows.
pub fn png(layer: &Layer, style: &Style) -> Result<Vec<u8>, png::EncodingError> {
    let pixels = style.pixels as usize;
    let mut rgb = vec![0; pixels * pixels * 3];
    let range_m = style.range_m.unwrap_or(layer.grid.range_m_max());
    let metres = 2.0 * range_m / pixels as f64;
    let colours = Colours::of(layer);
    for (index, pixel) in rgb.as_chunks_mut::<3>().0.iter_mut().enumerate() {
        let x_m = range_m - ((index / pixels) as f64 + 0.5) * metres;
        let y_m = range_m - ((index % pixels) as f64 + 0.5) * metres;
        let on_ring = style.rings_m.is_some_and(|every| {
            let rings = x_m.hypot(y_m) / every;
            rings > 0.5 && (rings - rings.round()).abs() * every < 0.5 * metres
        });
        *pixel = if style.vehicle && x_m.abs() < VEHICLE_HALF_M.0 && y_m.abs() < VEHICLE_HALF_M.1 {
            VEHICLE
        } else if on_ring {
            RING
        } else {
            layer.grid.cell_at(x_m, y_m).map_or(UNKNOWN, |cell| colours.of_cell(layer, cell))
        };
    }
    let mut file = Vec::new();
    let mut encoder = png::Encoder::new(&mut file, style.pixels, style.pixels);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(&rgb)?;
    writer.finish()?;
    Ok(file)
}

pub(crate) enum Colours {
    /// Index of the channel `class`, and the colours of the classes.
    Classes(usize, Vec<[u8; 3]>),
    /// Least and greatest known value of channel 0.
    Shades(f64, f64),
}

impl Colours {
    pub(crate) fn of(layer: &Layer) -> Self {
        if let Some(channel) = layer.channels.iter().position(|channel| channel.name == "class") {
            return Self::Classes(channel, layer.legend.iter().map(Class::colour).collect());
        }
        let (mut least, mut greatest) = (f64::INFINITY, f64::NEG_INFINITY);
        if let Some(channel) = layer.channels.first() {
            for value in (0..channel.cells.len()).filter_map(|cell| channel.value(cell)) {
                least = least.min(value);
                greatest = greatest.max(value);
            }
        }
        Self::Shades(least, greatest)
    }

    pub(crate) fn of_cell(&self, layer: &Layer, cell: usize) -> [u8; 3] {
        match self {
            Self::Classes(channel, colours) => {
                let class = layer.channels[*channel].cells.get(cell).and_then(|class| usize::try_from(class).ok());
                class.and_then(|class| colours.get(class)).copied().unwrap_or(UNKNOWN)
            }
            Self::Shades(least, greatest) => match layer.channels.first().and_then(|channel| channel.value(cell)) {
                Some(value) => {
                    let share = (value - least) / (greatest - least).max(f64::MIN_POSITIVE);
                    [72 + (share * 168.0) as u8; 3]
                }
                None => UNKNOWN,
            },
        }
    }
}

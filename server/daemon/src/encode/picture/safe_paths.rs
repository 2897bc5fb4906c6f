//! Safe points -> lines between linked points, in a band as wide as the radii.

use clearway_proto::map::SafePoint;

use super::canvas::Canvas;

/// Colour of the lines, and of their edges, so that they are seen on every ground.
const LINE: [u8; 3] = [255, 225, 77];
const EDGE: [u8; 3] = [10, 14, 18];
/// Half the width of the lines and of their edges, in pixels.
const LINE_PIXELS: f64 = 0.8;
const EDGE_PIXELS: f64 = 1.8;
/// Opacity of the white band, in percent.
const BAND_PERCENT: u16 = 20;

/// Draws safe points; the first is the vehicle's own position, whose radius is not drawn.
pub fn draw(canvas: &mut Canvas, points: &[SafePoint]) {
    draw_band(canvas, points);
    for (colour, half_width) in [(EDGE, EDGE_PIXELS), (LINE, LINE_PIXELS)] {
        for point in points {
            for link in point.links.iter().filter_map(|&link| points.get(link as usize)) {
                draw_line(canvas, point, link, colour, half_width);
            }
        }
    }
}

fn draw_band(canvas: &mut Canvas, points: &[SafePoint]) {
    let mut is_in_band = vec![false; canvas.rgb.len()];
    for point in points.iter().skip(1) {
        let radius = f64::from(point.radius_m) / canvas.pixel_m();
        mark_disc(canvas, point.x_m.into(), point.y_m.into(), radius, |index| is_in_band[index] = true);
    }
    for (pixel, _) in canvas.rgb.iter_mut().zip(is_in_band).filter(|(_, is_in_band)| *is_in_band) {
        *pixel = pixel.map(|value| ((u16::from(value) * (100 - BAND_PERCENT) + 255 * BAND_PERCENT) / 100) as u8);
    }
}

fn draw_line(canvas: &mut Canvas, from: &SafePoint, to: &SafePoint, colour: [u8; 3], half_width: f64) {
    let [x, y] = [from.x_m, from.y_m].map(f64::from);
    let (dx, dy) = (f64::from(to.x_m) - x, f64::from(to.y_m) - y);
    // A disc every half pixel.
    let steps = (2.0 * dx.hypot(dy) / canvas.pixel_m()).ceil().clamp(1.0, 4.0 * canvas.side as f64);
    let mut marked = Vec::new();
    for step in 0..=steps as u32 {
        let share = f64::from(step) / steps;
        mark_disc(canvas, x + share * dx, y + share * dy, half_width, |index| marked.push(index));
    }
    marked.into_iter().for_each(|index| canvas.rgb[index] = colour);
}

/// Visits the pixels whose middles lie within `radius` pixels of a point of the ego frame.
fn mark_disc(canvas: &Canvas, x_m: f64, y_m: f64, radius: f64, mut visit: impl FnMut(usize)) {
    let (column, row) = canvas.pixels(x_m, y_m);
    let span = |middle: f64| {
        let within = |pixel: f64| pixel.clamp(0.0, canvas.side as f64) as usize;
        within((middle - radius - 0.5).ceil())..within((middle + radius + 0.5).floor())
    };
    for y in span(row) {
        for x in span(column) {
            let (off_x, off_y) = (x as f64 + 0.5 - column, y as f64 + 0.5 - row);
            if off_x * off_x + off_y * off_y <= radius * radius {
                visit(y * canvas.side + x);
            }
        }
    }
}

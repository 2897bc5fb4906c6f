//! A layer of a map -> lines of text: seen from above, the vehicle in the middle, forward up.
//!
//! With colours each character shows two places, one over the other, in the colours of the layer's legend. Without
//! them it shows one place: the first letter of its class, or a dot where the class is unknown.

use clearway_client::Layer;
use clearway_proto::legend::Class;

use clearway_daemon::encode::colours::{Colours, UNKNOWN};

/// A character is twice as high as it is wide.
const ASPECT: usize = 2;
/// Character that fills its upper half.
const UPPER_HALF: char = '▀';

/// Draws `layer` out to `range_m`, or all of it, into at most `rows` and `columns`: the map, then its legend.
pub fn lines(layer: &Layer, range_m: Option<f64>, (rows, columns): (usize, usize), is_coloured: bool) -> Vec<String> {
    let range_m = range_m.unwrap_or(layer.grid.range_m_max());
    let rows = rows.saturating_sub(1).min(columns / ASPECT).max(1);
    let mut lines = if is_coloured { coloured(layer, range_m, rows) } else { letters(layer, range_m, rows) };
    lines.push(legend(layer, is_coloured));
    lines
}

/// Distance ahead of the vehicle, or to its left, of the middle of one of `count` places.
fn place(range_m: f64, index: usize, count: usize) -> f64 {
    range_m * (1.0 - 2.0 * (index as f64 + 0.5) / count as f64)
}

/// Each character shows two places, one over the other.
fn coloured(layer: &Layer, range_m: f64, rows: usize) -> Vec<String> {
    let (colours, places) = (Colours::of_layer(layer), rows * ASPECT);
    let colour = |row, column| {
        let cell = layer.grid.cell_at(place(range_m, row, places), place(range_m, column, places));
        cell.map_or(UNKNOWN, |cell| colours.of_cell(layer, cell))
    };
    let line = |row| {
        let (mut line, mut last) = (String::new(), None);
        for column in 0..places {
            let (upper, lower) = (colour(ASPECT * row, column), colour(ASPECT * row + 1, column));
            if last.replace((upper, lower)) != Some((upper, lower)) {
                let ([r, g, b], [s, h, c]) = (upper, lower);
                line.push_str(&format!("\x1b[38;2;{r};{g};{b};48;2;{s};{h};{c}m"));
            }
            line.push(UPPER_HALF);
        }
        line + "\x1b[0m"
    };
    (0..rows).map(line).collect()
}

/// Each character is the first letter of a class, or `^` for the vehicle.
fn letters(layer: &Layer, range_m: f64, rows: usize) -> Vec<String> {
    let columns = rows * ASPECT;
    let is_vehicle = |row, column| row == rows / 2 && column == columns / 2;
    let character = |row, column| match is_vehicle(row, column) {
        true => '^',
        false => letter(layer.class_at(place(range_m, row, rows), place(range_m, column, columns)).1),
    };
    (0..rows).map(|row| (0..columns).map(|column| character(row, column)).collect()).collect()
}

/// The letter of a class.
fn letter(class: &str) -> char {
    match class {
        "unknown" => '.',
        class => class.chars().next().unwrap_or('.'),
    }
}

fn legend(layer: &Layer, is_coloured: bool) -> String {
    let name = |class: &Class| {
        let [r, g, b] = class.colour();
        match is_coloured {
            true => format!("\x1b[38;2;{r};{g};{b}m█\x1b[0m {}", class.name),
            false => format!("{} {}", letter(&class.name), class.name),
        }
    };
    layer.legend.iter().map(name).collect::<Vec<_>>().join("  ")
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use clearway_proto::codec::Cells;
    use clearway_proto::grid::Grid;
    use clearway_proto::map::Channel;
    use clearway_proto::v1::ClassMeaning;

    use super::*;

    /// 4 x 4 cells of 1 m about the vehicle: free ahead on the left, occupied behind on the right.
    fn layer() -> Layer {
        let class = |name: &str, meaning, rgb| Class { name: name.into(), meaning, rgb };
        let mut cells = vec![0u8; 16];
        (cells[3 * 4 + 3], cells[0]) = (1, 2);
        Layer {
            name: "occupancy".into(),
            grid: Grid::Cartesian {
                origin_x_m: -2.0,
                origin_y_m: -2.0,
                width: 4,
                height: 4,
                cell_m: 1.0,
                yaw_rad: 0.0,
                first_ix: -2,
                first_iy: -2,
            },
            legend: vec![
                class("unknown", ClassMeaning::Unknown, 0x20_20_20),
                class("clear", ClassMeaning::Free, 0x00_80_00),
                class("occupied", ClassMeaning::Occupied, 0xff_00_00),
            ],
            channels: vec![Channel {
                name: "class".into(),
                unit: String::new(),
                scale: 1.0,
                unknown: 0,
                cells: Cells::U8(cells),
            }],
            planes: Vec::new(),
            metrics: BTreeMap::new(),
            points: Vec::new(),
        }
    }

    #[test]
    fn without_colours_each_place_is_a_letter_with_forward_up_and_left_on_the_left() {
        let lines = lines(&layer(), Some(2.0), (5, 80), false);
        assert_eq!(lines, ["cc......", "........", "....^...", "......oo", ". unknown  c clear  o occupied"]);
    }

    #[test]
    fn with_colours_each_character_shows_two_places_and_the_map_fits_the_screen() {
        let lines = lines(&layer(), None, (3, 80), true);
        assert_eq!(lines.len(), 3);
        assert!(lines[0].contains("\x1b[38;2;0;128;0;"), "{lines:?}");
        assert!(lines[1].contains("48;2;255;0;0m▀"), "{lines:?}");
        assert!(lines[..2].iter().all(|line| console::measure_text_width(line) == 4), "{lines:?}");
    }
}

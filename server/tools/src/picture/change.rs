//! Two maps of one layer -> a picture of each, and one of what changed in the class of each cell.

use anyhow::Result;
use clearway_daemon::encode::palette::Rgb;
use clearway_journal::compare::MapChange;
use clearway_journal::compare::change::Change;
use clearway_proto::map::Layer;

use super::image::Picture;
use super::legend::Swatch;
use super::{PictureStyle, draw, of_layer};

/// Edge of each of the three maps, in pixels; ours, because three of them fit a screen.
const PIXELS: u32 = 480;
/// The changes that a picture shows, with their names.
const SHOWN: [(Change, &str); 5] = [
    (Change::Free, "still free"),
    (Change::Closed, "still not free"),
    (Change::FreeGained, "free gained"),
    (Change::FreeLost, "free lost"),
    (Change::Other, "other change"),
];

/// A map before and after a change, and what changed, side by side.
///
/// # Errors
/// If a layer cannot be drawn.
pub fn before_after_change(map: &MapChange) -> Result<Picture> {
    let style = |caption: String| PictureStyle { pixels: PIXELS, caption: vec![caption], ..PictureStyle::default() };
    let title = |side| format!("{} {} {}: {side}", map.vehicle, map.after.name, map.sequence);
    let change =
        format!("{:.2} % changed, {:.1} m2 gained, {:.1} m2 lost", 100.0 * map.share(), map.gained_m2, map.lost_m2);
    Ok(Picture::beside(&[
        of_layer(&map.before, &style(title("before")))?,
        of_layer(&map.after, &style(title("after")))?,
        of_change(&map.before, &map.after, &style(change)),
    ]))
}

fn of_change(before: &Layer, after: &Layer, style: &PictureStyle) -> Picture {
    let meanings = SHOWN.map(|(change, name)| (Swatch::Colour(colour(change)), name.to_owned()));
    let range_m = style.range_m.unwrap_or(after.grid.range_m_max());
    draw(range_m, style, &[], meanings.to_vec(), |x_m, y_m| {
        let cells = before.grid.cell_at(x_m, y_m).zip(after.grid.cell_at(x_m, y_m));
        colour(cells.map_or(Change::Unknown, |(cell_before, cell)| Change::of(before, cell_before, after, cell)))
    })
}

fn colour(change: Change) -> Rgb {
    match change {
        Change::Unknown => [24, 26, 30],
        Change::Free => [66, 72, 80],
        Change::Closed => [150, 156, 164],
        Change::FreeGained => [86, 180, 233],
        Change::FreeLost => [213, 94, 0],
        Change::Other => [240, 228, 66],
    }
}

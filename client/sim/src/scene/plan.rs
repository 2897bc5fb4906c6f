//! A scene seen from above, as text, for reviewers.
//!
//! In: a truth raster. Out: lines of characters, the vehicle's x up the page and its y to the left, as on a map that is
//! held in driving direction.

use super::truth::{Truth, TruthGrid};

/// Draws `ahead` metres to the front and back and `beside` metres to either side, `rows` by `columns` characters.
///
/// `.` drivable, `:` tight, `-` out of reach, `/` steep, `#` obstacle, `^` the vehicle; a character shows the greatest
/// class that it covers, in the order of [`Truth`].
pub fn plan(truth: &TruthGrid, (ahead, beside): (f64, f64), (rows, columns): (usize, usize)) -> String {
    let mut page = String::with_capacity(rows * (columns + 1));
    let (tall, wide) = (2.0 * ahead / rows as f64, 2.0 * beside / columns as f64);
    let parts = |size: f64| (size / truth.cell_m).ceil().max(1.0) as usize;
    for row in 0..rows {
        let mut line = String::with_capacity(columns);
        for column in 0..columns {
            let (x, y) = (ahead - row as f64 * tall, beside - column as f64 * wide);
            let mut greatest = Truth::Outside;
            for i in 0..parts(tall) {
                for j in 0..parts(wide) {
                    let part = |index: usize, size: f64| (index as f64 + 0.5) / parts(size) as f64 * size;
                    greatest = greatest.max(truth.class_at(x - part(i, tall), y - part(j, wide)));
                }
            }
            let here = x > 0.0 && x <= tall && y > 0.0 && y <= wide;
            line.push(match greatest {
                _ if here => '^',
                Truth::Outside => ' ',
                Truth::Drivable => '.',
                Truth::Tight => ':',
                Truth::Unreachable => '-',
                Truth::Steep => '/',
                Truth::Overhang | Truth::Obstacle => '#',
            });
        }
        page.push_str(line.trim_end());
        page.push('\n');
    }
    page
}

//! The change of a cell's class -> its colour in a picture, and the legend.

use clearway_journal::compare::change::Change;

use crate::encode::legend::Legend;
use crate::encode::palette::Rgb;

/// The changes that a picture shows, as its legend names them.
const SHOWN: [(Change, &str); 5] = [
    (Change::Free, "still free"),
    (Change::Closed, "still not free"),
    (Change::FreeGained, "free gained"),
    (Change::FreeLost, "free lost"),
    (Change::Other, "other change"),
];

/// The colour of a change.
pub fn colour(change: Change) -> Rgb {
    match change {
        Change::Unknown => [24, 26, 30],
        Change::Free => [66, 72, 80],
        Change::Closed => [150, 156, 164],
        Change::FreeGained => [86, 180, 233],
        Change::FreeLost => [213, 94, 0],
        Change::Other => [240, 228, 66],
    }
}

/// The legend of a picture of changes.
pub fn legend() -> Legend {
    Legend::Classes(SHOWN.map(|(change, name)| (name.to_owned(), colour(change))).to_vec())
}

//! Barriers of random worlds: lines of fences, walls, rails or bollards, with openings.
//!
//! In: a style, a line, openings on it. Out: a world with them. Frame: world, metres.

use super::super::world::{SLATS, World};
use super::draw::Draw;

/// What a barrier is made of.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Style {
    /// Upright slats, of this height.
    Slats(f64),
    /// Closed panels, of this height.
    Panels(f64),
    /// A wall, of this height.
    Wall(f64),
    /// A guard rail on posts: heights of its lower and upper edge.
    Rail(f64, f64),
}

impl Style {
    pub fn draw(draw: &mut Draw) -> Self {
        match draw.whole(0, 3) {
            0 => Self::Slats(draw.between(1.0, 1.8)),
            1 => Self::Panels(draw.between(0.9, 1.8)),
            2 => Self::Wall(draw.between(0.6, 2.2)),
            _ => Self::Rail(draw.between(0.35, 0.5), draw.between(0.75, 0.95)),
        }
    }

    pub fn text(self) -> String {
        match self {
            Self::Slats(height) => format!("slats {height:.1} m"),
            Self::Panels(height) => format!("panels {height:.1} m"),
            Self::Wall(height) => format!("wall {height:.1} m"),
            Self::Rail(low, high) => format!("rail {low:.2} to {high:.2} m"),
        }
    }
}

/// An opening in a barrier: distance of its middle from the line's beginning, and its width, in metres.
pub(super) type Opening = (f64, f64);

/// Longest piece of a barrier, in metres. Pieces stand level on the ground, so short pieces follow a slope.
const PIECE_M: f64 = 3.0;
/// Distance by which a wall is longer at each end than its line, in metres.
const WALL_END_M: f64 = 0.15;

/// Adds a barrier along a straight line with these openings, which are apart and in order.
pub(super) fn barrier(mut world: World, style: Style, line: [[f64; 2]; 2], openings: &[Opening]) -> World {
    let (dx, dy) = (line[1][0] - line[0][0], line[1][1] - line[0][1]);
    let length = dx.hypot(dy);
    let at = |along: f64| [line[0][0] + dx * along / length, line[0][1] + dy * along / length];
    let mut from = 0.0;
    for stretch in 0..=openings.len() {
        let opening = openings.get(stretch);
        let to = opening.map_or(length, |(middle, width)| middle - width / 2.0);
        // The ends of a wall beside an opening must not narrow it.
        let inset = if matches!(style, Style::Wall(_)) { WALL_END_M } else { 0.0 };
        let (begin, end) =
            (from + if stretch > 0 { inset } else { 0.0 }, to - if opening.is_some() { inset } else { 0.0 });
        if end > begin {
            world = stretch_of(world, style, at, (begin, end));
        }
        from = opening.map_or(length, |(middle, width)| middle + width / 2.0);
    }
    world
}

fn stretch_of(world: World, style: Style, at: impl Fn(f64) -> [f64; 2], (from, to): (f64, f64)) -> World {
    let pieces = ((to - from) / PIECE_M).ceil();
    let line: Vec<[f64; 2]> =
        (0..=pieces as u32).map(|piece| at(from + (to - from) * f64::from(piece) / pieces)).collect();
    match style {
        Style::Slats(height) => world.fence(&line, height, Some(SLATS)),
        Style::Panels(height) => world.fence(&line, height, None),
        Style::Wall(height) => world.wall(&line, height),
        Style::Rail(low, high) => {
            let posts = |world: World, &[x, y]: &[f64; 2]| world.pole(x, y, 0.06, high);
            line.iter().fold(world.rail(&line, low, high), posts)
        }
    }
}

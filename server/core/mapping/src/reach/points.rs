//! The points of a map, sorted into returns from the ground and returns from obstacles.
//!
//! In: points with their heights over the ground, metres. Out: the same in [`Steps`] and [`Obstacles`], by cell. What
//! hangs higher, and the vehicle's own obstacles, are in neither.

use std::ops::Range;

use crate::azimuth_columns::floor_to_whole;
use crate::sensor::sweep::Sweep;
use crate::wide::{WideLoop, run_wide};

use super::cells::{NOWHERE, cell};
use super::config::ReachConfig;
use super::obstacles::Obstacles;
use super::steps::{LOWEST_M, Steps};

/// Height over the ground below which a return shows the ground and its steps, metres. Ours: it is no obstacle to any
/// vehicle; a higher one, whatever obstacles the vehicle drives over, is the side of a thing and no step.
const GROUND_M_MAX: f32 = 0.25;
/// Number of points that are processed together. Ours: their cells fit into the first-level cache.
const CHUNK: usize = 1024;

/// Adds some points of a sweep, which have these heights over the ground, to the steps and the obstacles.
pub fn sort(
    sweep: &Sweep,
    heights_m: &[f32],
    points: Range<usize>,
    config: &ReachConfig,
    (steps, obstacles): (&mut Steps, &mut Obstacles),
) {
    let mut sorted = SortedChunk { ground: [NOWHERE; CHUNK], z_mm: [0; CHUNK], obstacles: [NOWHERE; CHUNK] };
    let [xs, ys, zs, heights_m] =
        [&sweep.x, &sweep.y, &sweep.z, heights_m].map(|axis| axis[points.clone()].chunks(CHUNK));
    for (((x, y), z), heights_m) in xs.zip(ys).zip(zs).zip(heights_m) {
        run_wide(SortChunk { positions: [x, y, z], heights_m, config, sorted: &mut sorted });
        for (&cell, &z_mm) in sorted.ground.iter().zip(&sorted.z_mm).take(x.len()).filter(|(cell, _)| **cell != NOWHERE)
        {
            steps.add_point(cell, z_mm);
        }
        for (&cell, &height_m) in sorted.obstacles.iter().zip(heights_m).filter(|(cell, _)| **cell != NOWHERE) {
            obstacles.add_point(cell, height_m);
        }
    }
}

/// Up to [`CHUNK`] points: the cell of a return from the ground and its height, the cell of a return from an obstacle,
/// and [`NOWHERE`] for all others.
struct SortedChunk {
    ground: [u32; CHUNK],
    /// Ego frame, millimetres.
    z_mm: [i16; CHUNK],
    obstacles: [u32; CHUNK],
}

/// Sorts points with their heights over the ground, metres. Without a branch, so that the compiler vectorises it.
struct SortChunk<'a> {
    positions: [&'a [f32]; 3],
    heights_m: &'a [f32],
    config: &'a ReachConfig,
    sorted: &'a mut SortedChunk,
}

impl WideLoop for SortChunk<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { positions: [xs, ys, zs], heights_m, config, sorted: SortedChunk { ground, z_mm, obstacles } } = self;
        let (outline, least_m, most_m) = (config.outline(), config.obstacle_m_min, config.overhang_m);
        let n = xs.len().min(CHUNK);
        let (xs, ys, zs, heights_m) = (&xs[..n], &ys[..n], &zs[..n], &heights_m[..n]);
        for i in 0..n {
            let (found, height_m) = (cell(xs[i], ys[i]), heights_m[i]);
            // NaN fails every comparison.
            let is_ground = (height_m > LOWEST_M) & (height_m < GROUND_M_MAX);
            let is_obstacle = (height_m >= least_m) & (height_m <= most_m) & !outline.contains(xs[i], ys[i]);
            ground[i] = if is_ground { found } else { NOWHERE };
            obstacles[i] = if is_obstacle { found } else { NOWHERE };
            // Ground is within 20 m of the vehicle's height. A cast of a number with a sign has range checks.
            let millimetres = floor_to_whole((zs[i].abs() * 1000.0).min(f32::from(i16::MAX))) as i16;
            z_mm[i] = if zs[i] < 0.0 { -millimetres } else { millimetres };
        }
    }
}

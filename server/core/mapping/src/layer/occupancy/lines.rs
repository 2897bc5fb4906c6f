//! Lines (Seo 2014, algorithm 1): for each return, a line of cells from the sensor through the return to the reliable
//! range.
//!
//! In: [`Rays`], ego frame, metres. Out: hits counted in the [`Window`] for each scan; when the map is made, the
//! evidence about each cell. Only returns from obstacles have lines: those at least `clearance_m` and less than
//! `overhang_m` over the plane under the vehicle. The cells of a line (Bresenham's algorithm) before the return are
//! clear, the cell of the return has a hit, and the cells behind it are hidden.
//!
//! Lines only set bits, so that their order does not matter. As in the other variant, only the newest scan of a sensor
//! shows what is clear and what is hidden now.

use crate::sensor::rays::Rays;

use super::config::OccupancyConfig;
use super::states::{HIDDEN, LOOKED_AT, THROUGH};
use super::window::Window;

/// The newest scans of all sensors.
#[derive(Clone, Default)]
pub struct Lines {
    scans: Vec<LineScan>,
}

/// The evidence of one sensor's newest scan.
#[derive(Clone)]
struct LineScan {
    sensor: u16,
    /// True if the scan arrived since the last map.
    fresh: bool,
    /// End of the scan, ns since the Unix epoch.
    stamp_ns: i64,
    /// World index (x, y) of the first cell of `evidence`.
    corner: [i64; 2],
    /// Number of cells along a side.
    side: usize,
    /// Evidence bits by cell, row by row.
    evidence: Vec<u8>,
}

impl Lines {
    /// Replaces the last scan of a sensor, and counts the hits in the window, which must have moved to the vehicle.
    pub fn insert(&mut self, rays: &Rays<'_>, config: &OccupancyConfig, window: &mut Window) {
        let known = self.scans.iter().position(|scan| scan.sensor == rays.sensor);
        let index = known.unwrap_or_else(|| {
            self.scans.push(LineScan::new(rays.sensor, window.side()));
            self.scans.len() - 1
        });
        self.scans[index].insert(rays, config, window);
    }

    /// Removes the evidence of all scans.
    pub fn clear(&mut self) {
        self.scans.iter_mut().for_each(|scan| scan.fresh = false);
    }

    /// Adds the evidence of the scans since the last map, and since `earliest_ns`, to each cell of the window, row by
    /// row. Returns true if there was any such scan.
    pub fn write_evidence(&mut self, earliest_ns: i64, window: &Window, of_cell: &mut [u8]) -> bool {
        let mut any = false;
        for scan in &mut self.scans {
            if std::mem::take(&mut scan.fresh) && scan.stamp_ns >= earliest_ns {
                scan.write(window.corner(), of_cell);
                any = true;
            }
        }
        any
    }
}

impl LineScan {
    fn new(sensor: u16, side: usize) -> Self {
        Self { sensor, fresh: false, stamp_ns: 0, corner: [0, 0], side, evidence: vec![0; side * side] }
    }

    fn insert(&mut self, rays: &Rays<'_>, config: &OccupancyConfig, window: &mut Window) {
        (self.fresh, self.stamp_ns, self.corner) = (true, rays.stamp_ns, window.corner());
        let window_from_ego = window.window_from_ego();
        let origin = window_from_ego.apply(rays.origin_m[0], rays.origin_m[1]);
        let reach = config.range_m_max / config.cell_m;
        self.look_at(origin, reach);
        for ((&x, &y), &z) in rays.returns.x.iter().zip(&rays.returns.y).zip(&rays.returns.z) {
            let at = window_from_ego.apply(x, y);
            let range = ((at[0] - origin[0]) * (at[0] - origin[0]) + (at[1] - origin[1]) * (at[1] - origin[1])).sqrt();
            // NaN is in no range.
            if (config.clearance_m..config.overhang_m).contains(&z) && range <= reach {
                window.record_hit(at);
                let end = [0, 1].map(|i| origin[i] + (at[i] - origin[i]) * (reach / range));
                self.trace(cell(origin), cell(at), if range > 0.0 { cell(end) } else { cell(at) });
            }
        }
    }

    /// Marks the cells within reach of the sensor as looked at, and removes all other evidence.
    fn look_at(&mut self, origin: [f32; 2], reach: f32) {
        for (iy, row) in self.evidence.chunks_exact_mut(self.side).enumerate() {
            let dy = iy as f32 + 0.5 - origin[1];
            for (ix, evidence) in row.iter_mut().enumerate() {
                let dx = ix as f32 + 0.5 - origin[0];
                *evidence = if dx * dx + dy * dy <= reach * reach { LOOKED_AT } else { 0 };
            }
        }
    }

    /// Traces the line of one return. A line ends where it leaves the window.
    fn trace(&mut self, from: [i32; 2], hit: [i32; 2], end: [i32; 2]) {
        let (side, evidence) = (self.side, &mut self.evidence);
        let mut add = |[x, y]: [i32; 2], bit: u8| {
            let (x, y) = (x as usize, y as usize);
            // A negative index becomes a very large one.
            let is_inside = x < side && y < side;
            if is_inside {
                evidence[y * side + x] |= bit;
            }
            is_inside
        };
        let reaches_hit = walk(from, hit, |at| at == hit || add(at, LOOKED_AT | THROUGH));
        if reaches_hit {
            walk(hit, end, |at| add(at, if at == hit { LOOKED_AT } else { LOOKED_AT | HIDDEN }));
        }
    }

    /// Adds the evidence to the cells of a window at another position.
    fn write(&self, corner: [i64; 2], of_cell: &mut [u8]) {
        let side = self.side as i64;
        let [dx, dy] = [0, 1].map(|i| corner[i] - self.corner[i]);
        let columns = (-dx).clamp(0, side)..(side - dx).clamp(0, side);
        for iy in (-dy).clamp(0, side)..(side - dy).clamp(0, side) {
            let own = (iy + dy) * side + dx;
            for ix in columns.clone() {
                of_cell[(iy * side + ix) as usize] |= self.evidence[(own + ix) as usize];
            }
        }
    }
}

/// The cell of a position, in cells from the window's corner.
fn cell(at: [f32; 2]) -> [i32; 2] {
    at.map(|cells| cells.floor() as i32)
}

/// Visits the cells of a line in order, both ends included, until `visit` returns false (Bresenham's algorithm).
/// Returns true if all were visited.
fn walk(from: [i32; 2], to: [i32; 2], mut visit: impl FnMut([i32; 2]) -> bool) -> bool {
    let ([mut x, mut y], [to_x, to_y]) = (from, to);
    let (dx, dy) = ((to_x - x).abs(), -(to_y - y).abs());
    let (step_x, step_y) = ((to_x - x).signum(), (to_y - y).signum());
    let mut error = dx + dy;
    loop {
        if !visit([x, y]) {
            return false;
        }
        if [x, y] == to {
            return true;
        }
        let twice = 2 * error;
        if twice >= dy {
            (x, error) = (x + step_x, error + dy);
        }
        if twice <= dx {
            (y, error) = (y + step_y, error + dx);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_visits_one_cell_a_step_of_its_longer_axis() {
        for to in [[7, 3], [-7, 3], [3, -7], [-2, -2], [0, 5], [0, 0]] {
            let mut cells = Vec::new();
            assert!(walk([0, 0], to, |at| {
                cells.push(at);
                true
            }));
            assert_eq!((cells[0], cells[cells.len() - 1]), ([0, 0], to));
            assert_eq!(cells.len() as i32, 1 + to[0].abs().max(to[1].abs()));
            let off = |[x, y]: &[i32; 2]| (x * to[1] - y * to[0]).abs();
            assert!(cells.iter().all(|at| 2 * off(at) <= to[0].abs().max(to[1].abs()).max(1)), "{cells:?}");
        }
        assert!(!walk([0, 0], [9, 0], |at| at != [4, 0]));
    }

    #[test]
    fn a_line_clears_before_the_hit_and_hides_behind_it() {
        let mut scan = LineScan::new(0, 10);
        scan.trace([2, 5], [6, 5], [40, 5]);
        let row: Vec<u8> = scan.evidence[50..60].to_vec();
        let (through, hidden) = (LOOKED_AT | THROUGH, LOOKED_AT | HIDDEN);
        assert_eq!(row, [0, 0, through, through, through, through, LOOKED_AT, hidden, hidden, hidden]);
        // The window has moved by three cells along x and one along y.
        let mut moved = vec![0; 100];
        scan.write([3, 1], &mut moved);
        assert_eq!(moved[40..50], [through, through, through, LOOKED_AT, hidden, hidden, hidden, 0, 0, 0]);
        assert_eq!(moved.iter().filter(|bits| **bits > 0).count(), 7);
    }
}

//! The corridor of the route, and its speed limits (RDDF; Lindström 2005, sections 3.2.1 and 3.3).
//!
//! In: the route's points (ego frame, metres), widths and speed limits. Out: by cell whether it lies in the corridor,
//! and the limit there. As in an RDDF, width and limit of a point hold up to the next point. The corridor of a pair of
//! points is everything within half the width of their connection: the circles of the paper around both points, and
//! what lies between them. A cell in the corridors of several pairs has the limit of the nearest pair, and of equally
//! near ones the lowest.

/// Limit of a cell outside the corridor.
pub const OUTSIDE: f32 = -1.0;

/// The corridor in a grid of `side` cells along x and y with the vehicle in the middle.
#[derive(Clone, Debug, PartialEq)]
pub struct Corridor {
    side: usize,
    cell_m: f64,
    /// By cell: [`OUTSIDE`], or the limit, m/s; infinite without a limit. Empty without a route.
    limits_mps: Vec<f32>,
    /// By cell: squared distance from the nearest pair, m².
    nearest_m2: Vec<f64>,
}

impl Corridor {
    /// A grid without a route.
    pub fn new(side: usize, cell_m: f32) -> Self {
        Self { side, cell_m: cell_m.into(), limits_mps: Vec::new(), nearest_m2: Vec::new() }
    }

    /// Removes the route.
    pub fn clear(&mut self) {
        self.limits_mps.clear();
    }

    /// Limit of a cell, m/s: infinite without a limit and without a route, [`OUTSIDE`] outside the corridor.
    pub fn limit_mps(&self, cell: usize) -> f32 {
        self.limits_mps.get(cell).copied().unwrap_or(f32::INFINITY)
    }

    /// Paints a route that [`crate::road::check`] has accepted: its points, widths, and limits, if it has any.
    pub fn paint(&mut self, points: &[[f64; 2]], widths_m: &[f64], limits_mps: &[f64]) {
        let cells = self.side * self.side;
        self.limits_mps.clear();
        self.limits_mps.resize(cells, OUTSIDE);
        self.nearest_m2.clear();
        self.nearest_m2.resize(cells, f64::INFINITY);
        for (index, (pair, width_m)) in points.windows(2).zip(widths_m).enumerate() {
            let limit = limits_mps.get(index).copied().filter(|mps| *mps > 0.0);
            self.paint_pair([pair[0], pair[1]], width_m / 2.0, limit.map_or(f32::INFINITY, |mps| mps as f32));
        }
    }

    fn paint_pair(&mut self, [from, to]: [[f64; 2]; 2], radius_m: f64, limit_mps: f32) {
        let middle = self.side as f64 / 2.0;
        // Indices of the cells whose centres lie between two positions along one axis. `as` saturates.
        let within = |axis: usize| {
            let (low, high) = (from[axis].min(to[axis]) - radius_m, from[axis].max(to[axis]) + radius_m);
            let first = (low / self.cell_m + middle - 0.5).ceil().max(0.0) as usize;
            let end = ((high / self.cell_m + middle + 0.5).floor().max(0.0) as usize).min(self.side);
            first.min(end)..end
        };
        let (columns, rows) = (within(0), within(1));
        let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
        let length_m2 = dx * dx + dy * dy;
        let centre_m = |index: usize| (index as f64 + 0.5 - middle) * self.cell_m;
        for iy in rows {
            let qy = centre_m(iy) - from[1];
            for ix in columns.clone() {
                let qx = centre_m(ix) - from[0];
                let share = ((dx * qx + dy * qy) / length_m2).clamp(0.0, 1.0);
                let (ex, ey) = (qx - share * dx, qy - share * dy);
                let distance_m2 = ex * ex + ey * ey;
                let cell = iy * self.side + ix;
                let (limit, nearest_m2) = (&mut self.limits_mps[cell], &mut self.nearest_m2[cell]);
                if distance_m2 <= radius_m * radius_m && distance_m2 <= *nearest_m2 {
                    *limit = if distance_m2 < *nearest_m2 { limit_mps } else { limit.min(limit_mps) };
                    *nearest_m2 = distance_m2;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn width_and_limit_of_a_point_hold_up_to_the_next_point() {
        let mut corridor = Corridor::new(80, 0.5);
        assert_eq!(corridor.limit_mps(7), f32::INFINITY, "no route limits nothing");
        let points = [[-15.0, 0.0], [0.0, 0.0], [15.0, 0.0]];
        corridor.paint(&points, &[4.0, 10.0, 1.0], &[5.0, 0.0, 3.0]);
        let at = |x: f64, y: f64| corridor.limit_mps(((y / 0.5 + 40.0) as usize) * 80 + (x / 0.5 + 40.0) as usize);
        assert_eq!([at(-7.0, 0.3), at(-7.0, 1.7), at(-7.0, 2.3)], [5.0, 5.0, OUTSIDE]);
        assert_eq!([at(7.0, 1.0), at(7.0, -4.7), at(7.0, 5.3)], [f32::INFINITY, f32::INFINITY, OUTSIDE]);
        // The circle around the second point belongs to the second pair; half of it lies beside the first pair.
        assert_eq!([at(-3.0, 3.7), at(-3.0, 1.0), at(-18.0, 0.3)], [f32::INFINITY, 5.0, OUTSIDE]);
        assert_eq!(at(19.0, 0.3), f32::INFINITY, "the last point has a circle too");
        corridor.clear();
        assert_eq!(corridor.limit_mps(0), f32::INFINITY);
    }
}

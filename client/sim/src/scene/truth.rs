//! The truth about drivable ground, computed from the world itself, with which maps are compared.
//!
//! In: a world, the vehicle's pose, a time. Out: a raster in the ego frame (x forward, y left, metres). The limits come
//! from the UT Austin thesis, section IV: a step of one unit (0.25 m), a clearance of 2.5 m, passages 3 m wide
//! (criterion 3).

use nalgebra::{Isometry3, Point3};

use super::object::Shape;
use super::world::World;

/// Class of a place, for a vehicle that stands in the middle of the raster.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Truth {
    /// A place beyond the raster; nothing is known of it.
    #[default]
    Outside,
    /// Free ground that the vehicle reaches through passages that are wide enough.
    Drivable,
    /// Free ground that is reached only through narrower passages that the vehicle fits into, or a place that is too
    /// narrow for it: a map may call it drivable or not.
    Tight,
    /// Free ground that the vehicle cannot reach, or reaches only through openings that are narrower than itself.
    Unreachable,
    /// Ground that is too steep, or the edge of a step that is too high.
    Steep,
    /// Ground under an object that hangs within the clearance, at least [`HANGS_M_MIN`] over it, as a beam or branches.
    Overhang,
    /// Ground under an object that stands, or hangs lower.
    Obstacle,
}

/// Limits of what a vehicle can drive on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Steepest ground, as rise over run. Steeper ground that rises less than a step is driven over.
    pub slope_max: f64,
    /// Highest step, and highest object that the vehicle drives over, metres.
    pub step_m_max: f64,
    /// Least height of an object over drivable ground, metres.
    pub clearance_m: f64,
    /// Narrowest passage, metres.
    pub passage_m_min: f64,
    /// Width of the vehicle, metres. No map may call the ground behind a narrower opening drivable.
    pub vehicle_m: f64,
}

impl Default for Limits {
    /// 20 degrees (ours), the unit, cut-off height and boundary length of the UT Austin thesis, section IV, and the
    /// width of the simulated cars.
    fn default() -> Self {
        Self { slope_max: 0.364, step_m_max: 0.25, clearance_m: 2.5, passage_m_min: 3.0, vehicle_m: 1.8 }
    }
}

/// Distance by which objects are widened, in cells: half the diagonal of a cell, so that no thin object falls between
/// two cell centres.
const OBJECT_MARGIN: f64 = 0.71;

/// Least height of an overhang over the ground, metres. Ours: near a sensor the uppermost laser may pass under it, but
/// meets what hangs lower.
pub const HANGS_M_MIN: f64 = 1.0;

/// Raster of the truth about the ground around a vehicle, in its ego frame.
#[derive(Clone, Debug)]
pub struct TruthGrid {
    /// Distance from the vehicle to each side of the raster, metres.
    pub half_extent_m: f64,
    /// Side of a cell, metres.
    pub cell_m: f64,
    /// Number of cells of a side.
    pub side: usize,
    /// Row by row: cell (i, j) at index `j * side + i` has its middle at x = (i + 0.5) * cell_m - half_extent_m, y
    /// alike.
    pub classes: Vec<Truth>,
    /// Height of the ground in the ego frame in each cell, metres, in the same order.
    pub heights: Vec<f32>,
}

impl TruthGrid {
    /// The truth at `time` s about a vehicle at `map_from_ego`, `half_extent_m` to each side in cells of `cell_m`.
    pub fn about(
        world: &World,
        map_from_ego: &Isometry3<f64>,
        time: f64,
        (half_extent_m, cell_m): (f64, f64),
        limits: &Limits,
    ) -> Self {
        let side = (2.0 * half_extent_m / cell_m).round() as usize;
        let mut grid = Self {
            half_extent_m,
            cell_m,
            side,
            classes: vec![Truth::Unreachable; side * side],
            heights: vec![0.0; side * side],
        };
        let places = grid.lay_on_ground(world, map_from_ego);
        grid.mark_ground(world, &places, limits);
        grid.mark_objects(world, map_from_ego, time, &places, limits);
        grid.mark_reachable(limits);
        grid
    }

    /// The class at a place in the ego frame, metres; [`Truth::Outside`] beyond the raster.
    pub fn class_at(&self, x: f64, y: f64) -> Truth {
        self.index_at(x, y).map_or(Truth::Outside, |index| self.classes[index])
    }

    /// The height of the ground at a place, both in the ego frame, metres; `None` beyond the raster.
    pub fn height_at(&self, x: f64, y: f64) -> Option<f32> {
        self.index_at(x, y).map(|index| self.heights[index])
    }

    fn index_at(&self, x: f64, y: f64) -> Option<usize> {
        let i = ((x + self.half_extent_m) / self.cell_m).floor();
        let j = ((y + self.half_extent_m) / self.cell_m).floor();
        let inside = |index: f64| index >= 0.0 && index < self.side as f64;
        (inside(i) && inside(j)).then(|| j as usize * self.side + i as usize)
    }

    /// Middle of a cell, metres.
    pub fn middle(&self, index: usize) -> (f64, f64) {
        let place = |cell: usize| (cell as f64 + 0.5) * self.cell_m - self.half_extent_m;
        (place(index % self.side), place(index / self.side))
    }

    /// World point (x, y, height of the ground) of each cell. The raster of a tilted vehicle is projected along its z
    /// axis.
    fn lay_on_ground(&mut self, world: &World, map_from_ego: &Isometry3<f64>) -> Vec<[f64; 3]> {
        let up = map_from_ego.rotation * nalgebra::Vector3::z();
        (0..self.classes.len())
            .map(|index| {
                let (x, y) = self.middle(index);
                let mut point = map_from_ego * Point3::new(x, y, 0.0);
                for _ in 0..3 {
                    point += up * ((world.ground.height(point.x, point.y) - point.z) / up.z);
                }
                let ground = world.ground.height(point.x, point.y);
                let ego = map_from_ego.inverse_transform_point(&Point3::new(point.x, point.y, ground));
                self.heights[index] = ego.z as f32;
                [point.x, point.y, ground]
            })
            .collect()
    }

    fn mark_ground(&mut self, world: &World, places: &[[f64; 3]], limits: &Limits) {
        for (index, &[x, y, z]) in places.iter().enumerate() {
            let slope = world.ground.slope(x, y);
            if slope > limits.slope_max && is_high(world, [x, y], limits) {
                self.classes[index] = Truth::Steep;
            }
            let (i, j) = (index % self.side, index / self.side);
            for other in [(i + 1 < self.side).then_some(index + 1), (j + 1 < self.side).then_some(index + self.side)] {
                let Some(other) = other else { continue };
                let [ox, oy, oz] = places[other];
                let sloping = slope.max(world.ground.slope(ox, oy)) * (ox - x).hypot(oy - y);
                if (oz - z).abs() > limits.step_m_max + sloping {
                    self.classes[index] = Truth::Steep;
                    self.classes[other] = Truth::Steep;
                }
            }
        }
    }

    fn mark_objects(
        &mut self,
        world: &World,
        map_from_ego: &Isometry3<f64>,
        time: f64,
        places: &[[f64; 3]],
        limits: &Limits,
    ) {
        let margin = OBJECT_MARGIN * self.cell_m;
        for shape in world.shapes_at(time) {
            let Some((low, high)) = self.cells_about(&shape, map_from_ego) else { continue };
            for j in low[1]..=high[1] {
                for i in low[0]..=high[0] {
                    let index = j * self.side + i;
                    let [x, y, ground] = places[index];
                    if let Some((bottom, top)) = shape.column(x, y, margin)
                        && bottom < ground + limits.clearance_m
                        && top > ground + limits.step_m_max
                    {
                        let hangs = bottom > ground + HANGS_M_MIN;
                        let class = if hangs { Truth::Overhang } else { Truth::Obstacle };
                        self.classes[index] = self.classes[index].max(class);
                    }
                }
            }
        }
    }

    /// Lowest and highest cell indices that a shape can cover, or `None` if it is beyond the raster.
    fn cells_about(&self, shape: &Shape, map_from_ego: &Isometry3<f64>) -> Option<([usize; 2], [usize; 2])> {
        let (corners, radius) = shape.outline();
        // The cells of a tilted raster shift with the height of the ground, by less than a metre.
        let margin = radius + 1.0;
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for [x, y] in corners {
            let ego = map_from_ego.inverse_transform_point(&Point3::new(x, y, map_from_ego.translation.z));
            for (axis, place) in [ego.x, ego.y].into_iter().enumerate() {
                low[axis] = low[axis].min((place - margin + self.half_extent_m) / self.cell_m);
                high[axis] = high[axis].max((place + margin + self.half_extent_m) / self.cell_m);
            }
        }
        let last = self.side as f64 - 1.0;
        let beyond = (0..2).any(|axis| high[axis] < 0.0 || low[axis] > last);
        (!beyond).then(|| (low.map(|cell| cell.max(0.0) as usize), high.map(|cell| cell.min(last) as usize)))
    }

    /// Divides free ground into drivable, tight and unreachable ground.
    fn mark_reachable(&mut self, limits: &Limits) {
        let free: Vec<bool> = self.classes.iter().map(|&class| class == Truth::Unreachable).collect();
        let distances = squared_distance(&free, self.side);
        let half_passage = limits.passage_m_min / 2.0 / self.cell_m;
        let (_, passes) = self.covered(&distances, half_passage, limits.passage_m_min);
        // Objects are widened in the raster. A vehicle must not become too wide for an opening by that.
        let half_vehicle = limits.vehicle_m / 2.0 / self.cell_m - OBJECT_MARGIN;
        let (fits, comes) = self.covered(&distances, half_vehicle, limits.passage_m_min);
        let connected = self.flood(&free, limits.passage_m_min);
        for index in 0..self.classes.len() {
            if free[index] && passes[index] {
                self.classes[index] = Truth::Drivable;
            } else if connected[index] && (comes[index] || !fits[index]) {
                self.classes[index] = Truth::Tight;
            }
        }
    }

    /// The ground that a disc of this radius (in cells) covers, at any place where it fits; and the ground that it
    /// covers if it is moved there from places within `seed_m` of the vehicle. `distances` are the squared distances
    /// of free cells to the nearest other cell.
    fn covered(&self, distances: &[f64], radius: f64, seed_m: f64) -> (Vec<bool>, Vec<bool>) {
        let squared = radius * radius;
        let fits: Vec<bool> = distances.iter().map(|&distance| distance >= squared && distance > 0.0).collect();
        let moved = self.flood(&fits, seed_m);
        let [anywhere, reached] = [&fits, &moved].map(|places| {
            let outside: Vec<bool> = places.iter().map(|&place| !place).collect();
            squared_distance(&outside, self.side).into_iter().map(|distance| distance < squared).collect()
        });
        (anywhere, reached)
    }

    /// True for the open cells that are connected by their sides to open cells within `seed_m` of the vehicle.
    fn flood(&self, open: &[bool], seed_m: f64) -> Vec<bool> {
        let mut reached = vec![false; open.len()];
        let mut front: Vec<usize> = (0..open.len())
            .filter(|&index| {
                let (x, y) = self.middle(index);
                open[index] && x.hypot(y) <= seed_m
            })
            .collect();
        front.iter().for_each(|&index| reached[index] = true);
        while let Some(index) = front.pop() {
            let (i, j) = (index % self.side, index / self.side);
            let sides = [
                (i > 0).then(|| index - 1),
                (i + 1 < self.side).then_some(index + 1),
                (j > 0).then(|| index - self.side),
                (j + 1 < self.side).then_some(index + self.side),
            ];
            for next in sides.into_iter().flatten() {
                if open[next] && !reached[next] {
                    reached[next] = true;
                    front.push(next);
                }
            }
        }
        reached
    }
}

/// Half the distance over which a steep place must rise more than a step to be too steep, metres. Ours: a wheel of a
/// car spans about as much, so that a furrow of a field is driven over, whatever its sides are.
const STEEP_HALF_M: f64 = 0.5;

/// True if the ground around a place rises more than a step.
fn is_high(world: &World, [x, y]: [f64; 2], limits: &Limits) -> bool {
    let places = [(STEEP_HALF_M, 0.0), (-STEEP_HALF_M, 0.0), (0.0, STEEP_HALF_M), (0.0, -STEEP_HALF_M), (0.0, 0.0)];
    let heights = places.map(|(dx, dy)| world.ground.height(x + dx, y + dy));
    let [low, high] = [heights.into_iter().fold(f64::INFINITY, f64::min), heights.into_iter().fold(f64::MIN, f64::max)];
    high - low > limits.step_m_max
}

/// Squared distance in cells from each open cell to the nearest closed one; the raster's border is open.
///
/// Exact, in two passes of lower envelopes of parabolas (Felzenszwalb and Huttenlocher 2012).
fn squared_distance(open: &[bool], side: usize) -> Vec<f64> {
    // Finite, so that two rows without a closed cell do not make infinity minus infinity.
    let far = (4 * side * side) as f64;
    let mut distances: Vec<f64> = open.iter().map(|&open| if open { far } else { 0.0 }).collect();
    let mut line = vec![0.0; side];
    for pass in [1, side] {
        let across = if pass == 1 { side } else { 1 };
        for row in 0..side {
            for cell in 0..side {
                line[cell] = distances[row * across + cell * pass];
            }
            for (cell, distance) in envelope(&line).into_iter().enumerate() {
                distances[row * across + cell * pass] = distance;
            }
        }
    }
    distances
}

/// At each index, the lowest of the parabolas that stand on the values.
fn envelope(values: &[f64]) -> Vec<f64> {
    let mut feet: Vec<usize> = Vec::with_capacity(values.len());
    let mut from: Vec<f64> = Vec::with_capacity(values.len());
    let raised = |q: usize| values[q] + (q * q) as f64;
    for q in 0..values.len() {
        let mut meet = f64::NEG_INFINITY;
        while let Some(&foot) = feet.last() {
            meet = (raised(q) - raised(foot)) / (2.0 * (q as f64 - foot as f64));
            if meet > from[feet.len() - 1] {
                break;
            }
            feet.pop();
            from.pop();
            meet = f64::NEG_INFINITY;
        }
        feet.push(q);
        from.push(meet);
    }
    let mut piece = 0;
    (0..values.len())
        .map(|q| {
            while piece + 1 < feet.len() && from[piece + 1] < q as f64 {
                piece += 1;
            }
            let off = q as f64 - feet[piece] as f64;
            off * off + values[feet[piece]]
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::ground::{Ground, Profile, Terrace};

    const EXTENT: (f64, f64) = (20.0, 0.2);

    fn about(world: &World) -> TruthGrid {
        TruthGrid::about(world, &Isometry3::identity(), 0.0, EXTENT, &Limits::default())
    }

    /// A fence right round the vehicle, 12 m to each side, with an opening of this width ahead.
    fn ring_with_gate(width: f64) -> World {
        let (side, gate) = (12.0, width / 2.0);
        World::on(Ground::default()).fence(
            &[[side, gate], [side, side], [-side, side], [-side, -side], [side, -side], [side, -gate]],
            1.5,
            Some(crate::scene::world::SLATS),
        )
    }

    #[test]
    fn behind_a_fence_is_reached_through_a_wide_gate_only() {
        assert_eq!(about(&ring_with_gate(4.0)).class_at(15.0, 0.0), Truth::Drivable);
        assert_eq!(about(&ring_with_gate(2.0)).class_at(15.0, 0.0), Truth::Tight);
        // The vehicle is 1.8 m wide; the raster leaves 0.4 m below that undecided.
        for width in [1.35, 0.6] {
            let narrow = about(&ring_with_gate(width));
            assert_eq!(narrow.class_at(15.0, 0.0), Truth::Unreachable, "opening of {width} m");
            assert_eq!(narrow.class_at(11.0, 0.0), Truth::Drivable, "before the opening of {width} m");
        }
        let closed = about(&ring_with_gate(0.0));
        assert_eq!(closed.class_at(15.0, 0.0), Truth::Unreachable);
        assert_eq!(closed.class_at(12.0, 5.0), Truth::Obstacle);
        assert_eq!(closed.class_at(5.0, 5.0), Truth::Drivable);
        assert_eq!(closed.class_at(25.0, 0.0), Truth::Outside);
    }

    #[test]
    fn a_beam_is_an_overhang_below_the_clearance_and_an_obstacle_lower_only() {
        let undersides =
            [(0.9, Truth::Obstacle), (1.6, Truth::Overhang), (2.4, Truth::Overhang), (2.6, Truth::Drivable)];
        for (underside, expected) in undersides {
            let world = World::on(Ground::default()).beam([8.0, -3.0], [8.0, 3.0], underside, underside + 0.5);
            assert_eq!(about(&world).class_at(8.0, 0.0), expected, "underside {underside}");
        }
    }

    #[test]
    fn a_kerb_is_climbed_and_a_ledge_is_not() {
        for (rise, expected) in [(0.15, Truth::Drivable), (0.4, Truth::Unreachable), (-0.4, Truth::Unreachable)] {
            let terrace =
                Terrace { centre: [10.0, 0.0], half: [4.0, 4.0], corner: 1.0, outside: false, rise, reflectivity: 0 };
            let world = World::on(Ground { terraces: vec![terrace], ..Ground::default() });
            assert_eq!(about(&world).class_at(10.0, 0.0), expected, "rise {rise}");
        }
    }

    #[test]
    fn a_furrow_is_driven_over_and_a_ditch_is_not() {
        let trench = |depth: f64| {
            let across =
                Profile::through(&[(4.0, 0.0), (4.0 + depth, -depth), (4.3 + depth, -depth), (4.3 + 2.0 * depth, 0.0)]);
            about(&World::on(Ground { across, ..Ground::default() })).class_at(0.0, 10.0)
        };
        assert_eq!([trench(0.05), trench(0.15), trench(0.6)], [Truth::Drivable, Truth::Drivable, Truth::Unreachable]);
    }

    #[test]
    fn a_ramp_is_drivable_and_a_bank_is_not() {
        let ramp = |rise| World::on(Ground { along: Profile::default().ramp(5.0, 15.0, rise), ..Ground::default() });
        assert_eq!(about(&ramp(1.5)).class_at(17.0, 0.0), Truth::Drivable);
        let bank = about(&ramp(5.0));
        assert_eq!(bank.class_at(10.0, 0.0), Truth::Steep);
        assert_eq!(bank.class_at(17.0, 0.0), Truth::Unreachable);
    }

    #[test]
    fn distances_equal_those_of_a_search_through_all_cells() {
        let side = 17;
        for seed in 0..20 {
            let open: Vec<bool> =
                (0..side * side).map(|cell| crate::noise::uniform(seed << 32 | cell as u64) > 0.05).collect();
            let distances = squared_distance(&open, side);
            for (cell, distance) in distances.into_iter().enumerate() {
                let nearest = (0..side * side).filter(|&other| !open[other]).map(|other| {
                    let (dx, dy) = ((cell % side).abs_diff(other % side), (cell / side).abs_diff(other / side));
                    (dx * dx + dy * dy) as f64
                });
                let nearest = nearest.fold((4 * side * side) as f64, f64::min);
                assert_eq!(distance, nearest, "seed {seed} cell {cell}");
            }
        }
    }
}

//! Straight edges of the ground, continued beyond the place where returns show them.
//!
//! In: the cells beside a step of the ground or in a trough, the obstacles, and the height of the ground in the cells
//! with a return. Out: the cells on the continuation of each straight edge near the vehicle: a kerb, a bank, a ditch.
//! Such an edge is seen near the vehicle; farther away rings lie so far apart that no return shows a step, but the edge
//! still goes on. The continuation ends where a ring crosses it over even ground; the continuation of the side of an
//! obstacle, such as a parked car, also where it lies across the view and the ground before and behind it is even.

use std::f32::consts::PI;

use super::bits::Bits;
use super::blind_zone::{VEHICLE_M, is_of_ground};
use super::cells::{CELL_M, NOWHERE, SIDE, cell, centre_m};
use super::obstacles::Obstacles;

/// Greatest distance of a step from the vehicle, metres. Ours; 12 to 20 are nearly
/// equal on the even seeds of the random worlds.
const RANGE_M_MAX: f32 = 15.0;
/// Height over the ground up to which an obstacle may be the face of a kerb, metres. Ours; higher than raised beds.
const LOW_M_MAX: f32 = 0.7;
/// Least length of an edge, metres. Ours: 4 to 7 are nearly equal, as above.
const LENGTH_M_MIN: f32 = 5.0;
/// Largest gap in an edge, metres. Ours: rings of 32 lasers lie so far apart at the greatest distance.
const GAP_M_MAX: f32 = 2.5;
/// Greatest number of edges that are continued. Ours: two on each side of a road.
const EDGES: usize = 4;
/// Number of directions, and width of a line, metres, with which edges are sought. Ours: a line as long as an edge
/// stays in its width, whatever its direction is.
const DIRECTIONS: usize = 60;
const LINE_M: f32 = 0.5;
/// Number of parallel lines.
const LINES: usize = 2 * (RANGE_M_MAX / LINE_M) as usize + 1;
/// Number of cells across an edge that must be even, and seen, for the edge to end. Ours: less than the hidden side of
/// a ditch and its floor.
const ACROSS: usize = 7;
/// Largest deviation of these cells from a straight rise, metres, and its largest slope. Ours: 0.12 and 0.2 are nearly
/// equal, as above; no step is so flat.
const EVEN_M_MAX: f32 = 0.12;
const EVEN_SLOPE_MAX: f32 = 0.3;
/// Greatest number of unseen cells in a row, of those across an edge of obstacles that lies across the view, for it to
/// end. Ours: near the vehicle the rings of 64 lasers lie no farther apart. Looked at on a KITTI scan with a parked
/// car, whose continuation closed the road; on the random worlds it changes nothing.
const UNSEEN_MAX: usize = 2;
/// Least sine of the angle between the view and an edge that lies across it. Ours: rings run beside such an edge.
const ACROSS_VIEW_MIN: f32 = 0.9;

/// Finds the edges and continues them. It reuses its buffers.
#[derive(Clone)]
pub struct Edges {
    /// By direction: sine and cosine of its angle to x.
    directions: Vec<[f32; 2]>,
    /// The cells beside a step that no edge contains.
    places: Vec<Place>,
    /// By direction and line: number of these places on it.
    votes: Vec<u16>,
    /// The places that the newest edge takes, or those it leaves while its votes are counted.
    taken: Vec<Place>,
    /// Places on a line: distance along it and across it.
    on_line: Vec<Place>,
}

/// A place of an edge.
#[derive(Clone, Copy)]
struct Place {
    /// Coordinates, metres.
    at_m: [f32; 2],
    /// True for the face of an obstacle, false beside a step of the ground.
    is_obstacle: bool,
}

/// A straight edge.
struct Edge {
    /// A place on it, and its direction, of length 1.
    place_m: [f32; 2],
    direction: [f32; 2],
    /// Distances of its two ends from that place, metres.
    ends_m: [f32; 2],
    /// True if most of its places are faces of obstacles.
    is_of_obstacles: bool,
}

impl Edges {
    /// No edges.
    pub fn new() -> Self {
        let angle = |direction: usize| libm::sincosf(direction as f32 * PI / DIRECTIONS as f32);
        Self {
            directions: (0..DIRECTIONS).map(angle).map(|(sin, cos)| [sin, cos]).collect(),
            places: Vec::new(),
            votes: vec![0; DIRECTIONS * LINES],
            taken: Vec::new(),
            on_line: Vec::new(),
        }
    }

    /// Calls `mark` with column and row of each cell on the continuation of an edge. `ground_m` is the height of the
    /// ground in a cell with a return from it.
    pub fn find(
        &mut self,
        beside_step: &Bits,
        obstacles: &Obstacles,
        ground_m: impl Fn(usize) -> Option<f32>,
        mut mark: impl FnMut(usize, usize),
    ) {
        self.places.clear();
        let mut add = |ix: usize, iy: usize, is_obstacle: bool| {
            let at_m @ [x, y] = centre_m(iy * SIDE + ix);
            let is_near = x * x + y * y < RANGE_M_MAX * RANGE_M_MAX && y.abs() > VEHICLE_M;
            if is_near && is_of_ground(ix, iy, |cell| obstacles.height_m(cell)) {
                self.places.push(Place { at_m, is_obstacle });
            }
        };
        beside_step.each(|ix, iy| add(ix, iy, false));
        // The face of a kerb that is higher than the obstacles the vehicle drives over.
        let low = obstacles.cells().filter(|(cell, span_m)| span_m[1] < LOW_M_MAX && ground_m(*cell).is_some());
        for (ix, iy) in low.map(|(cell, _)| (cell % SIDE, cell / SIDE)).filter(|(ix, iy)| !beside_step.get(*ix, *iy)) {
            add(ix, iy, true);
        }
        self.votes.fill(0);
        self.count(|votes| *votes += 1);
        for _ in 0..EDGES {
            let Some((direction, line)) = self.best_line() else { break };
            self.take(direction, line);
            if let Some(edge) = self.fit(direction) {
                edge.continue_from(0, &ground_m, &mut mark);
                edge.continue_from(1, &ground_m, &mut mark);
            }
        }
    }

    /// Changes the votes of the lines on which each place lies.
    fn count(&mut self, change: impl Fn(&mut u16)) {
        for place in &self.places {
            for (direction, sin_cos) in self.directions.iter().enumerate() {
                change(&mut self.votes[direction * LINES + line(across_m(*sin_cos, place.at_m))]);
            }
        }
    }

    /// Direction and line with the most places; `None` if they are fewer than half the cells of the shortest edge.
    fn best_line(&self) -> Option<(usize, usize)> {
        let most = self.votes.iter().copied().max().filter(|most| f32::from(*most) >= LENGTH_M_MIN / CELL_M / 2.0)?;
        let best = self.votes.iter().position(|votes| *votes == most)?;
        Some((best / LINES, best % LINES))
    }

    /// Moves the places on a line and its two neighbours to `on_line`, in the order along it.
    fn take(&mut self, direction: usize, best: usize) {
        let sin_cos @ [sin, cos] = self.directions[direction];
        let is_on = |place: &Place| line(across_m(sin_cos, place.at_m)).abs_diff(best) <= 1;
        self.taken.clear();
        self.taken.extend(self.places.iter().copied().filter(is_on));
        self.places.retain(|place| !is_on(place));
        std::mem::swap(&mut self.places, &mut self.taken);
        self.count(|votes| *votes -= 1);
        self.on_line.clear();
        self.on_line.extend(self.places.iter().map(|place| {
            let [x, y] = place.at_m;
            Place { at_m: [cos * x + sin * y, across_m(sin_cos, [x, y])], ..*place }
        }));
        self.on_line.sort_by(|a, b| a.at_m[0].total_cmp(&b.at_m[0]));
        std::mem::swap(&mut self.places, &mut self.taken);
    }

    /// The edge through the longest run of places on a line without a gap; `None` if it is too short.
    fn fit(&self, direction: usize) -> Option<Edge> {
        let runs = self.on_line.chunk_by(|a, b| b.at_m[0] - a.at_m[0] <= GAP_M_MAX);
        let length_m = |run: &[Place]| run[run.len() - 1].at_m[0] - run[0].at_m[0];
        let run =
            runs.max_by(|a, b| length_m(a).total_cmp(&length_m(b))).filter(|run| length_m(run) >= LENGTH_M_MIN)?;
        let mean = [0, 1].map(|axis| run.iter().map(|place| place.at_m[axis]).sum::<f32>() / run.len() as f32);
        let product = |axis: usize| {
            run.iter().map(|Place { at_m, .. }| (at_m[0] - mean[0]) * (at_m[axis] - mean[axis])).sum::<f32>()
        };
        // The line of least squares; it is longer than wide, so that its places differ along it.
        let slope = product(1) / product(0);
        let norm = (1.0 + slope * slope).sqrt();
        let [sin, cos] = self.directions[direction];
        let turned = |[along, across]: [f32; 2]| [cos * along - sin * across, sin * along + cos * across];
        let of_obstacles = run.iter().filter(|place| place.is_obstacle).count();
        Some(Edge {
            place_m: turned(mean),
            direction: turned([1.0 / norm, slope / norm]),
            ends_m: [run[0], run[run.len() - 1]].map(|end| (end.at_m[0] - mean[0]) * norm),
            is_of_obstacles: of_obstacles * 2 > run.len(),
        })
    }
}

impl Edge {
    /// Calls `mark` with the cells beyond one end, up to the next crossing over even ground or the end of the grid.
    fn continue_from(&self, end: usize, ground_m: impl Fn(usize) -> Option<f32>, mut mark: impl FnMut(usize, usize)) {
        let step_m = if end == 0 { -CELL_M } else { CELL_M };
        for step in 1..SIDE {
            let along_m = self.ends_m[end] + step as f32 * step_m;
            let [x, y] = self.at(along_m, 0.0);
            let cell = cell(x, y);
            if cell == NOWHERE || self.crosses_even_ground(along_m, &ground_m) {
                return;
            }
            mark(cell as usize % SIDE, cell as usize / SIDE);
        }
    }

    /// The place so far along the edge and to its left, metres.
    fn at(&self, along_m: f32, left_m: f32) -> [f32; 2] {
        let ([x, y], [dx, dy]) = (self.place_m, self.direction);
        [x + along_m * dx - left_m * dy, y + along_m * dy + left_m * dx]
    }

    /// True if ground was seen right across the edge, and rises evenly.
    fn crosses_even_ground(&self, along_m: f32, ground_m: impl Fn(usize) -> Option<f32>) -> bool {
        let ([x, y], [dx, dy]) = (self.at(along_m, 0.0), self.direction);
        let is_across_view = (x * dy - y * dx).abs() > ACROSS_VIEW_MIN * libm::hypotf(x, y);
        let unseen_max = if self.is_of_obstacles && is_across_view { UNSEEN_MAX } else { 0 };
        // Distance across the edge and height of the cells that were seen.
        let mut seen_m = [[0.0; 2]; ACROSS];
        let (mut count, mut unseen) = (0, 0);
        for number in 0..ACROSS {
            let left_m = (number as f32 - (ACROSS / 2) as f32) * CELL_M;
            // Rings cross at an angle.
            let near = [0.0, -CELL_M, CELL_M].map(|shift_m| self.at(along_m + shift_m, left_m));
            let seen = |[x, y]: [f32; 2]| Some(cell(x, y)).filter(|cell| *cell != NOWHERE).map(|cell| cell as usize);
            match near.into_iter().filter_map(seen).find_map(&ground_m) {
                Some(found) => {
                    seen_m[count] = [left_m, found];
                    (count, unseen) = (count + 1, 0);
                }
                None if unseen == unseen_max => return false,
                None => unseen += 1,
            }
        }
        if count < 2 {
            return false;
        }
        let seen_m = &seen_m[..count];
        let [first, last] = [seen_m[0], seen_m[count - 1]];
        let slope = (last[1] - first[1]) / (last[0] - first[0]);
        let rest = |[across_m, height_m]: &[f32; 2]| height_m - slope * across_m;
        let span = seen_m
            .iter()
            .map(rest)
            .fold([f32::INFINITY, f32::NEG_INFINITY], |[low, high], rest| [low.min(rest), high.max(rest)]);
        span[1] - span[0] < EVEN_M_MAX && slope.abs() < EVEN_SLOPE_MAX
    }
}

/// Distance of a place to the left of the line through the origin in a direction, metres.
fn across_m([sin, cos]: [f32; 2], [x, y]: [f32; 2]) -> f32 {
    cos * y - sin * x
}

/// The line at a distance from the line through the origin.
fn line(across_m: f32) -> usize {
    ((across_m + RANGE_M_MAX) / LINE_M) as usize
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Bits of cells with these places.
    fn cells(places: impl Iterator<Item = [f32; 2]>) -> Bits {
        let mut bits = Bits::square(SIDE);
        for [x, y] in places {
            let cell = cell(x, y) as usize;
            bits.set(cell % SIDE, cell / SIDE);
        }
        bits
    }

    /// Places each quarter of a metre from x = `from` to `to`, on a line through y = 6.1 with this slope.
    fn line(from: f32, to: f32, slope: f32) -> impl Iterator<Item = [f32; 2]> {
        let steps = ((to - from) / CELL_M) as usize;
        (0..steps).map(move |step| from + step as f32 * CELL_M).map(move |x| [x, 6.1 + slope * x])
    }

    /// Least and greatest x of the continuation of these cells; `ground_m` is the ground in cells with a return.
    fn continued(
        beside_step: &Bits,
        obstacles: &Obstacles,
        ground_m: impl Fn([f32; 2]) -> Option<f32>,
    ) -> Option<[f32; 2]> {
        let (mut edges, mut found) = (Edges::new(), Vec::new());
        let ground_m = |cell: usize| ground_m(centre_m(cell));
        edges.find(beside_step, obstacles, ground_m, |ix, iy| found.push(centre_m(iy * SIDE + ix)[0]));
        let found = found.into_iter();
        (found.len() > 0).then(|| found.fold([f32::MAX, f32::MIN], |[low, high], x| [low.min(x), high.max(x)]))
    }

    #[test]
    fn a_straight_edge_goes_on_to_the_end_of_the_grid_and_a_short_one_does_not() {
        let none = |_: [f32; 2]| None;
        for slope in [0.0, 0.1, -0.3] {
            let [low, high] = continued(&cells(line(-8.0, 8.0, slope)), &Obstacles::new(), none).unwrap();
            assert!(low < -60.0 && high > 60.0, "{slope}: {low} to {high}");
        }
        assert_eq!(continued(&cells(line(-2.0, 2.0, 0.0)), &Obstacles::new(), none), None, "4 m");
        let gap = line(-6.0, -2.0, 0.0).chain(line(2.0, 6.0, 0.0));
        assert_eq!(continued(&cells(gap), &Obstacles::new(), none), None, "two of 4 m, 4 m apart");
        let under = line(-8.0, 8.0, 0.0).map(|[x, y]| [x, y - 5.9]);
        assert_eq!(continued(&cells(under), &Obstacles::new(), none), None, "under the vehicle");
    }

    #[test]
    fn an_edge_ends_where_a_ring_crosses_it_over_even_ground() {
        let steps = cells(line(-8.0, 8.0, 0.0));
        // A ring 20 m ahead; what it shows to the left of the edge.
        let end = |left_m: fn([f32; 2]) -> Option<f32>| {
            let ring = |[x, y]: [f32; 2]| if (x - 20.0).abs() < 0.2 { left_m([x, y]) } else { None };
            continued(&steps, &Obstacles::new(), ring).unwrap()[1]
        };
        let even = end(|[_, y]| Some(0.1 * y));
        assert!((19.0..20.0).contains(&even), "even ground: {even}");
        assert!(end(|[_, y]| Some(if y > 6.1 { 0.3 } else { 0.0 })) > 60.0, "a kerb");
        assert!(end(|[_, y]| (y < 6.1).then_some(0.0)) > 60.0, "nothing behind the edge");
        assert!(end(|[_, y]| Some(0.5 * y)) > 60.0, "a slope as steep as a step");
    }

    #[test]
    fn low_faces_are_edges_and_tall_obstacles_are_none() {
        let obstacles = |heights_m: [f32; 2]| {
            let mut obstacles = Obstacles::new();
            line(-8.0, 8.0, 0.0)
                .for_each(|[x, y]| heights_m.iter().for_each(|height| obstacles.add_point(cell(x, y), *height)));
            obstacles
        };
        let on_face = |[_, y]: [f32; 2]| ((6.0..6.25).contains(&y)).then_some(0.0);
        let none = Bits::square(SIDE);
        assert!(continued(&none, &obstacles([0.3, 0.6]), on_face).is_some(), "the face of a raised bed");
        assert_eq!(continued(&none, &obstacles([0.3, 0.6]), |_| None), None, "without ground at its foot");
        assert_eq!(continued(&none, &obstacles([0.3, 1.5]), on_face), None, "a wall");
        assert_eq!(continued(&cells(line(-8.0, 8.0, 0.0)), &obstacles([0.3, 1.5]), on_face), None, "steps at a wall");
    }

    #[test]
    fn the_side_of_a_parked_car_closes_no_even_ground_that_rings_run_along() {
        let side = || (0..28).map(|step| [12.1, 3.1 + step as f32 * CELL_M]);
        let mut car = Obstacles::new();
        side().for_each(|[x, y]| [0.3, 0.6].iter().for_each(|height| car.add_point(cell(x, y), *height)));
        // Rings that show each third row of cells, and the foot of the car; what lies behind its side is so high.
        let least_y = |steps: &Bits, obstacles: &Obstacles, behind_m: f32| {
            let ground_m = |[x, y]: [f32; 2]| {
                let is_ring = (x / CELL_M).floor().rem_euclid(3.0) == 0.0;
                (is_ring || (y > 3.0 && (x - 12.1).abs() < 0.2)).then_some(if x > 12.2 { behind_m } else { 0.0 })
            };
            let (mut edges, mut least) = (Edges::new(), f32::MAX);
            let ground_m = |cell: usize| ground_m(centre_m(cell));
            edges.find(steps, obstacles, ground_m, |ix, iy| least = least.min(centre_m(iy * SIDE + ix)[1]));
            least
        };
        let none = Bits::square(SIDE);
        assert!(least_y(&none, &car, 0.0) > 2.0, "even ground");
        assert!(least_y(&none, &car, 0.3) < -2.0, "a kerb behind it");
        assert!(least_y(&cells(side()), &Obstacles::new(), 0.0) < -60.0, "a step of the ground may be a ditch");
    }
}

//! A layer of a map, and points whose truth is known -> counts that can be summed over frames, and precision and
//! recall.
//!
//! In: a [`Layer`] and [`Point`]s, both in the ego frame of one stamp. Out: a [`Tally`]. This file does not depend on
//! where the truth comes from (labels or a simulated world).
//!
//! The points in a cell vote for its truth; points more than 2.5 m above the ground do not vote. A point of an obstacle
//! makes the cell an obstacle. Otherwise the most frequent of forbidden, either and drivable wins, and in a tie the one
//! named first here. Precision is the share of the cells called drivable, and seen by a point, that are neither
//! obstacle nor forbidden. Recall is the share of the drivable cells that are called drivable. A point is called ground
//! if its cell is called drivable and it lies at most [`GROUND_OVER_LOWEST_M`] above the cell's lowest point. Points
//! outside the layer's grid are not scored.

use std::collections::{BTreeMap, BTreeSet};

use clearway_mapping::layer::radial_grid::RadialGrid;
use clearway_mapping::layer::{Cells, ClassInfo, Geometry, Layer, Meaning};

/// Least height of an obstacle above the ground, in metres.
pub const OBSTACLE_M_MIN: f32 = 0.3;
/// Greatest height of an obstacle above the ground, in metres; a vehicle passes under higher things.
pub const OBSTACLE_M_MAX: f32 = 2.5;
/// Greatest height of a ground point above the lowest point of its cell, in metres.
pub const GROUND_OVER_LOWEST_M: f32 = 0.3;

/// The vote of a point for the truth of its cell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Vote {
    /// No vote: the point is too high, or its class is not known.
    Nothing,
    /// The cell was seen; the point does not decide what its ground is.
    Seen,
    /// Ground where no vehicle may drive: too steep, or not reachable.
    Forbidden,
    /// Ground for which both answers count as correct.
    Either,
    /// Ground that a vehicle can reach and drive on.
    Drivable,
    /// An obstacle.
    Obstacle,
}

/// True class of a point (ground or not), as one protocol scores it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scored {
    /// The point is ground.
    Ground,
    /// The point is not ground.
    Other,
    /// The protocol does not score the point.
    Not,
}

/// A point and its truth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// Position in the ego frame, in metres.
    pub place: [f32; 3],
    /// Name of its class, under which its leaks are counted: `car`, `unreachable`, ...
    pub class: &'static str,
    /// Its vote for the truth of its cell.
    pub vote: Vote,
    /// True if it is on a road or a lane marking.
    pub road: bool,
    /// Its true class, by the protocols of [`super::report::PROTOCOLS`] in their order.
    pub ground: [Scored; 2],
}

/// Counts of correct and wrong answers to one yes-or-no question.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Confusion {
    /// Number of true positives.
    pub right: u64,
    /// Number of false positives.
    pub wrong: u64,
    /// Number of false negatives.
    pub missed: u64,
}

/// Counts of one layer, summed over frames.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Tally {
    /// Number of frames judged.
    pub frames: u64,
    /// Number of cells called drivable that a point has seen.
    pub called: u64,
    /// Number of cells called drivable that are obstacle or forbidden.
    pub called_wrongly: u64,
    /// Number of cells called drivable that have a point of an obstacle.
    pub leaking: u64,
    /// Number of drivable cells, and of those among them that are called drivable.
    pub drivable: (u64, u64),
    /// Number of road cells without obstacle, and of those among them that are called drivable.
    pub road: (u64, u64),
    /// Number of cells called drivable that have a point of an obstacle or of forbidden ground, by class of the point.
    pub leaks: BTreeMap<&'static str, u64>,
    /// Counts of ground points, by protocol.
    pub points: [Confusion; 2],
}

impl Confusion {
    /// Precision = TP / (TP + FP); `None` without positives.
    pub fn precision(&self) -> Option<f64> {
        share(self.right, self.right + self.wrong)
    }

    /// Recall = TP / (TP + FN); `None` if nothing is true.
    pub fn recall(&self) -> Option<f64> {
        share(self.right, self.right + self.missed)
    }

    /// F1 = harmonic mean of precision and recall; `None` without one of them.
    pub fn f1(&self) -> Option<f64> {
        f1(self.precision(), self.recall())
    }
}

impl Tally {
    /// Share of the cells called drivable that are neither obstacle nor forbidden; `None` if no cell is called
    /// drivable.
    pub fn precision(&self) -> Option<f64> {
        share(self.called - self.called_wrongly, self.called)
    }

    /// Share of the drivable cells that are called drivable; `None` if no cell is drivable.
    pub fn recall(&self) -> Option<f64> {
        share(self.drivable.1, self.drivable.0)
    }

    /// F1 = harmonic mean of precision and recall; `None` without one of them.
    pub fn f1(&self) -> Option<f64> {
        f1(self.precision(), self.recall())
    }

    /// Share of the road cells that are called drivable; `None` without road cells.
    pub fn road_recall(&self) -> Option<f64> {
        share(self.road.1, self.road.0)
    }

    /// Adds the counts of `layer` against the points of its frame. Returns `false` and adds nothing if none of its
    /// classes is free.
    pub fn add(&mut self, layer: &Layer, points: &[Point]) -> bool {
        let Some(called) = called(layer) else { return false };
        let cell_of = locate(&layer.geometry);
        let cells: Vec<Option<usize>> = points.iter().map(|point| cell_of(point.place)).collect();
        let mut ballots = vec![Ballot::default(); called.len()];
        for (point, cell) in points.iter().zip(&cells).filter_map(|(point, cell)| Some((point, (*cell)?))) {
            ballots[cell].cast(point);
        }
        self.frames += 1;
        for (ballot, called) in ballots.iter().zip(&called) {
            self.add_cell(ballot, *called);
        }
        let mut leaking: BTreeSet<(&'static str, usize)> = BTreeSet::new();
        for (point, cell) in points.iter().zip(&cells).filter_map(|(point, cell)| Some((point, (*cell)?))) {
            let near_ground = point.place[2] - ballots[cell].lowest <= GROUND_OVER_LOWEST_M;
            let ground = called[cell] && near_ground;
            for (confusion, scored) in self.points.iter_mut().zip(point.ground) {
                confusion.right += u64::from(ground && scored == Scored::Ground);
                confusion.wrong += u64::from(ground && scored == Scored::Other);
                confusion.missed += u64::from(!ground && scored == Scored::Ground);
            }
            // Forbidden ground is a leak only if the cell is forbidden by vote; an obstacle always is one.
            let forbidden = point.vote == Vote::Forbidden && ballots[cell].verdict() == Some(Vote::Forbidden);
            if called[cell] && (point.vote == Vote::Obstacle || forbidden) {
                leaking.insert((point.class, cell));
            }
        }
        leaking.into_iter().for_each(|(class, _)| *self.leaks.entry(class).or_default() += 1);
        true
    }

    fn add_cell(&mut self, ballot: &Ballot, called: bool) {
        let verdict = ballot.verdict();
        let wrong = matches!(verdict, Some(Vote::Obstacle | Vote::Forbidden));
        self.called += u64::from(called && ballot.seen);
        self.called_wrongly += u64::from(called && wrong);
        self.leaking += u64::from(called && verdict == Some(Vote::Obstacle));
        let drivable = verdict == Some(Vote::Drivable);
        self.drivable.0 += u64::from(drivable);
        self.drivable.1 += u64::from(drivable && called);
        let road = ballot.road && verdict != Some(Vote::Obstacle);
        self.road.0 += u64::from(road);
        self.road.1 += u64::from(road && called);
    }
}

fn share(part: u64, whole: u64) -> Option<f64> {
    (whole > 0).then(|| part as f64 / whole as f64)
}

fn f1(precision: Option<f64>, recall: Option<f64>) -> Option<f64> {
    let (precision, recall) = (precision?, recall?);
    Some(if precision + recall > 0.0 { 2.0 * precision * recall / (precision + recall) } else { 0.0 })
}

/// The votes of the points in one cell.
#[derive(Clone, Copy, Debug)]
struct Ballot {
    seen: bool,
    road: bool,
    obstacle: bool,
    /// Number of votes for forbidden, either and drivable.
    votes: [u32; 3],
    /// z of the lowest point, in metres.
    lowest: f32,
}

impl Default for Ballot {
    fn default() -> Self {
        Self { seen: false, road: false, obstacle: false, votes: [0; 3], lowest: f32::INFINITY }
    }
}

impl Ballot {
    fn cast(&mut self, point: &Point) {
        self.lowest = self.lowest.min(point.place[2]);
        self.seen |= point.vote != Vote::Nothing;
        self.road |= point.road;
        match point.vote {
            Vote::Nothing | Vote::Seen => {}
            Vote::Forbidden => self.votes[0] += 1,
            Vote::Either => self.votes[1] += 1,
            Vote::Drivable => self.votes[2] += 1,
            Vote::Obstacle => self.obstacle = true,
        }
    }

    /// The truth of the cell; `None` without votes.
    fn verdict(&self) -> Option<Vote> {
        let [forbidden, either, drivable] = self.votes;
        match () {
            () if self.obstacle => Some(Vote::Obstacle),
            () if forbidden + either + drivable == 0 => None,
            () if forbidden >= either && forbidden >= drivable => Some(Vote::Forbidden),
            () if either >= drivable => Some(Vote::Either),
            () => Some(Vote::Drivable),
        }
    }
}

/// For each cell, true if its class is free or inferred to be free; `None` if the layer has no such class.
fn called(layer: &Layer) -> Option<Vec<bool>> {
    let passes = |class: &ClassInfo| matches!(class.meaning, Meaning::Free | Meaning::Inferred);
    let passes: Vec<bool> = layer.legend.iter().map(passes).collect();
    let class = layer.channels.iter().find(|channel| channel.name == "class")?;
    if !passes.contains(&true) {
        return None;
    }
    let is = |class: usize| passes.get(class).copied().unwrap_or(false);
    Some(match &class.cells {
        Cells::U8(cells) => cells.iter().map(|cell| is(usize::from(*cell))).collect(),
        Cells::U16(cells) => cells.iter().map(|cell| is(usize::from(*cell))).collect(),
        Cells::I8(cells) => cells.iter().map(|cell| usize::try_from(*cell).is_ok_and(is)).collect(),
    })
}

/// A function that finds the cell of a position in the ego frame, in metres.
fn locate(geometry: &Geometry) -> Box<dyn Fn([f32; 3]) -> Option<usize>> {
    match *geometry {
        Geometry::Radial { ref row_radius_m, columns } => {
            let grid = RadialGrid::new(row_radius_m.clone(), columns);
            Box::new(move |[x, y, _]| grid.cell(x, y))
        }
        Geometry::Cartesian { origin_x_m, origin_y_m, width, height, cell_m, yaw_rad, .. } => {
            Box::new(move |[x, y, _]| {
                let ((x, y), (sin, cos)) = ((f64::from(x), f64::from(y)), yaw_rad.sin_cos());
                let (x, y) = (x * cos - y * sin, x * sin + y * cos);
                let index = |place: f64, origin: f64, cells: u32| {
                    let index = ((place - origin) / f64::from(cell_m)).floor();
                    (index >= 0.0 && index < f64::from(cells)).then_some(index as usize)
                };
                Some(index(y, origin_y_m, height)? * width as usize + index(x, origin_x_m, width)?)
            })
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clearway_mapping::layer::Channel;
    use clearway_mapping::layer::height_difference::class::HeightDifferenceClass;

    /// Four cells of 1 m in a row: drivable, drivable, obstacle, unknown.
    fn layer() -> Layer {
        Layer {
            name: "drivability",
            geometry: Geometry::Cartesian {
                origin_x_m: 0.0,
                origin_y_m: 0.0,
                width: 4,
                height: 1,
                cell_m: 1.0,
                yaw_rad: 0.0,
                first_cell: [0, 0],
            },
            legend: HeightDifferenceClass::LEGEND,
            channels: vec![Channel {
                name: "class",
                unit: "",
                scale: 1.0,
                unknown: 0,
                cells: Cells::U8(vec![1, 1, 2, 0]),
            }],
            planes: Vec::new(),
            points: Vec::new(),
            metrics: Vec::new(),
        }
    }

    fn point(x: f32, z: f32, class: &'static str, vote: Vote) -> Point {
        let ground = match vote {
            Vote::Drivable | Vote::Either | Vote::Forbidden => Scored::Ground,
            Vote::Obstacle => Scored::Other,
            _ => Scored::Not,
        };
        Point { place: [x, 0.5, z], class, vote, road: class == "road", ground: [ground, Scored::Not] }
    }

    #[test]
    fn a_tiny_scene_gets_the_counts_made_by_hand() {
        let points = [
            // Cell 0: road, and grass that is not scored.
            point(0.2, 0.0, "road", Vote::Drivable),
            point(0.4, 0.1, "vegetation", Vote::Seen),
            // Cell 1: road, and a person in it whose feet are near the ground.
            point(1.2, 0.0, "road", Vote::Drivable),
            point(1.3, 0.9, "person", Vote::Obstacle),
            point(1.3, 1.1, "person", Vote::Obstacle),
            // Cell 2: road called obstacle.
            point(2.5, 0.0, "road", Vote::Drivable),
            // Cell 3: terrain in a cell called unknown, and a leaf high above it.
            point(3.5, 0.0, "terrain", Vote::Drivable),
            point(3.5, 4.0, "vegetation", Vote::Nothing),
            // Outside the grid.
            point(9.0, 0.0, "road", Vote::Drivable),
        ];
        let mut tally = Tally::default();
        assert!(tally.add(&layer(), &points));
        assert_eq!((tally.called, tally.called_wrongly, tally.leaking), (2, 1, 1));
        assert_eq!((tally.drivable, tally.road), ((3, 1), (2, 1)));
        assert_eq!(tally.leaks, BTreeMap::from([("person", 1)]), "a cell counts once for a class");
        // Both road points of called cells are ground; the person is too high to be; two ground points are missed.
        assert_eq!(tally.points[0], Confusion { right: 2, wrong: 0, missed: 2 });
        assert_eq!(tally.points[1], Confusion::default());
        assert_eq!((tally.precision(), tally.recall(), tally.road_recall()), (Some(0.5), Some(1.0 / 3.0), Some(0.5)));
        assert_eq!(tally.f1(), Some(0.4));
        assert!(tally.add(&layer(), &points));
        assert_eq!((tally.frames, tally.called, tally.precision()), (2, 4, Some(0.5)));
    }

    #[test]
    fn forbidden_ground_wins_a_tie_and_leaks_by_name() {
        let mut tally = Tally::default();
        let tie = [point(0.2, 0.0, "steep", Vote::Forbidden), point(0.4, 0.0, "road", Vote::Drivable)];
        tally.add(&layer(), &tie);
        assert_eq!((tally.called_wrongly, tally.leaking, tally.drivable), (1, 0, (0, 0)));
        assert_eq!(tally.leaks, BTreeMap::from([("steep", 1)]));
        let mut outvoted = Tally::default();
        let more = [tie[0], tie[1], tie[1], point(1.5, 0.0, "lawn", Vote::Either)];
        outvoted.add(&layer(), &more);
        assert_eq!((outvoted.called, outvoted.called_wrongly, outvoted.drivable), (2, 0, (1, 1)));
        assert!(outvoted.leaks.is_empty());
    }

    #[test]
    fn a_layer_without_a_free_class_is_left_out() {
        let mut tally = Tally::default();
        assert!(!tally.add(&Layer { legend: &[ClassInfo::UNKNOWN; 3], ..layer() }, &[]));
        assert_eq!(tally, Tally::default());
        assert_eq!((tally.precision(), tally.recall(), tally.f1()), (None, None, None));
    }

    #[test]
    fn a_radial_layer_is_judged_in_its_own_cells() {
        let radial = Layer {
            geometry: Geometry::Radial { row_radius_m: vec![1.0], columns: 8 },
            channels: vec![Channel { cells: Cells::U8(vec![1, 0, 0, 0, 0, 0, 0, 0]), ..layer().channels.remove(0) }],
            ..layer()
        };
        let mut tally = Tally::default();
        tally.add(&radial, &[Point { place: [0.5, 0.1, 0.0], ..point(0.0, 0.0, "road", Vote::Drivable) }]);
        assert_eq!((tally.called, tally.drivable), (1, (1, 1)));
    }
}

//! A layer of a map, and points whose truth is known -> counts.
//!
//! In: a [`Layer`] and [`JudgedPoint`]s, both in the ego frame of one stamp. Out: additions to a [`Tally`]. This file
//! does not depend on where the truth comes from (labels or a simulated world).
//!
//! The points in a cell vote for its truth; points more than 2.5 m above the ground do not vote. A point of an obstacle
//! makes the cell an obstacle. Otherwise the most frequent of forbidden, either and drivable wins, and in a tie the
//! answer named first here. Precision is the share of the cells called drivable, and seen by a point, that are neither
//! obstacle nor forbidden. Recall is the share of the drivable cells that are called drivable. A point is called ground
//! if its cell is called drivable and it lies at most [`GROUND_OVER_LOWEST_M`] above the cell's lowest point, or, by an
//! estimate of the ground, if it lies within [`GROUND_OFF_M_MAX`] of that. Points outside the layer's grid are not
//! scored.

use clearway_mapping::layer::radial_grid::RadialGrid;
use clearway_mapping::layer::{Cells, Geometry, Layer, Meaning};

use super::tally::{Tally, band};

/// Least height of an obstacle above the ground, in metres.
pub const OBSTACLE_M_MIN: f32 = 0.3;
/// Greatest height of an obstacle above the ground, in metres; a vehicle passes under higher things.
pub const OBSTACLE_M_MAX: f32 = 2.5;
/// Greatest height of a ground point above the lowest point of its cell, in metres.
pub const GROUND_OVER_LOWEST_M: f32 = 0.3;
/// Greatest distance of a ground point from the estimated ground, above or below it, in metres. Ours, because the
/// published F1 of other methods is compared at this distance.
pub const GROUND_OFF_M_MAX: f32 = 0.2;

/// The vote of a point for the truth of its cell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Vote {
    /// No vote: the point is too high, or its class is not known.
    Nothing,
    /// The cell was seen; the point does not decide what its ground is.
    Seen,
    /// Ground that is too steep to drive on. A map may call it occupied.
    Steep,
    /// Ground that a vehicle cannot reach.
    Forbidden,
    /// Ground for which both answers count as correct.
    Either,
    /// Ground that a vehicle can reach and drive on.
    Drivable,
    /// An obstacle, on which a vehicle cannot drive.
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
pub struct JudgedPoint {
    /// Position in the ego frame, in metres.
    pub place: [f32; 3],
    /// Name of its class, under which its leaks are counted: `car`, `unreachable`, ...
    pub class: &'static str,
    /// Height over the true ground, in metres.
    pub over_m: f32,
    /// Its vote for the truth of its cell.
    pub vote: Vote,
    /// True if it is on a road or a lane marking.
    pub road: bool,
    /// Its true class, by the protocols of [`super::report::PROTOCOLS`] in their order.
    pub ground: [Scored; 2],
}

/// Adds the counts of `layer` against the points of its frame. Returns `false` and adds nothing if none of its classes
/// is free.
pub fn judge(tally: &mut Tally, layer: &Layer, points: &[JudgedPoint]) -> bool {
    let Some(called) = meanings(layer) else { return false };
    let cell_of = locate(&layer.geometry);
    let cells: Vec<Option<usize>> = points.iter().map(|point| cell_of(point.place)).collect();
    let mut classes = Classes::default();
    let mut ballots = vec![Ballot { lowest: f32::INFINITY, ..Ballot::default() }; called.len()];
    for (point, cell) in points.iter().zip(&cells).filter_map(|(point, cell)| Some((point, (*cell)?))) {
        ballots[cell].cast(point, classes.bit(point.class));
    }
    tally.frames += 1;
    for (ballot, called) in ballots.iter().zip(&called).filter(|(ballot, _)| ballot.points > 0) {
        add_cell(tally, ballot, *called, &classes);
    }
    for (point, cell) in points.iter().zip(&cells).filter_map(|(point, cell)| Some((point, (*cell)?))) {
        let near_ground = point.place[2] - ballots[cell].lowest <= GROUND_OVER_LOWEST_M;
        score(tally, point, is_free(called[cell]) && near_ground);
    }
    true
}

/// Adds the counts of an estimate of the ground. `height_over_m` is the height of a position over that ground, in
/// metres; `None` if the estimate does not cover it.
pub fn judge_ground(tally: &mut Tally, points: &[JudgedPoint], height_over_m: impl Fn([f32; 3]) -> Option<f32>) {
    tally.frames += 1;
    for point in points {
        let is_ground = height_over_m(point.place).is_some_and(|height| height.abs() <= GROUND_OFF_M_MAX);
        score(tally, point, is_ground);
    }
}

fn score(tally: &mut Tally, point: &JudgedPoint, called_ground: bool) {
    for (confusion, scored) in tally.points.iter_mut().zip(point.ground) {
        confusion.right += u64::from(called_ground && scored == Scored::Ground);
        confusion.wrong += u64::from(called_ground && scored == Scored::Other);
        confusion.missed += u64::from(!called_ground && scored == Scored::Ground);
    }
}

fn add_cell(tally: &mut Tally, ballot: &Ballot, called: Meaning, classes: &Classes) {
    let (verdict, free) = (ballot.verdict(), is_free(called));
    let wrong = matches!(verdict, Some(Vote::Obstacle | Vote::Forbidden));
    tally.called += u64::from(free && ballot.seen);
    tally.called_wrongly += u64::from(free && wrong);
    tally.leaking += u64::from(free && verdict == Some(Vote::Obstacle));
    let band = band(ballot.range_m / ballot.points as f32);
    if let (Some(band), true) = (band, free && ballot.seen) {
        tally.wrong_by_range[band].add(wrong);
    }
    if verdict == Some(Vote::Drivable) {
        tally.drivable.add(free);
        tally.not_reached.add(called == Meaning::NotReached);
        if let Some(band) = band {
            tally.by_range[band].add(free);
            for class in classes.of(ballot.ground) {
                tally.by_class.entry(class).or_default()[band].add(free);
            }
        }
    }
    if ballot.road && verdict != Some(Vote::Obstacle) {
        tally.road.add(free);
    }
    if ballot.scored_ground && verdict != Some(Vote::Obstacle) && !ballot.steep {
        tally.ground.add(called == Meaning::Occupied);
        if !ballot.mixed {
            tally.pure_ground.add(called == Meaning::Occupied);
        }
    }
    if free {
        // Forbidden ground is a leak only if the cell is forbidden by vote; an obstacle always is one.
        let forbidden = if verdict == Some(Vote::Forbidden) { ballot.forbidden } else { 0 };
        for class in classes.of(ballot.obstacles | forbidden) {
            *tally.leaks.entry(class).or_default() += 1;
        }
    }
}

/// The classes of points by number, so that a cell holds them as bits.
#[derive(Default)]
struct Classes(Vec<&'static str>);

impl Classes {
    /// The bit of a class. The 64th class and all after it share one.
    fn bit(&mut self, class: &'static str) -> u64 {
        let index = self.0.iter().position(|known| *known == class).unwrap_or_else(|| {
            self.0.push(class);
            self.0.len() - 1
        });
        1 << index.min(63)
    }

    fn of(&self, bits: u64) -> impl Iterator<Item = &'static str> {
        self.0
            .iter()
            .copied()
            .enumerate()
            .filter(move |(index, _)| bits >> index.min(&63) & 1 == 1)
            .map(|(_, name)| name)
    }
}

/// The votes of the points in one cell.
#[derive(Clone, Copy, Debug, Default)]
struct Ballot {
    /// Number of points.
    points: u32,
    /// Sum of the points' horizontal distances from the ego origin, in metres.
    range_m: f32,
    seen: bool,
    road: bool,
    steep: bool,
    /// True if a point is ground by the first protocol.
    scored_ground: bool,
    /// True if a point that votes is not ground by the first protocol.
    mixed: bool,
    /// Classes of the points that vote for an obstacle, for forbidden or steep ground, and for other ground.
    obstacles: u64,
    forbidden: u64,
    ground: u64,
    /// Number of votes for forbidden, either and drivable.
    votes: [u32; 3],
    /// z of the lowest point, in metres.
    lowest: f32,
}

impl Ballot {
    fn cast(&mut self, point: &JudgedPoint, class: u64) {
        let [x, y, z] = point.place;
        self.points += 1;
        self.range_m += x.hypot(y);
        self.lowest = self.lowest.min(z);
        self.road |= point.road;
        if point.vote == Vote::Nothing {
            return;
        }
        self.seen = true;
        let is_ground = point.ground[0] == Scored::Ground;
        self.scored_ground |= is_ground;
        self.mixed |= !is_ground;
        match point.vote {
            Vote::Nothing | Vote::Seen => {}
            Vote::Steep | Vote::Forbidden => {
                self.votes[0] += 1;
                self.forbidden |= class;
                self.steep |= point.vote == Vote::Steep;
            }
            Vote::Either | Vote::Drivable => {
                self.votes[if point.vote == Vote::Either { 1 } else { 2 }] += 1;
                self.ground |= class;
            }
            Vote::Obstacle => self.obstacles |= class,
        }
    }

    /// The truth of the cell; `None` without votes.
    fn verdict(&self) -> Option<Vote> {
        let [forbidden, either, drivable] = self.votes;
        match () {
            () if self.obstacles != 0 => Some(Vote::Obstacle),
            () if forbidden + either + drivable == 0 => None,
            () if forbidden >= either && forbidden >= drivable => Some(Vote::Forbidden),
            () if either >= drivable => Some(Vote::Either),
            () => Some(Vote::Drivable),
        }
    }
}

/// True if a map calls a cell of this meaning drivable.
fn is_free(meaning: Meaning) -> bool {
    matches!(meaning, Meaning::Free | Meaning::Inferred)
}

/// What the layer says about each cell; `None` if it has no free class.
pub(super) fn meanings(layer: &Layer) -> Option<Vec<Meaning>> {
    let class = layer.channels.iter().find(|channel| channel.name == "class")?;
    if !layer.legend.iter().any(|class| is_free(class.meaning)) {
        return None;
    }
    let meaning = |class: i32| {
        let class = usize::try_from(class).ok().and_then(|class| layer.legend.get(class));
        class.map_or(Meaning::Unknown, |class| class.meaning)
    };
    Some(match &class.cells {
        Cells::U8(cells) => cells.iter().map(|cell| meaning((*cell).into())).collect(),
        Cells::U16(cells) => cells.iter().map(|cell| meaning((*cell).into())).collect(),
        Cells::I8(cells) => cells.iter().map(|cell| meaning((*cell).into())).collect(),
    })
}

/// A function that finds the cell of a position in the ego frame, in metres.
pub(super) fn locate(geometry: &Geometry) -> Box<dyn Fn([f32; 3]) -> Option<usize>> {
    match *geometry {
        Geometry::Radial { centre_m, ref row_radius_m, columns } => {
            let grid = RadialGrid::new(centre_m, row_radius_m.clone(), columns);
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
    use std::collections::BTreeMap;

    use super::super::tally::{CellCount, Confusion};
    use clearway_mapping::layer::height_difference::class::HeightDifferenceClass;
    use clearway_mapping::layer::{Channel, ClassInfo};

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

    fn point(x: f32, z: f32, class: &'static str, vote: Vote) -> JudgedPoint {
        let ground = match vote {
            Vote::Drivable | Vote::Either | Vote::Forbidden => Scored::Ground,
            Vote::Obstacle => Scored::Other,
            _ => Scored::Not,
        };
        JudgedPoint { place: [x, 0.5, z], over_m: z, class, vote, road: class == "road", ground: [ground, Scored::Not] }
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
        assert!(judge(&mut tally, &layer(), &points));
        assert_eq!((tally.called, tally.called_wrongly, tally.leaking), (2, 1, 1));
        assert_eq!((tally.drivable, tally.road), (CellCount { all: 3, of_them: 1 }, CellCount { all: 2, of_them: 1 }));
        // Cell 2 is ground called occupied; cell 0 has grass in it, so it is not pure.
        assert_eq!(tally.ground, CellCount { all: 3, of_them: 1 });
        assert_eq!(tally.pure_ground, CellCount { all: 2, of_them: 1 });
        assert_eq!(tally.by_range[0], tally.drivable);
        assert_eq!(tally.wrong_by_range[0], CellCount { all: 2, of_them: 1 });
        assert_eq!(tally.by_class["road"][0], CellCount { all: 2, of_them: 1 });
        assert_eq!(tally.by_class["terrain"][0], CellCount { all: 1, of_them: 0 });
        assert_eq!(tally.leaks, BTreeMap::from([("person", 1)]), "a cell counts once for a class");
        // Both road points of called cells are ground; the person is too high to be; two ground points are missed.
        assert_eq!(tally.points[0], Confusion { right: 2, wrong: 0, missed: 2 });
        assert_eq!(tally.points[1], Confusion::default());
        assert_eq!((tally.precision(), tally.recall(), tally.road_recall()), (Some(0.5), Some(1.0 / 3.0), Some(0.5)));
        assert_eq!(tally.f1(), Some(0.4));
        assert!(judge(&mut tally, &layer(), &points));
        assert_eq!((tally.frames, tally.called, tally.precision()), (2, 4, Some(0.5)));
    }

    #[test]
    fn forbidden_ground_wins_a_tie_and_leaks_by_name() {
        let mut tally = Tally::default();
        let tie = [point(0.2, 0.0, "steep", Vote::Forbidden), point(0.4, 0.0, "road", Vote::Drivable)];
        judge(&mut tally, &layer(), &tie);
        assert_eq!((tally.called_wrongly, tally.leaking, tally.drivable), (1, 0, CellCount::default()));
        assert_eq!(tally.leaks, BTreeMap::from([("steep", 1)]));
        let mut outvoted = Tally::default();
        let more = [tie[0], tie[1], tie[1], point(1.5, 0.0, "lawn", Vote::Either)];
        judge(&mut outvoted, &layer(), &more);
        assert_eq!((outvoted.called, outvoted.called_wrongly), (2, 0));
        assert_eq!(outvoted.drivable, CellCount { all: 1, of_them: 1 });
        assert!(outvoted.leaks.is_empty());
    }

    #[test]
    fn a_layer_without_a_free_class_is_left_out() {
        let mut tally = Tally::default();
        assert!(!judge(&mut tally, &Layer { legend: &[ClassInfo::UNKNOWN; 3], ..layer() }, &[]));
        assert_eq!(tally, Tally::default());
        assert_eq!((tally.precision(), tally.recall(), tally.f1()), (None, None, None));
    }

    #[test]
    fn a_radial_layer_is_judged_in_its_own_cells() {
        let radial = Layer {
            geometry: Geometry::Radial { centre_m: [0.0; 2], row_radius_m: vec![1.0], columns: 8 },
            channels: vec![Channel { cells: Cells::U8(vec![1, 0, 0, 0, 0, 0, 0, 0]), ..layer().channels.remove(0) }],
            ..layer()
        };
        let mut tally = Tally::default();
        judge(
            &mut tally,
            &radial,
            &[JudgedPoint { place: [0.5, 0.1, 0.0], ..point(0.0, 0.0, "road", Vote::Drivable) }],
        );
        assert_eq!((tally.called, tally.drivable), (1, CellCount { all: 1, of_them: 1 }));
    }

    #[test]
    fn steep_ground_may_be_called_occupied_and_not_drivable() {
        let mut tally = Tally::default();
        let steep = |x: f32| JudgedPoint { class: "steep", ..point(x, 0.0, "steep", Vote::Steep) };
        judge(&mut tally, &layer(), &[steep(0.5), steep(2.5)]);
        assert_eq!((tally.called_wrongly, tally.ground), (1, CellCount::default()));
        assert_eq!(tally.leaks, BTreeMap::from([("steep", 1)]));
    }

    #[test]
    fn ground_that_is_not_reached_counts_apart_from_occupied_ground() {
        use clearway_mapping::layer::drivability::class::DrivabilityClass;
        let legend = DrivabilityClass::LEGEND;
        let mut layer = Layer { legend, ..layer() };
        let value = |meaning| legend.iter().position(|class| class.meaning == meaning).unwrap() as u8;
        let [free, occupied, not_reached] = [Meaning::Free, Meaning::Occupied, Meaning::NotReached].map(value);
        layer.channels[0].cells = Cells::U8(vec![free, occupied, not_reached, 0]);
        let mut tally = Tally::default();
        let points = [0.5, 1.5, 2.5, 3.5].map(|x| point(x, 0.0, "road", Vote::Drivable));
        judge(&mut tally, &layer, &points);
        assert_eq!(tally.drivable, CellCount { all: 4, of_them: 1 });
        assert_eq!(tally.not_reached, CellCount { all: 4, of_them: 1 });
        assert_eq!(tally.pure_ground, CellCount { all: 4, of_them: 1 });
    }

    #[test]
    fn points_near_the_estimated_ground_are_called_ground() {
        let road = [(1.0, 1.0), (2.0, 1.3), (50.0, 1.0)].map(|(x, z)| point(x, z, "road", Vote::Drivable));
        let car = [(3.0, 0.9), (4.0, 3.0)].map(|(x, z)| point(x, z, "car", Vote::Obstacle));
        let mut tally = Tally::default();
        judge_ground(&mut tally, &[&road[..], &car].concat(), |[x, _, z]| (x < 40.0).then_some(z - 1.0));
        assert_eq!(tally.points[0], Confusion { right: 1, wrong: 1, missed: 2 });
    }
}

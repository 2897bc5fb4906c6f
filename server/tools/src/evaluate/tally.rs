//! Counts of how right a layer is, which can be summed over frames, and the shares that follow from them.

use std::collections::BTreeMap;

/// Bounds of the bands of range by which recall is counted, in metres.
pub const BANDS_M: [f32; 6] = [0.0, 10.0, 20.0, 30.0, 40.0, 60.0];
/// Number of bands.
pub const BANDS: usize = BANDS_M.len() - 1;

/// The band of a range in metres; `None` beyond the last.
pub fn band(range_m: f32) -> Option<usize> {
    (range_m < BANDS_M[BANDS]).then(|| BANDS_M[1..].partition_point(|bound| *bound <= range_m))
}

/// Number of cells of a kind, and of the cells among them for which something is true.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CellCount {
    /// Number of cells of the kind.
    pub all: u64,
    /// Number of cells among them for which it is true.
    pub of_them: u64,
}

impl CellCount {
    /// Counts one cell of the kind.
    pub fn add(&mut self, is_true: bool) {
        self.all += 1;
        self.of_them += u64::from(is_true);
    }

    /// The share for which it is true; `None` without cells of the kind.
    pub fn share(&self) -> Option<f64> {
        share(self.of_them, self.all)
    }

    /// Adds the counts of other cells.
    pub fn merge(&mut self, other: &Self) {
        self.all += other.all;
        self.of_them += other.of_them;
    }
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

    fn merge(&mut self, other: &Self) {
        self.right += other.right;
        self.wrong += other.wrong;
        self.missed += other.missed;
    }
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
    /// Number of cells called drivable that a point has seen, and of obstacle or forbidden cells among them, by band of
    /// range.
    pub wrong_by_range: [CellCount; BANDS],
    /// Number of cells called drivable that have a point of an obstacle.
    pub leaking: u64,
    /// Number of drivable cells, and of cells among them that are called drivable.
    pub drivable: CellCount,
    /// Number of drivable cells, and of cells among them whose class means that they are free and not reached.
    pub not_reached: CellCount,
    /// Number of road cells without obstacle, and of cells among them that are called drivable.
    pub road: CellCount,
    /// Number of cells with ground and without an obstacle, and of cells among them that are called occupied. Ground
    /// that is too steep is left out.
    pub ground: CellCount,
    /// The same for cells in which every point is ground.
    pub pure_ground: CellCount,
    /// `drivable` by band of range.
    pub by_range: [CellCount; BANDS],
    /// `drivable` by class of the ground in the cell and by band of range.
    pub by_class: BTreeMap<&'static str, [CellCount; BANDS]>,
    /// Number of cells called drivable that have a point of an obstacle or of forbidden ground, by class of the point.
    pub leaks: BTreeMap<&'static str, u64>,
    /// Counts of ground points, by protocol.
    pub points: [Confusion; 2],
}

impl Tally {
    /// Share of the cells called drivable that are neither obstacle nor forbidden; `None` if no cell is called
    /// drivable.
    pub fn precision(&self) -> Option<f64> {
        share(self.called - self.called_wrongly, self.called)
    }

    /// Share of the cells called drivable that have no point of an obstacle, whether they can be reached or not; `None`
    /// if no cell is called drivable.
    pub fn free_of_obstacles(&self) -> Option<f64> {
        share(self.called - self.leaking, self.called)
    }

    /// Share of the drivable cells that are called drivable; `None` if no cell is drivable.
    pub fn recall(&self) -> Option<f64> {
        self.drivable.share()
    }

    /// F1 = harmonic mean of precision and recall; `None` without one of them.
    pub fn f1(&self) -> Option<f64> {
        f1(self.precision(), self.recall())
    }

    /// Share of the road cells that are called drivable; `None` without road cells.
    pub fn road_recall(&self) -> Option<f64> {
        self.road.share()
    }

    /// Adds the counts of other frames.
    pub fn merge(&mut self, other: &Self) {
        self.frames += other.frames;
        self.called += other.called;
        self.called_wrongly += other.called_wrongly;
        self.leaking += other.leaking;
        let own = [&mut self.drivable, &mut self.not_reached, &mut self.road, &mut self.ground, &mut self.pure_ground];
        let others = [&other.drivable, &other.not_reached, &other.road, &other.ground, &other.pure_ground];
        own.into_iter().zip(others).for_each(|(own, other)| own.merge(other));
        self.by_range.iter_mut().zip(&other.by_range).for_each(|(own, other)| own.merge(other));
        self.wrong_by_range.iter_mut().zip(&other.wrong_by_range).for_each(|(own, other)| own.merge(other));
        for (class, bands) in &other.by_class {
            let own = self.by_class.entry(class).or_default();
            own.iter_mut().zip(bands).for_each(|(own, other)| own.merge(other));
        }
        for (class, cells) in &other.leaks {
            *self.leaks.entry(class).or_default() += cells;
        }
        self.points.iter_mut().zip(&other.points).for_each(|(own, other)| own.merge(other));
    }
}

fn share(part: u64, whole: u64) -> Option<f64> {
    (whole > 0).then(|| part as f64 / whole as f64)
}

fn f1(precision: Option<f64>, recall: Option<f64>) -> Option<f64> {
    let (precision, recall) = (precision?, recall?);
    Some(if precision + recall > 0.0 { 2.0 * precision * recall / (precision + recall) } else { 0.0 })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_range_is_in_the_band_that_begins_with_it() {
        assert_eq!([0.0, 9.9, 10.0, 35.0, 59.9].map(band), [Some(0), Some(0), Some(1), Some(3), Some(4)]);
        assert_eq!(band(60.0), None);
    }

    #[test]
    fn a_merged_tally_has_the_sums_of_both() {
        let mut tally = Tally { frames: 1, called: 4, called_wrongly: 1, ..Tally::default() };
        tally.drivable.add(true);
        tally.by_class.entry("road").or_default()[2].add(false);
        tally.leaks.insert("car", 1);
        tally.points[1] = Confusion { right: 1, wrong: 2, missed: 3 };
        let mut sum = tally.clone();
        sum.merge(&tally);
        assert_eq!((sum.frames, sum.called, sum.precision()), (2, 8, Some(0.75)));
        assert_eq!((sum.drivable, sum.leaks["car"]), (CellCount { all: 2, of_them: 2 }, 2));
        assert_eq!(sum.by_class["road"][2], CellCount { all: 2, of_them: 0 });
        assert_eq!(sum.points[1], Confusion { right: 2, wrong: 4, missed: 6 });
    }
}

//! A histogram of durations with fixed buckets, for metrics.

use std::time::Duration;

/// Upper bounds of the buckets in seconds, ascending; the last bucket has none. Ours: from the time to encode a small
/// map to a sensor that was silent for a minute.
pub const BOUNDS_S: [f64; 15] =
    [0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 10.0, 60.0];

/// Counts of durations by bucket.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Histogram {
    /// Number of durations in each bucket, the last above every bound.
    counts: [u64; BOUNDS_S.len() + 1],
    sum_s: f64,
}

impl Histogram {
    /// Counts a duration in the first bucket whose bound it does not exceed.
    pub fn observe(&mut self, duration: Duration) {
        let seconds = duration.as_secs_f64();
        let bucket = BOUNDS_S.iter().position(|bound| seconds <= *bound).unwrap_or(BOUNDS_S.len());
        self.counts[bucket] += 1;
        self.sum_s += seconds;
    }

    /// Sum of all durations, in seconds.
    pub fn sum_s(&self) -> f64 {
        self.sum_s
    }

    /// Number of durations.
    pub fn count(&self) -> u64 {
        self.counts.iter().sum()
    }

    /// The upper bound of each bucket, in seconds, and the number of durations up to it.
    pub fn up_to_bounds(&self) -> Vec<(f64, u64)> {
        let mut sum = 0;
        let sums = self.counts.map(|count| {
            sum += count;
            sum
        });
        BOUNDS_S.into_iter().chain([f64::INFINITY]).zip(sums).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_duration_is_in_the_first_bucket_that_is_wide_enough() {
        let mut histogram = Histogram::default();
        [0.5, 1.0, 99.0, 70_000.0].iter().for_each(|ms| histogram.observe(Duration::from_secs_f64(ms / 1e3)));
        let [below, first, .., last, all] = histogram.up_to_bounds()[..] else { panic!("there are buckets") };
        assert_eq!([below, first, last, all], [(0.0005, 1), (0.001, 2), (60.0, 3), (f64::INFINITY, 4)]);
        assert_eq!((histogram.count(), histogram.sum_s()), (4, 70.1005));
    }
}

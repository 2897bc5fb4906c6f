//! Medians and quantiles of values with weights.

/// Standard deviation of a normal distribution over its median absolute deviation.
pub(super) const STD_OF_MEDIAN: f64 = 1.4826;
/// Standard deviation of a normal distribution over the distance between its quartiles.
const STD_OF_QUARTILES: f64 = 0.7413;

/// The first of ascending values at which half of the weight is reached; 0 without values.
pub(super) fn weighted_median(ascending: &[[f64; 2]]) -> f64 {
    weighted_quantile(ascending, 0.5)
}

/// The standard deviation of ascending values with weights, from their quartiles: also if two values alternate.
pub(super) fn weighted_std(ascending: &[[f64; 2]]) -> f64 {
    STD_OF_QUARTILES * (weighted_quantile(ascending, 0.75) - weighted_quantile(ascending, 0.25))
}

/// The first of ascending values at which this share of the weight is reached; 0 without values.
fn weighted_quantile(ascending: &[[f64; 2]], share: f64) -> f64 {
    let least = share * ascending.iter().map(|[_, weight]| weight).sum::<f64>();
    let mut sum = 0.0;
    let reached = |[_, weight]: &&[f64; 2]| {
        sum += weight;
        sum >= least
    };
    ascending.iter().find(reached).map_or(0.0, |[value, _]| *value)
}

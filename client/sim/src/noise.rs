//! Random numbers by key: the same key gives the same number, in any order of calls, on any machine.

/// A well mixed number for each key (the finisher of splitmix64).
pub fn mixed(key: u64) -> u64 {
    let mut z = key.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// Nearly Gaussian, mean 0 and deviation 1, never beyond ±3.47: the sum of four uniform draws (Irwin-Hall), which needs
/// no logarithm and so is the same on every machine.
pub fn gaussian(key: u64) -> f64 {
    let draw = mixed(key);
    let sum: f64 = (0..4).map(|part| ((draw >> (16 * part)) & 0xffff) as f64 + 0.5).sum();
    (sum / 65536.0 - 2.0) * 3.0_f64.sqrt()
}

/// Uniform in [0, 1).
pub fn uniform(key: u64) -> f64 {
    (mixed(key) >> 11) as f64 / (1_u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn draws_have_the_promised_mean_and_deviation() {
        let n = 200_000;
        let (mut sum, mut square, mut even) = (0.0, 0.0, 0.0);
        for key in 0..n {
            let g = gaussian(key);
            sum += g;
            square += g * g;
            even += uniform(key);
        }
        let n = n as f64;
        assert!((sum / n).abs() < 0.01, "mean {}", sum / n);
        assert!((square / n - 1.0).abs() < 0.01, "variance {}", square / n);
        assert!((even / n - 0.5).abs() < 0.005, "uniform mean {}", even / n);
    }
}

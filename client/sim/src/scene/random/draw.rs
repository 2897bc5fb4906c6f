//! A sequence of random numbers for one world: the same seed gives the same numbers on every machine.

use crate::noise::mixed;

/// A sequence of random numbers.
#[derive(Clone, Debug)]
pub(super) struct Draw {
    key: u64,
    drawn: u64,
}

impl Draw {
    /// The sequence of a seed.
    pub fn new(seed: u64) -> Self {
        Self { key: mixed(seed ^ 0x776f_726c_6473), drawn: 0 }
    }

    /// The next number, uniform in [0, 1).
    fn unit(&mut self) -> f64 {
        self.drawn += 1;
        (mixed(self.key ^ self.drawn.rotate_left(32)) >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// A number that is uniform in `[low, high)`.
    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    /// A whole number that is uniform in `[low, high]`.
    pub fn whole(&mut self, low: u32, high: u32) -> u32 {
        low + (self.unit() * f64::from(high - low + 1)) as u32
    }

    /// True with this probability.
    pub fn chance(&mut self, probability: f64) -> bool {
        self.unit() < probability
    }

    /// 1 or -1, with equal probability.
    pub fn sign(&mut self) -> f64 {
        if self.chance(0.5) { 1.0 } else { -1.0 }
    }
}

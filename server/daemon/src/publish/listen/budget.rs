//! What a client may send that costs the server work and carries nothing: so many at once, and so many a second.

use std::time::Instant;

/// A number of messages that may come at once, and that grows by so many a second up to the same number.
#[derive(Debug)]
pub struct Budget {
    most: u32,
    per_second: u32,
    left: u32,
    filled: Instant,
}

impl Budget {
    /// A whole budget.
    pub fn new(most: u32, per_second: u32) -> Self {
        Self { most, per_second, left: most, filled: Instant::now() }
    }

    /// Adds to what is left.
    pub fn add(&mut self, count: u32) {
        self.left = self.left.saturating_add(count).min(self.most);
    }

    /// Takes one message. Returns false if none is left.
    pub fn take(&mut self) -> bool {
        if self.left == 0 {
            self.fill(Instant::now());
        }
        let is_left = self.left > 0;
        self.left = self.left.saturating_sub(1);
        is_left
    }

    /// Adds what the time since the last fill is worth. The clock is read only when the budget is used up.
    fn fill(&mut self, now: Instant) {
        let worth = now.saturating_duration_since(self.filled).as_micros() * u128::from(self.per_second) / 1_000_000;
        if worth > 0 {
            self.filled = now;
            self.add(u32::try_from(worth).unwrap_or(u32::MAX));
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_budget_is_used_up_and_grows_by_its_rate_up_to_its_most() {
        let mut budget = Budget { per_second: 0, ..Budget::new(3, 100) };
        assert_eq!([(); 5].map(|()| budget.take()), [true, true, true, false, false]);
        budget.add(2);
        assert_eq!([(); 3].map(|()| budget.take()), [true, true, false]);
        budget.per_second = 100;
        let start = budget.filled;
        budget.fill(start + Duration::from_millis(9));
        assert_eq!(budget.left, 0, "9 ms are worth less than one");
        budget.fill(start + Duration::from_millis(20));
        assert_eq!(budget.left, 2);
        budget.fill(start + Duration::from_secs(3600));
        assert_eq!(budget.left, 3);
    }
}

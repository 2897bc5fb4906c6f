//! The limit of a rate: what a client may send that costs the server work, and what the server uploads.

use std::time::{Duration, Instant};

/// A token bucket: `most` tokens, refilled at `per_second`.
#[derive(Debug)]
pub struct TokenBucket {
    most: u32,
    per_second: u32,
    left: u32,
    filled: Instant,
}

impl TokenBucket {
    /// A full bucket of `most` tokens, refilled at `per_second` tokens a second.
    pub fn new(most: u32, per_second: u32) -> Self {
        Self { most, per_second, left: most, filled: Instant::now() }
    }

    /// Takes one token. Returns false if none is left.
    pub fn take(&mut self) -> bool {
        if self.left == 0 {
            self.fill(Instant::now());
        }
        let is_left = self.left > 0;
        self.left = self.left.saturating_sub(1);
        is_left
    }

    /// Takes `count` tokens, at most as many as the bucket holds. Returns the time until it has them, and takes
    /// none, if
    /// there are too few.
    pub fn take_many(&mut self, count: u32, now: Instant) -> Option<Duration> {
        self.fill(now);
        match count.checked_sub(self.left).filter(|missing| *missing > 0) {
            Some(missing) => Some(Duration::from_secs(missing.into()) / self.per_second.max(1)),
            None => {
                self.left -= count;
                None
            }
        }
    }

    /// Adds the tokens of the time since the last fill. The clock is read only when the bucket is empty.
    fn fill(&mut self, now: Instant) {
        let tokens = now.saturating_duration_since(self.filled).as_micros() * u128::from(self.per_second) / 1_000_000;
        if tokens > 0 {
            self.filled = now;
            self.left = self.left.saturating_add(u32::try_from(tokens).unwrap_or(u32::MAX)).min(self.most);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_bucket_is_emptied_and_refilled_at_its_rate_up_to_its_most() {
        let mut bucket = TokenBucket { per_second: 0, ..TokenBucket::new(3, 100) };
        assert_eq!([(); 5].map(|()| bucket.take()), [true, true, true, false, false]);
        bucket.per_second = 100;
        let start = bucket.filled;
        bucket.fill(start + Duration::from_millis(9));
        assert_eq!(bucket.left, 0, "9 ms are worth less than one token");
        bucket.fill(start + Duration::from_millis(20));
        assert_eq!(bucket.left, 2);
        bucket.fill(start + Duration::from_secs(3600));
        assert_eq!(bucket.left, 3);
    }
    #[test]
    fn many_tokens_are_taken_at_once_or_after_the_time_that_their_rate_needs() {
        let mut bucket = TokenBucket::new(1000, 500);
        let at = |start: Instant, ms: u64| start + Duration::from_millis(ms);
        let start = bucket.filled;
        assert_eq!(bucket.take_many(1000, start), None);
        assert_eq!(bucket.take_many(100, start), Some(Duration::from_millis(200)));
        assert_eq!(bucket.take_many(100, at(start, 150)), Some(Duration::from_millis(50)));
        assert_eq!(bucket.take_many(100, at(start, 200)), None);
        assert_eq!(bucket.take_many(1000, at(start, 60_000)), None, "no more than it holds");
    }
}

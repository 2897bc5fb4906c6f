//! The minimum-delay filter: the packet of a revolution that the network delayed least.
//!
//! In: the delay of every packet, which is its arrival less its time on the device's timeline. Out: the least delay of
//! a revolution, and the least of ten seconds if the revolutions agree. The network delays a packet by any time, and no
//! packet arrives before it was sent: so the least delay is the best estimate of the offset between both clocks.

use super::timeline::NS_PER_SECOND;

/// Greatest difference, in ns, between the least delays of two revolutions that agree. Networks and schedulers do not
/// delay all packets of a revolution by more.
pub(super) const STEP_NS_MAX: i64 = 500_000_000;
/// Time, in ns, over which drift is measured: at 100 ppm (twice the drift that the HDL-64E S3 manual states) it is 1
/// ms.
const DRIFT_WINDOW_NS: i64 = 10 * NS_PER_SECOND;

/// Least delays of the current revolution and of the current window. Delays are in ns.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct MinimumDelay {
    /// Least delay of the packets since the last revolution ended.
    revolution_ns: Option<i64>,
    window: Option<Window>,
}

/// The least delays of the revolutions of a window.
#[derive(Clone, Copy, Debug)]
struct Window {
    /// Start of the window on the timeline.
    start_ns: i64,
    least_ns: i64,
    greatest_ns: i64,
}

impl MinimumDelay {
    /// Adds the delay of a packet.
    pub fn push(&mut self, delay_ns: i64) {
        self.revolution_ns = Some(self.revolution_ns.map_or(delay_ns, |least| least.min(delay_ns)));
    }

    /// Ends the revolution that began at `first_ns` on the timeline and returns its least delay; `None` without
    /// packets.
    pub fn end_revolution(&mut self, first_ns: i64) -> Option<i64> {
        let delay_ns = self.revolution_ns.take()?;
        let window = Window { start_ns: first_ns, least_ns: delay_ns, greatest_ns: delay_ns };
        let window = self.window.get_or_insert(window);
        window.least_ns = window.least_ns.min(delay_ns);
        window.greatest_ns = window.greatest_ns.max(delay_ns);
        Some(delay_ns)
    }

    /// Ends the window if it is long enough at `first_ns` on the timeline, and returns its least delay; `None` if the
    /// window goes on or its revolutions do not agree.
    pub fn end_window(&mut self, first_ns: i64) -> Option<i64> {
        let window = self.window.take_if(|window| first_ns - window.start_ns > DRIFT_WINDOW_NS)?;
        (window.greatest_ns - window.least_ns <= STEP_NS_MAX).then_some(window.least_ns)
    }
}

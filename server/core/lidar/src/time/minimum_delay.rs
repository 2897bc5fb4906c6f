//! The minimum-delay filter: the packet of a revolution that the network delayed least.
//!
//! In: the delay of every packet, which is its arrival less its time on the device's timeline. Out: the least delay of
//! a revolution, the least of ten seconds if the revolutions agree, and the least of the newest revolutions while they
//! agree. The network delays a packet by any time, and no packet arrives before it was sent: so the least delay is the
//! best estimate of the offset between both clocks.

use super::timeline::NS_PER_SECOND;

/// Greatest difference, in ns, between the least delays of two revolutions that agree. Networks and schedulers do not
/// delay all packets of a revolution by more.
pub(super) const STEP_NS_MAX: i64 = 500_000_000;
/// Time, in ns, over which drift is measured: at 100 ppm (twice the drift that the HDL-64E S3 manual states) it is 1
/// ms.
const DRIFT_WINDOW_NS: i64 = 10 * NS_PER_SECOND;

/// Time, in ns, for which the least delays of revolutions must agree before a clock that is behind the stamps is
/// followed. Ours: stamps are then right again half a second after the clock was set, and the delays of packets that
/// are sent or read in a burst do not agree for so long.
const AGREED_NS: i64 = 350_000_000;
/// Greatest difference, in ns, between the least delays of revolutions that agree on such a clock. Ours: a capture that
/// is sent 1.3 times too fast differs by more.
const AGREED_SPREAD_NS: i64 = 100_000_000;

/// Least delays of the current revolution and of the current window. Delays are in ns.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct MinimumDelay {
    /// The packets since the last revolution ended.
    revolution: Option<Packets>,
    window: Option<DelayWindow>,
    /// The newest revolutions that agree.
    agreed: Option<DelayWindow>,
    /// True if the packets of the newest revolution arrived in a burst.
    is_burst: bool,
}

/// The delays of the packets of one revolution.
#[derive(Clone, Copy, Debug)]
struct Packets {
    least_ns: i64,
    /// Time on the timeline and delay of the first packet.
    first: (i64, i64),
    /// Time on the timeline and delay of the newest packet.
    newest: (i64, i64),
}

/// The least delays of the revolutions of a window.
#[derive(Clone, Copy, Debug)]
struct DelayWindow {
    /// Start of the window on the timeline.
    start_ns: i64,
    least_ns: i64,
    greatest_ns: i64,
}

impl DelayWindow {
    /// The window with one more revolution.
    fn with(self, delay_ns: i64) -> Self {
        Self { least_ns: self.least_ns.min(delay_ns), greatest_ns: self.greatest_ns.max(delay_ns), ..self }
    }
}

impl MinimumDelay {
    /// Adds the delay of a packet that was sent at `time_ns` on the timeline.
    pub fn push(&mut self, time_ns: i64, delay_ns: i64) {
        let packet = (time_ns, delay_ns);
        let packets = self.revolution.get_or_insert(Packets { least_ns: delay_ns, first: packet, newest: packet });
        packets.least_ns = packets.least_ns.min(delay_ns);
        packets.newest = packet;
    }

    /// Ends the revolution that began at `first_ns` on the timeline and returns its least delay; `None` without
    /// packets.
    pub fn end_revolution(&mut self, first_ns: i64) -> Option<i64> {
        let Packets { least_ns: delay_ns, first, newest } = self.revolution.take()?;
        let only = DelayWindow { start_ns: first_ns, least_ns: delay_ns, greatest_ns: delay_ns };
        self.window = Some(self.window.unwrap_or(only).with(delay_ns));
        let agreed = self.agreed.unwrap_or(only).with(delay_ns);
        let agrees = agreed.greatest_ns - agreed.least_ns <= AGREED_SPREAD_NS && agreed.start_ns <= first_ns;
        self.agreed = Some(if agrees { agreed } else { only });
        // Packets that waited somewhere arrive in less than half of the time in which they were sent.
        self.is_burst = 2 * (first.1 - newest.1) > newest.0 - first.0 && newest.0 > first.0;
        Some(delay_ns)
    }

    /// Ends the window if it is long enough at `first_ns` on the timeline, and returns its least delay; `None` if the
    /// window goes on or its revolutions do not agree.
    pub fn end_window(&mut self, first_ns: i64) -> Option<i64> {
        let window = self.window.take_if(|window| first_ns - window.start_ns > DRIFT_WINDOW_NS)?;
        (window.greatest_ns - window.least_ns <= STEP_NS_MAX).then_some(window.least_ns)
    }

    /// Begins the window of drift with the next revolution, because the delays before belong to another offset.
    pub fn restart_window(&mut self) {
        self.window = None;
    }

    /// Least delay of the newest revolutions and the time for which they have agreed at `first_ns` on the timeline, if
    /// that is long enough.
    pub fn agreed(&self, first_ns: i64) -> Option<(i64, i64)> {
        let agreed = self.agreed.map(|agreed| (agreed.least_ns, first_ns - agreed.start_ns));
        agreed.filter(|(_, for_ns)| *for_ns >= AGREED_NS)
    }

    /// True if the packets of the newest revolution arrived in a burst: they waited before they were received, so
    /// their delay is no offset of a clock.
    pub fn is_burst(&self) -> bool {
        self.is_burst
    }
}

//! Which of the packets that did not come were lost.
//!
//! In: every packet's azimuth, and how many were missing before it. Out: an estimate of the packets lost. A sensor with
//! a field of view set sends nothing from its dark sector, turn after turn: a long gap is loss unless the next turn has
//! it too. So a long gap is counted when the sensor has come round, and a short one at once.

use crate::firing::forward;
use crate::model::AZIMUTHS_PER_TURN;
use crate::order::Gap;

/// Gaps shorter than this are no field of view: 15 degrees, counts.
const DARK_MIN: u32 = 1_500;
/// A dark sector's ends lie between packets, so that they move by one, and a loss beside it by another.
const WANDER_PACKETS: u32 = 2;

/// A sector from which nothing came.
#[derive(Clone, Copy, Debug)]
struct Dark {
    from: u32,
    to: u32,
    packets: u32,
}

/// Counts one sensor's lost packets.
#[derive(Clone, Debug, Default)]
pub(crate) struct Loss {
    lost: u64,
    /// A long gap that the next turn will tell of.
    doubtful: Option<Dark>,
    /// The field of view's dark sector.
    dark: Option<Dark>,
    /// Where the packet before ended.
    before: Option<u32>,
}

impl Loss {
    /// Takes a packet with firings at these azimuths that turns `span` counts, and what is missing before it; gives how
    /// many packets may have been lost.
    pub fn take(&mut self, gap: Gap, azimuths: &[u32], span: u32) -> u32 {
        let missing = gap.missing;
        let (Some(&azimuth), Some(&last)) = (azimuths.first(), azimuths.last()) else { return 0 };
        let from = self.before.replace((last + span / azimuths.len() as u32) % AZIMUTHS_PER_TURN).unwrap_or(azimuth);
        let reach = WANDER_PACKETS * span;
        let lights = |dark: &Dark| {
            let inside = forward(dark.from, azimuth);
            (reach..forward(dark.from, dark.to).saturating_sub(reach + span)).contains(&inside)
        };
        if let Some(lost) = self.doubtful.take_if(|dark| lights(dark)) {
            self.lost += u64::from(lost.packets);
        }
        self.dark.take_if(|dark| lights(dark));
        if gap.dark > 0 {
            self.see_dark_inside(azimuths, gap.dark, span);
        }
        if missing == 0 {
            return 0;
        }
        let gap = Dark { from, to: azimuth, packets: missing };
        let long =
            forward(from, azimuth) >= DARK_MIN && u64::from(missing) * u64::from(span) < AZIMUTHS_PER_TURN.into();
        if long && self.doubtful.is_some_and(|dark| gap.is_about(&dark, reach)) {
            self.dark = self.doubtful.take();
        }
        if let Some(dark) = self.dark.filter(|dark| long && gap.holds(dark, reach)) {
            let beside = missing.saturating_sub(dark.packets);
            let lost = if beside > WANDER_PACKETS { beside } else { 0 };
            self.lost += u64::from(lost);
            return lost;
        }
        if long {
            let before = self.doubtful.replace(gap);
            self.lost += before.map_or(0, |dark| u64::from(dark.packets));
        } else {
            self.lost += u64::from(missing);
        }
        missing
    }

    /// The field of view ends and begins again inside a packet: nothing was lost there.
    fn see_dark_inside(&mut self, azimuths: &[u32], packets: u32, span: u32) {
        let steps = azimuths.windows(2).map(|pair| Dark { from: pair[0], to: pair[1], packets });
        let Some(dark) = steps.max_by_key(Dark::width) else { return };
        if dark.width() >= DARK_MIN {
            self.doubtful.take_if(|gap| gap.is_about(&dark, WANDER_PACKETS * span));
            self.dark = Some(dark);
        }
    }

    /// Encoder counts from which and to which the sensor is dark turn after turn; `None` while it was not, twice.
    pub fn dark(&self) -> Option<[u32; 2]> {
        self.dark.map(|dark| [dark.from, dark.to])
    }

    /// Whether nothing but the dark sector lies between firings at two azimuths; a packet turns `span` counts.
    pub fn is_dark(&self, from: u32, to: u32, span: u32) -> bool {
        self.dark.is_some_and(|dark| dark.is_about(&Dark { from, to, packets: 0 }, WANDER_PACKETS * span))
    }

    /// Packets lost so far, and of which it is certain.
    pub fn lost(&self) -> u64 {
        self.lost
    }

    /// The stream has ended: no turn will tell of a doubtful gap.
    pub fn finish(&mut self) {
        self.lost += self.doubtful.take().map_or(0, |dark| u64::from(dark.packets));
        self.before = None;
    }

    /// Nothing is known of what was between the packet before and the next.
    pub fn jump(&mut self) {
        self.before = None;
    }
}

impl Dark {
    fn width(&self) -> u32 {
        forward(self.from, self.to)
    }

    fn is_about(&self, other: &Dark, reach: u32) -> bool {
        near(self.from, other.from, reach) && near(self.to, other.to, reach)
    }

    fn holds(&self, other: &Dark, reach: u32) -> bool {
        let from = (self.from + AZIMUTHS_PER_TURN - reach % AZIMUTHS_PER_TURN) % AZIMUTHS_PER_TURN;
        let (begins, ends) = (forward(from, other.from), forward(from, other.to));
        begins < ends && ends <= forward(from, self.to) + reach
    }
}

fn near(a: u32, b: u32, reach: u32) -> bool {
    forward(a, b).min(forward(b, a)) <= reach
}

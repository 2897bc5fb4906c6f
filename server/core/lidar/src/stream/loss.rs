//! The number of lost packets, and the field-of-view gap.
//!
//! In: the azimuths of every packet, and the number of packets missing before it. Out: an estimate of the lost packets.
//! A sensor with a field of view sends nothing from the rest of its revolution, so a long gap is loss only if the next
//! revolution does not repeat it. A long gap is therefore counted after the next revolution, a short one at once.

use super::azimuth::forward;
use super::order::Gap;
use crate::model::AZIMUTHS_PER_REVOLUTION;

/// Least length of a field-of-view gap, in counts: 15 degrees. Ours: three packets of a VLP-16, the sensor with the
/// longest packets; a shorter gap is loss.
const FOV_GAP_MIN: u32 = 1_500;
/// Number of packets by which the ends of a field-of-view gap may differ between revolutions: the gap ends between two
/// packets, so each end moves by one packet, and a loss beside it moves the end by another.
const FOV_GAP_ERROR_PACKETS: u32 = 2;

/// A sector from which no packets arrived.
#[derive(Clone, Copy, Debug)]
struct EmptySector {
    from: u32,
    to: u32,
    /// Number of packets that were missing.
    packets: u32,
}

/// The lost packets of one sensor.
#[derive(Clone, Debug, Default)]
pub(super) struct Loss {
    lost: u64,
    /// A long gap that is loss unless the next revolution repeats it.
    candidate: Option<EmptySector>,
    /// The sector in which the sensor sends no packets in any revolution, if it has one.
    fov_gap: Option<EmptySector>,
    /// Azimuth at which the packet before ended.
    before: Option<u32>,
}

impl Loss {
    /// Adds a packet with firings at these azimuths, and what is missing before it. Returns the number of packets that
    /// may have been lost before it. `span`: counts by which the sensor turns during a packet.
    pub fn push(&mut self, gap: Gap, azimuths: &[u32], span: u32) -> u32 {
        let missing = gap.missing;
        let (Some(&azimuth), Some(&last)) = (azimuths.first(), azimuths.last()) else { return 0 };
        let from =
            self.before.replace((last + span / azimuths.len() as u32) % AZIMUTHS_PER_REVOLUTION).unwrap_or(azimuth);
        let reach = FOV_GAP_ERROR_PACKETS * span;
        let lies_inside = |sector: &EmptySector| {
            let inside = forward(sector.from, azimuth);
            (reach..forward(sector.from, sector.to).saturating_sub(reach + span)).contains(&inside)
        };
        if let Some(lost) = self.candidate.take_if(|sector| lies_inside(sector)) {
            self.lost += u64::from(lost.packets);
        }
        self.fov_gap.take_if(|sector| lies_inside(sector));
        if gap.fov_gap > 0 {
            self.push_gap_inside(azimuths, gap.fov_gap, span);
        }
        if missing == 0 {
            return 0;
        }
        let sector = EmptySector { from, to: azimuth, packets: missing };
        let is_long = forward(from, azimuth) >= FOV_GAP_MIN
            && u64::from(missing) * u64::from(span) < AZIMUTHS_PER_REVOLUTION.into();
        if is_long && self.candidate.is_some_and(|candidate| sector.is_about(&candidate, reach)) {
            self.fov_gap = self.candidate.take();
        }
        if let Some(fov_gap) = self.fov_gap.filter(|fov_gap| is_long && sector.contains(fov_gap, reach)) {
            let beside = missing.saturating_sub(fov_gap.packets);
            let lost = if beside > FOV_GAP_ERROR_PACKETS { beside } else { 0 };
            self.lost += u64::from(lost);
            return lost;
        }
        if is_long {
            let before = self.candidate.replace(sector);
            self.lost += before.map_or(0, |sector| u64::from(sector.packets));
        } else {
            self.lost += u64::from(missing);
        }
        missing
    }

    /// Adds a field-of-view gap that begins and ends inside a packet. No packet was lost in it.
    fn push_gap_inside(&mut self, azimuths: &[u32], packets: u32, span: u32) {
        let steps = azimuths.windows(2).map(|pair| EmptySector { from: pair[0], to: pair[1], packets });
        let Some(sector) = steps.max_by_key(EmptySector::width) else { return };
        if sector.width() >= FOV_GAP_MIN {
            self.candidate.take_if(|candidate| candidate.is_about(&sector, FOV_GAP_ERROR_PACKETS * span));
            self.fov_gap = Some(sector);
        }
    }

    /// First and last encoder count of the field-of-view gap; `None` until two revolutions have it.
    pub fn fov_gap(&self) -> Option<[u32; 2]> {
        self.fov_gap.map(|sector| [sector.from, sector.to])
    }

    /// True if the field-of-view gap, and nothing else, lies between firings at two azimuths. `span`: counts by which
    /// the sensor turns during a packet.
    pub fn is_fov_gap(&self, from: u32, to: u32, span: u32) -> bool {
        let step = EmptySector { from, to, packets: 0 };
        self.fov_gap.is_some_and(|sector| sector.is_about(&step, FOV_GAP_ERROR_PACKETS * span))
    }

    /// Number of packets lost so far, without the packets of a candidate gap.
    pub fn lost(&self) -> u64 {
        self.lost
    }

    /// Ends the stream: no revolution will repeat the candidate, so its packets are lost.
    pub fn finish(&mut self) {
        self.lost += self.candidate.take().map_or(0, |sector| u64::from(sector.packets));
        self.before = None;
    }

    /// Forgets the packet before, because device time has jumped.
    pub fn forget_packet_before(&mut self) {
        self.before = None;
    }
}

impl EmptySector {
    fn width(&self) -> u32 {
        forward(self.from, self.to)
    }

    /// True if both ends equal the ends of `other`, ± `reach` counts.
    fn is_about(&self, other: &EmptySector, reach: u32) -> bool {
        is_near(self.from, other.from, reach) && is_near(self.to, other.to, reach)
    }

    /// True if `other` lies inside this sector, ± `reach` counts.
    fn contains(&self, other: &EmptySector, reach: u32) -> bool {
        let from = (self.from + AZIMUTHS_PER_REVOLUTION - reach % AZIMUTHS_PER_REVOLUTION) % AZIMUTHS_PER_REVOLUTION;
        let (begins, ends) = (forward(from, other.from), forward(from, other.to));
        begins < ends && ends <= forward(from, self.to) + reach
    }
}

fn is_near(a: u32, b: u32, reach: u32) -> bool {
    forward(a, b).min(forward(b, a)) <= reach
}

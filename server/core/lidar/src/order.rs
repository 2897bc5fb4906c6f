//! Packets in the order in which the sensor sent them.
//!
//! In: packets as they arrive. Out: the same without copies, in the order of their device time (HDL-64E S1: of their
//! azimuth), each with what is missing before it. A packet that follows the one before passes at once; only behind a
//! gap packets wait, until it fills or the network cannot fill it any more ([`REORDER_PACKETS`]). Where a stream begins
//! nothing tells whether its first packet has come, so that the first ones wait as behind a gap.
//!
//! A packet's place counts packet periods of device time. A gap of more periods than the network puts out of order is
//! loss, or a field of view, and is not waited for.

use std::collections::VecDeque;

use crate::firing::forward;
use crate::model::{AZIMUTHS_PER_TURN, BLOCKS_PER_PACKET, Model, ModelSpec, ReturnMode};
use crate::packet::{PACKET_LENGTH, Packet, Refusal};

/// A packet may come this many packets after its turn and is still put right.
pub const REORDER_PACKETS: usize = 32;

/// Packets remembered to know a copy by. An older copy is out of line as a jump is.
const REMEMBERED: usize = 2 * REORDER_PACKETS;
/// Device time that goes on for longer than this, or back for more than [`REMEMBERED`] packets, is believed when a
/// second packet confirms it.
const PAUSE_US_MAX: i64 = 1_000_000;
/// A pause is the network's if the packets' arrivals show it too, be it in a capture played 20 times as fast; otherwise
/// the device's clock was set.
const PLAYED_FASTEST: i64 = 20;
const US_PER_HOUR: i64 = 3_600_000_000;
/// How long a sensor was dark inside a packet is known to this many packet periods.
const DARK_SLACK: i64 = 3;
/// Counts a block that no sensor exceeds: 4 degrees.
const STEP_MAX: u32 = 400;

/// What is missing between a packet and the one before.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Gap {
    /// Packets that did not come.
    pub missing: u32,
    /// Packet periods for which the sensor was dark while it filled the packet itself.
    pub dark: u32,
    /// The device's time was set, or it was restarted.
    pub jumped: bool,
}

/// Where a packet goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Way {
    /// On, at once.
    Next(Gap),
    /// It waits; [`Order::due`] gives it back.
    Held,
}

/// What tells a packet's place.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Mark {
    /// `None`: the sensor sends no time.
    device_us: Option<u32>,
    azimuth: u32,
    /// Counts from this packet's beginning to the next one's.
    span: u32,
    /// Counts inside this packet in which a sensor with a field of view was dark.
    dark: u32,
    period_ns: i64,
    /// Packet periods until the next packet: one, and those in which a sensor with a field of view was dark.
    length: i64,
    /// Of the bytes, where no time tells packets apart.
    sum: u64,
}

#[derive(Clone, Debug)]
struct Waiting {
    mark: Mark,
    place: i64,
    jumped: bool,
    arrival_ns: i64,
    payload: Box<[u8; PACKET_LENGTH]>,
}

/// Puts one sensor's packets in order.
#[derive(Clone, Debug, Default)]
pub(crate) struct Order {
    /// By place.
    waiting: VecDeque<Waiting>,
    /// Their memory, to be used again.
    spare: Vec<Waiting>,
    /// The packet with the greatest place, that place, and its arrival.
    newest: Option<(Mark, i64, i64)>,
    /// Place and length of the packet that passed last.
    passed: Option<(i64, i64)>,
    /// 256ths of a count that the sensor turns a packet, the mean of the last 16 or so.
    span_mean: Option<u32>,
    /// Those that passed lately.
    remembered: VecDeque<Mark>,
    /// A packet out of line, which was refused.
    jump: Option<Mark>,
}

impl Order {
    /// Finds a packet's way; one that is held is copied.
    ///
    /// # Errors
    /// [`Refusal::Duplicate`], [`Refusal::Late`], [`Refusal::DeviceTime`].
    pub fn take(
        &mut self,
        packet: &Packet<'_>,
        spec: &'static ModelSpec,
        mode: ReturnMode,
        arrival_ns: i64,
    ) -> Result<Way, Refusal> {
        let mut mark = Mark::of(packet, spec, mode);
        let (place, jumped) = self.place(&mark, arrival_ns)?;
        self.measure(&mut mark);
        self.jump = None;
        if self.newest.is_none_or(|(_, newest, _)| newest <= place) {
            self.newest = Some((mark, place, arrival_ns));
        }
        if self.waiting.is_empty() && self.missing_before(place).is_some_and(|missing| missing <= 0) {
            self.pass(&mark, place);
            return Ok(Way::Next(Gap { missing: 0, dark: mark.dark_periods(), jumped }));
        }
        let payload = *packet.bytes();
        let waiting = match self.spare.pop() {
            Some(Waiting { payload: mut held, .. }) => {
                *held = payload;
                Waiting { mark, place, jumped, arrival_ns, payload: held }
            }
            None => Waiting { mark, place, jumped, arrival_ns, payload: Box::new(payload) },
        };
        let at = self.waiting.partition_point(|before| before.place <= place);
        self.waiting.insert(at, waiting);
        Ok(Way::Held)
    }

    /// Gives the next packet that need not wait any longer (at the stream's `end`: the next one that waits) to
    /// `decode`, with its arrival; what that says.
    pub fn due<T>(&mut self, end: bool, decode: impl FnOnce(&Packet<'_>, i64, Gap) -> T) -> Option<T> {
        let first = self.waiting.front()?;
        let (_, newest, _) = self.newest?;
        // The packet before the first one waiting would have come by now.
        let reach = REORDER_PACKETS as i64;
        let due = match self.missing_before(first.place) {
            Some(missing) => missing <= 0 || newest - first.place + missing > reach,
            None => newest - first.place >= reach,
        };
        if !due && !end {
            return None;
        }
        let first = self.waiting.pop_front()?;
        let missing = self.missing_before(first.place).map_or(0, |missing| missing.max(0));
        self.pass(&first.mark, first.place);
        let missing = u32::try_from(missing).unwrap_or(u32::MAX);
        let gap = Gap { missing, dark: first.mark.dark_periods(), jumped: first.jumped };
        let packet = Packet::new(&first.payload[..]).expect("it was taken before it was held");
        let said = decode(&packet, first.arrival_ns, gap);
        self.spare.push(first);
        Some(said)
    }

    /// Packets that wait.
    pub fn held(&self) -> usize {
        self.waiting.len()
    }

    /// The stream has ended, and another may begin.
    pub fn forget(&mut self) {
        (self.newest, self.passed, self.jump) = (None, None, None);
        self.remembered.clear();
    }

    /// Packet periods between the packet that passed last and a place; `None` where a stream begins.
    fn missing_before(&self, place: i64) -> Option<i64> {
        let (last, length) = self.passed?;
        let missing = place - last - length;
        let dark = length > 1;
        Some(if dark && missing <= DARK_SLACK { missing.min(0) } else { missing })
    }

    /// How long a packet is follows from how fast the sensor turns: one packet alone tells that to 5 % only.
    fn measure(&mut self, mark: &mut Mark) {
        let span = 256 * mark.span;
        if mark.dark == 0 {
            let mean = self.span_mean.filter(|mean| span.abs_diff(*mean) < *mean / 4);
            self.span_mean = Some(mean.map_or(span, |mean| (15 * mean + span + 8) / 16));
            return;
        }
        let mean = self.span_mean.unwrap_or(span).max(1);
        mark.length = 1 + i64::from((256 * mark.dark + mean / 2) / mean);
    }

    fn pass(&mut self, mark: &Mark, place: i64) {
        self.passed = Some((place, mark.length));
        if self.remembered.len() == REMEMBERED {
            self.remembered.pop_front();
        }
        self.remembered.push_back(*mark);
    }

    /// A packet's place, and whether the device's time jumped before it.
    fn place(&mut self, mark: &Mark, arrival_ns: i64) -> Result<(i64, bool), Refusal> {
        let Some((newest, newest_place, newest_ns)) = self.newest else { return Ok((0, false)) };
        let steps = newest.steps_to(mark);
        if steps <= 0 && self.knows(mark) {
            return Err(Refusal::Duplicate { device_us: mark.device_us, azimuth: mark.azimuth });
        }
        let pause_us = steps.saturating_mul(newest.period_ns) / 1_000;
        if steps >= -(REMEMBERED as i64) && pause_us <= PAUSE_US_MAX {
            let place = newest_place + steps;
            return match self.passed {
                Some((last, _)) if place < last => {
                    Err(Refusal::Late { device_us: mark.device_us, azimuth: mark.azimuth, packets: last - place })
                }
                _ => Ok((place, false)),
            };
        }
        let confirmed = self.jump.is_some_and(|jump| (1..=REORDER_PACKETS as i64).contains(&jump.steps_to(mark)));
        if !confirmed {
            self.jump = Some(*mark);
            let device_us = mark.device_us;
            return Err(Refusal::DeviceTime { device_us, azimuth: mark.azimuth, newest_us: newest.device_us });
        }
        let since_us = arrival_ns.saturating_sub(newest_ns) / 1_000;
        let lost = steps > 0 && since_us.saturating_mul(PLAYED_FASTEST) >= pause_us;
        Ok(if lost { (newest_place + steps, false) } else { (newest_place + newest.length, true) })
    }

    fn knows(&self, mark: &Mark) -> bool {
        let same =
            |other: &Mark| (other.device_us, other.azimuth, other.sum) == (mark.device_us, mark.azimuth, mark.sum);
        self.remembered.iter().any(same) || self.waiting.iter().any(|waiting| same(&waiting.mark))
    }
}

impl Mark {
    fn of(packet: &Packet<'_>, spec: &'static ModelSpec, mode: ReturnMode) -> Self {
        let timeless = spec.model == Model::Hdl64eS1 || i64::from(packet.device_us()) >= US_PER_HOUR;
        let echoes = if mode == ReturnMode::Dual { 2 } else { 1 };
        let blocks = spec.blocks_per_firing * echoes;
        let columns = (BLOCKS_PER_PACKET / blocks) as u32;
        let azimuth = packet.azimuth(0);
        let (mut span, mut dark) = (0, 0);
        if columns > 1 {
            let last = (columns as usize - 1) * blocks;
            let ends = [(0, blocks), (last - blocks, last)];
            let step = ends.map(|(from, to)| forward(packet.azimuth(from), packet.azimuth(to))).into_iter().min();
            let step = step.filter(|step| *step <= STEP_MAX).unwrap_or(0);
            let turned = forward(azimuth, packet.azimuth(last));
            if turned <= 2 * step * columns {
                span = (turned * columns + columns / 2) / (columns - 1);
            } else if step > 0 && turned < AZIMUTHS_PER_TURN - STEP_MAX {
                // The field of view ends inside the packet: the sensor was dark until it began again.
                (span, dark) = (step * columns, turned - step * (columns - 1));
            }
        }
        Self {
            device_us: (!timeless).then(|| packet.device_us()),
            azimuth,
            span,
            dark,
            period_ns: i64::from(spec.packet_period_ns(mode)),
            length: 1,
            sum: if timeless { sum(packet.bytes()) } else { 0 },
        }
    }

    fn dark_periods(&self) -> u32 {
        (self.length - 1) as u32
    }

    /// Packet periods from this packet to another, by device time; where that does not tell, by azimuth, within half a
    /// turn.
    fn steps_to(&self, other: &Mark) -> i64 {
        if let (Some(from), Some(to)) = (self.device_us, other.device_us)
            && from != to
        {
            let passed = (i64::from(to) - i64::from(from) + US_PER_HOUR * 3 / 2) % US_PER_HOUR - US_PER_HOUR / 2;
            return (passed * 1_000 + self.period_ns / 2).div_euclid(self.period_ns);
        }
        let half = AZIMUTHS_PER_TURN / 2;
        let turned = i64::from((forward(self.azimuth, other.azimuth) + half) % AZIMUTHS_PER_TURN) - i64::from(half);
        // A sensor that stands still sends the same azimuth again and again.
        let span = i64::from(self.span.max(1));
        (turned + span / 2).div_euclid(span)
    }
}

/// Eight bytes at a time: packets of a sensor without time are told apart by it, nothing is kept safe by it.
fn sum(bytes: &[u8; PACKET_LENGTH]) -> u64 {
    let mix = |sum: u64, word: u64| (sum ^ word).wrapping_mul(0x9E37_79B9_7F4A_7C15).rotate_left(29);
    let (words, rest) = bytes.as_chunks::<8>();
    let sum = words.iter().fold(0, |sum, word| mix(sum, u64::from_le_bytes(*word)));
    rest.iter().fold(sum, |sum, byte| mix(sum, u64::from(*byte)))
}

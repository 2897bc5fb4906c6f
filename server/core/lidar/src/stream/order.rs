//! Packets in the order in which the sensor sent them.
//!
//! In: packets in order of arrival. Out: [`OrderedPacket`]s without copies, in order of device time (HDL-64E S1: of
//! azimuth), each with what is missing before it.
//!
//! A packet that follows the packet before passes at once. Behind a gap, packets wait until the gap is filled or the
//! network can no longer fill it ([`REORDER_PACKETS`]). At the start of a stream it is unknown whether an earlier
//! packet will arrive, so the first packets wait as if behind a gap.
//!
//! The position of a packet is counted in packet periods of device time. A gap of more periods than the network can
//! reorder is loss, or a field-of-view gap; packets do not wait for it.

use std::collections::VecDeque;

use super::azimuth::forward;
use crate::datagram::DatagramError;
use crate::datagram::packet::{PACKET_LENGTH, Packet};
use crate::model::{AZIMUTHS_PER_REVOLUTION, BLOCKS_PER_PACKET, Model, ModelSpec, ReturnMode};

/// Number of packets by which a packet may arrive late and is still put in order. Ours: 18 ms of an HDL-32E, 43 ms of a
/// VLP-16, which is above the reordering of a network and below a revolution.
pub(crate) const REORDER_PACKETS: usize = 32;

/// Number of packets that are remembered to detect copies. An older copy is refused as a jump of device time.
const REMEMBERED: usize = 2 * REORDER_PACKETS;
/// Longest forward step of device time, in microseconds, that needs no second packet to confirm it (ours: above any
/// field-of-view gap, which is less than a revolution). A step back needs one if it is longer than [`REMEMBERED`]
/// packets.
const PAUSE_US_MAX: i64 = 1_000_000;
/// Factor by which a capture may be played too fast. A pause of device time is loss if arrivals show at least this
/// fraction of it; otherwise the device's clock was set. Ours: faster playback is not supported.
const PLAYED_FASTEST: i64 = 20;
const US_PER_HOUR: i64 = 3_600_000_000;
/// Uncertainty of the length of a field-of-view gap inside a packet, in packet periods: the span of a packet is known
/// to 1 %, and a gap is at most a revolution, which has up to 350 packets (HDL-64E at 600 rpm).
const FOV_GAP_SLACK: i64 = 3;
/// Counts between two blocks that no sensor reaches: 4 degrees. The largest step is 0.8 degrees (VLP-16 at 1,200 rpm).
const STEP_MAX: u32 = 400;
/// Fixed-point factor of the mean span: 256ths of a count.
const SPAN_FRACTION: u32 = 256;
/// Number of packets of the running mean of the span. Counts are whole, so a single packet shows its span to 5 %; the
/// mean of 16 shows it to about 1 %.
const SPAN_MEAN_PACKETS: u32 = 16;
/// Fraction of the mean (one quarter) by which the span of a packet may differ from it. If it differs by more, the rate
/// of rotation has changed, and the mean starts again. It is five times the error of a single packet.
const SPAN_CHANGE: u32 = 4;

/// What is missing between a packet and the packet before.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Gap {
    /// Number of packets that did not arrive.
    pub missing: u32,
    /// Number of packet periods of a field-of-view gap inside the packet.
    pub fov_gap: u32,
    /// True if the device's clock was set, or the sensor was restarted.
    pub jumped: bool,
}

/// A packet that is next to be decoded, and what is missing before it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct OrderedPacket<'a> {
    pub packet: Packet<'a>,
    pub mode: ReturnMode,
    /// Arrival of the packet, in ns since the Unix epoch.
    pub arrival_ns: i64,
    pub gap: Gap,
}

/// The properties of a packet that decide its position and identify its copies.
#[derive(Clone, Copy, Debug, PartialEq)]
struct PacketKey {
    /// Device time past the hour; `None` if the sensor sends no time.
    device_us: Option<u32>,
    azimuth: u32,
    /// Counts from the start of this packet to the start of the next.
    span: u32,
    /// Counts of a field-of-view gap inside this packet.
    fov_gap: u32,
    period_ns: i64,
    /// Packet periods until the next packet: one, plus the periods of a field-of-view gap.
    length: i64,
    /// Checksum of the bytes if the sensor sends no time, else 0.
    checksum: u64,
}

/// A packet that waits for the packets before it.
#[derive(Clone, Debug)]
struct Waiting {
    key: PacketKey,
    position: i64,
    jumped: bool,
    mode: ReturnMode,
    arrival_ns: i64,
    payload: Box<[u8; PACKET_LENGTH]>,
}

/// The packet with the greatest position.
#[derive(Clone, Copy, Debug)]
struct Newest {
    key: PacketKey,
    position: i64,
    arrival_ns: i64,
}

/// The order of the packets of one sensor.
#[derive(Clone, Debug, Default)]
pub(crate) struct Order {
    /// Waiting packets, by position.
    waiting: VecDeque<Waiting>,
    /// Memory of packets that no longer wait, for the next packets.
    spare: Vec<Waiting>,
    newest: Option<Newest>,
    /// Position and length of the last packet that passed.
    passed: Option<(i64, i64)>,
    /// Running mean of the span of a packet, in [`SPAN_FRACTION`]s of a count.
    span_mean: Option<u32>,
    /// The last packets that passed.
    remembered: VecDeque<PacketKey>,
    /// The last packet if it was refused because its device time jumps.
    jump: Option<PacketKey>,
}

impl Order {
    /// Adds a packet and returns it if it need not wait. The bytes of a packet that waits are copied;
    /// [`Order::pop_due`] returns it later.
    ///
    /// # Errors
    /// - [`DatagramError::Duplicate`] if the packet is a copy of one of the last packets.
    /// - [`DatagramError::Late`] if later packets have passed.
    /// - [`DatagramError::DeviceTime`] if its device time jumps and the packet before does not confirm that.
    pub fn push<'a>(
        &mut self,
        packet: Packet<'a>,
        spec: &'static ModelSpec,
        mode: ReturnMode,
        arrival_ns: i64,
    ) -> Result<Option<OrderedPacket<'a>>, DatagramError> {
        let mut key = PacketKey::from_packet(&packet, spec, mode);
        let (position, jumped) = self.find_position(&key, arrival_ns)?;
        self.measure_length(&mut key);
        self.jump = None;
        if self.newest.is_none_or(|newest| newest.position <= position) {
            self.newest = Some(Newest { key, position, arrival_ns });
        }
        if self.waiting.is_empty() && self.missing_before(position).is_some_and(|missing| missing <= 0) {
            self.pass(&key, position);
            let gap = Gap { missing: 0, fov_gap: key.fov_gap_periods(), jumped };
            return Ok(Some(OrderedPacket { packet, mode, arrival_ns, gap }));
        }
        let payload = match self.spare.pop() {
            Some(Waiting { mut payload, .. }) => {
                *payload = *packet.bytes();
                payload
            }
            None => Box::new(*packet.bytes()),
        };
        let at = self.waiting.partition_point(|before| before.position <= position);
        self.waiting.insert(at, Waiting { key, position, jumped, mode, arrival_ns, payload });
        Ok(None)
    }

    /// Removes the first waiting packet and returns it if it need not wait any longer.
    pub fn pop_due(&mut self) -> Option<OrderedPacket<'_>> {
        let first = self.waiting.front()?;
        let newest = self.newest?;
        // A packet before the first waiting one would have arrived by now.
        let reach = REORDER_PACKETS as i64;
        let is_due = match self.missing_before(first.position) {
            Some(missing) => missing <= 0 || newest.position - first.position + missing > reach,
            None => newest.position - first.position >= reach,
        };
        if is_due { self.pop_waiting() } else { None }
    }

    /// Removes the first waiting packet and returns it.
    pub fn pop_waiting(&mut self) -> Option<OrderedPacket<'_>> {
        let first = self.waiting.pop_front()?;
        let missing = self.missing_before(first.position).map_or(0, |missing| missing.max(0));
        self.pass(&first.key, first.position);
        let missing = u32::try_from(missing).unwrap_or(u32::MAX);
        let gap = Gap { missing, fov_gap: first.key.fov_gap_periods(), jumped: first.jumped };
        let (mode, arrival_ns) = (first.mode, first.arrival_ns);
        self.spare.push(first);
        let packet = Packet::from_checked(&self.spare.last()?.payload);
        Some(OrderedPacket { packet, mode, arrival_ns, gap })
    }

    /// Number of packets that wait.
    pub fn waiting(&self) -> usize {
        self.waiting.len()
    }

    /// Forgets the stream, so that another one may begin.
    pub fn reset(&mut self) {
        (self.newest, self.passed, self.jump) = (None, None, None);
        self.remembered.clear();
    }

    /// Packet periods between the last packet that passed and a position; `None` at the start of a stream.
    fn missing_before(&self, position: i64) -> Option<i64> {
        let (last, length) = self.passed?;
        let missing = position - last - length;
        let has_fov_gap = length > 1;
        Some(if has_fov_gap && missing <= FOV_GAP_SLACK { missing.min(0) } else { missing })
    }

    /// Sets the length of a packet, which depends on the rate of rotation.
    fn measure_length(&mut self, key: &mut PacketKey) {
        let span = SPAN_FRACTION * key.span;
        if key.fov_gap == 0 {
            let mean = self.span_mean.filter(|mean| span.abs_diff(*mean) < *mean / SPAN_CHANGE);
            let updated = |mean| ((SPAN_MEAN_PACKETS - 1) * mean + span + SPAN_MEAN_PACKETS / 2) / SPAN_MEAN_PACKETS;
            self.span_mean = Some(mean.map_or(span, updated));
            return;
        }
        let mean = self.span_mean.unwrap_or(span).max(1);
        key.length = 1 + i64::from((SPAN_FRACTION * key.fov_gap + mean / 2) / mean);
    }

    fn pass(&mut self, key: &PacketKey, position: i64) {
        self.passed = Some((position, key.length));
        if self.remembered.len() == REMEMBERED {
            self.remembered.pop_front();
        }
        self.remembered.push_back(*key);
    }

    /// The position of a packet, and true if the device's time jumped before it.
    fn find_position(&mut self, key: &PacketKey, arrival_ns: i64) -> Result<(i64, bool), DatagramError> {
        let Some(newest) = self.newest else { return Ok((0, false)) };
        let (device_us, azimuth) = (key.device_us, key.azimuth);
        let steps = newest.key.steps_to(key);
        if steps <= 0 && self.contains(key) {
            return Err(DatagramError::Duplicate { device_us, azimuth });
        }
        let pause_us = steps.saturating_mul(newest.key.period_ns) / 1_000;
        if steps >= -(REMEMBERED as i64) && pause_us <= PAUSE_US_MAX {
            let position = newest.position + steps;
            return match self.passed {
                Some((last, _)) if position < last => {
                    let packets_max = REORDER_PACKETS;
                    Err(DatagramError::Late { device_us, azimuth, packets: last - position, packets_max })
                }
                _ => Ok((position, false)),
            };
        }
        let confirmed = self.jump.is_some_and(|jump| (1..=REORDER_PACKETS as i64).contains(&jump.steps_to(key)));
        if !confirmed {
            self.jump = Some(*key);
            return Err(DatagramError::DeviceTime { device_us, azimuth, newest_us: newest.key.device_us });
        }
        let since_us = arrival_ns.saturating_sub(newest.arrival_ns) / 1_000;
        let is_loss = steps > 0 && since_us.saturating_mul(PLAYED_FASTEST) >= pause_us;
        Ok(if is_loss { (newest.position + steps, false) } else { (newest.position + newest.key.length, true) })
    }

    /// True if one of the last packets, or a waiting one, is the same.
    fn contains(&self, key: &PacketKey) -> bool {
        let same = |other: &PacketKey| {
            (other.device_us, other.azimuth, other.checksum) == (key.device_us, key.azimuth, key.checksum)
        };
        self.remembered.iter().any(same) || self.waiting.iter().any(|waiting| same(&waiting.key))
    }
}

impl PacketKey {
    fn from_packet(packet: &Packet<'_>, spec: &'static ModelSpec, mode: ReturnMode) -> Self {
        let timeless = spec.model == Model::Hdl64eS1 || i64::from(packet.device_us()) >= US_PER_HOUR;
        let echoes = if mode == ReturnMode::Dual { 2 } else { 1 };
        let blocks = spec.blocks_per_firing * echoes;
        let columns = (BLOCKS_PER_PACKET / blocks) as u32;
        let azimuth = packet.azimuth(0);
        let (mut span, mut fov_gap) = (0, 0);
        if columns > 1 {
            let last = (columns as usize - 1) * blocks;
            let ends = [(0, blocks), (last - blocks, last)];
            let step = ends.map(|(from, to)| forward(packet.azimuth(from), packet.azimuth(to))).into_iter().min();
            let step = step.filter(|step| *step <= STEP_MAX).unwrap_or(0);
            let turned = forward(azimuth, packet.azimuth(last));
            if turned <= 2 * step * columns {
                span = (turned * columns + columns / 2) / (columns - 1);
            } else if step > 0 && turned < AZIMUTHS_PER_REVOLUTION - STEP_MAX {
                // The field of view ends inside the packet and begins again inside it.
                (span, fov_gap) = (step * columns, turned - step * (columns - 1));
            }
        }
        Self {
            device_us: (!timeless).then(|| packet.device_us()),
            azimuth,
            span,
            fov_gap,
            period_ns: i64::from(spec.packet_period_ns(mode)),
            length: 1,
            checksum: if timeless { checksum(packet.bytes()) } else { 0 },
        }
    }

    fn fov_gap_periods(&self) -> u32 {
        (self.length - 1) as u32
    }

    /// Packet periods from this packet to another, by device time; without device time, or if it is equal, by azimuth,
    /// within half a revolution.
    fn steps_to(&self, other: &PacketKey) -> i64 {
        if let (Some(from), Some(to)) = (self.device_us, other.device_us)
            && from != to
        {
            let passed = (i64::from(to) - i64::from(from) + US_PER_HOUR * 3 / 2) % US_PER_HOUR - US_PER_HOUR / 2;
            return (passed * 1_000 + self.period_ns / 2).div_euclid(self.period_ns);
        }
        let half = AZIMUTHS_PER_REVOLUTION / 2;
        let turned =
            i64::from((forward(self.azimuth, other.azimuth) + half) % AZIMUTHS_PER_REVOLUTION) - i64::from(half);
        // A sensor that stands still sends the same azimuth again and again.
        let span = i64::from(self.span.max(1));
        (turned + span / 2).div_euclid(span)
    }
}

/// Checksum of a packet, eight bytes at a time. It distinguishes packets of a sensor without time; it is not a
/// protection against deliberate collisions.
fn checksum(bytes: &[u8; PACKET_LENGTH]) -> u64 {
    let mix = |sum: u64, word: u64| (sum ^ word).wrapping_mul(0x9E37_79B9_7F4A_7C15).rotate_left(29);
    let (words, rest) = bytes.as_chunks::<8>();
    let sum = words.iter().fold(0, |sum, word| mix(sum, u64::from_le_bytes(*word)));
    rest.iter().fold(sum, |sum, byte| mix(sum, u64::from(*byte)))
}

//! The decoder of a known model: from packets in order to revolutions.
//!
//! In: [`OrderedPacket`]s. Out: a finished [`Revolution`] whenever the azimuth passes the cut. There are two
//! revolutions: one is filled while the caller reads the other, so that nothing is allocated once both have their full
//! size.

use std::sync::Arc;

use super::azimuth::forward;
use super::blocked_detector::BlockedDetector;
use super::cut::{Cutter, FORWARD_MAX, MAX_FIRINGS_PER_REVOLUTION, Step};
use super::identify;
use super::loss::Loss;
use super::order::{Gap, OrderedPacket};
use super::packet_firings::{MAX_FIRINGS, PacketFirings};
use super::points::PointCorrection;
use super::status_bytes::StatusBytes;
use crate::calibration::Calibration;
use crate::config::SensorConfig;
use crate::datagram::DatagramError;
use crate::datagram::packet::Packet;
use crate::datagram::telemetry::Telemetry;
use crate::model::{AZIMUTHS_PER_REVOLUTION, Model, ModelSpec, RETURNS_PER_BLOCK, ReturnMode};
use crate::revolution::{Firing, Partial, Revolution};
use crate::status::{CalibrationSource, SensorStatus};
use crate::time::clock::DeviceClock;

/// Longest time of a revolution, in ns: at 60 rpm. After a longer pause between two packets another revolution begins.
/// Ours: the slowest rate of a sensor is 300 rpm.
const REVOLUTION_NS_MAX: i64 = 1_000_000_000;

/// Number of packets in a row with the same device time and other azimuths after which the device time stands still.
/// Ours: simulators and replacements leave the bytes 0; no sensor fills so many packets in a microsecond.
const STILL_PACKETS: u32 = 3;

/// True if the decoder may end a revolution with a packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum MayCut {
    Yes,
    /// The stream ends: all packets belong to the last revolution.
    No,
}

/// The decoder of one sensor.
#[derive(Clone, Debug)]
pub(crate) struct Decoder {
    spec: &'static ModelSpec,
    mode: ReturnMode,
    points: PointCorrection,
    clock: DeviceClock,
    cutter: Cutter,
    loss: Loss,
    blocked: BlockedDetector,
    /// Revolution that is being filled.
    current: Revolution,
    /// Newest finished revolution. Its memory is used again.
    finished: Revolution,
    /// Time of the first firing of `current` on the clock's timeline.
    first_ns: i64,
    /// Time of the newest packet on the clock's timeline.
    packet_ns: i64,
    /// Number of firings of the newest complete revolution.
    complete_firings: Option<u32>,
    /// Counts by which the sensor turns per block.
    step: Option<u32>,
    /// Azimuth at which the packet before began.
    packet_azimuth: Option<u32>,
    /// Device time of the packet before, in µs, and the number of packets in a row that had it.
    device_time: (u32, u32),
    rpm_configured: Option<f32>,
    status_bytes: StatusBytes,
    status: SensorStatus,
}

impl Decoder {
    /// A decoder of a model.
    ///
    /// # Errors
    /// [`DatagramError::Calibration`] if the configured calibration has fewer lasers than the model.
    pub fn new(model: Model, config: &SensorConfig) -> Result<Self, DatagramError> {
        let spec = model.spec();
        let calibration = match &config.calibration {
            Some(configured) => configured.clone().cut_to(model).map_err(DatagramError::Calibration)?,
            None => Calibration::factory(model),
        };
        let calibration = Arc::new(calibration);
        let revolution = Revolution::new(model, ReturnMode::Strongest, Arc::clone(&calibration));
        let source =
            if config.calibration.is_some() { CalibrationSource::Configured } else { CalibrationSource::Factory };
        Ok(Self {
            spec,
            mode: ReturnMode::Strongest,
            points: PointCorrection::new(spec, &calibration),
            clock: DeviceClock::new(config.gps_late_ns_max, config.ahead_ns_max),
            cutter: Cutter::new(config.cut_azimuth_deg),
            loss: Loss::default(),
            blocked: BlockedDetector::default(),
            finished: revolution.clone(),
            current: revolution,
            first_ns: 0,
            packet_ns: 0,
            complete_firings: None,
            step: None,
            packet_azimuth: None,
            device_time: (u32::MAX, 0),
            rpm_configured: config.rpm,
            status_bytes: StatusBytes::new(config),
            status: SensorStatus { model: Some(model), calibration: source, ..SensorStatus::default() },
        })
    }

    /// Checks that a packet is of this sensor's model, and returns its return mode.
    ///
    /// # Errors
    /// [`DatagramError::BlockFlag`] or [`DatagramError::Model`] if it is of another model.
    pub fn check(&self, packet: &Packet<'_>, is_model_given: bool) -> Result<ReturnMode, DatagramError> {
        identify::check(packet, self.spec.model, is_model_given)
    }

    pub fn apply_telemetry(&mut self, telemetry: &Telemetry, arrival_ns: i64) {
        // An HDL-64E S1 sends no device time, so telemetry has no place on its timeline.
        if self.spec.model != Model::Hdl64eS1 {
            let reports_pps = self.spec.model != Model::Hdl32e && !self.spec.model.is_hdl64e();
            self.clock.apply_telemetry(telemetry, reports_pps, arrival_ns);
        }
    }

    /// The newest finished revolution.
    pub fn finished(&self) -> &Revolution {
        &self.finished
    }

    /// Number of finished revolutions.
    pub fn revolutions(&self) -> u64 {
        self.status.revolutions
    }

    /// Properties of the model.
    pub fn spec(&self) -> &'static ModelSpec {
        self.spec
    }

    pub fn status(&self) -> SensorStatus {
        SensorStatus {
            packets_lost: self.loss.lost(),
            blocked: self.finished.blocked.clone(),
            gps_ahead_ns: self.clock.gps_ahead_ns(),
            ..self.status.clone()
        }
    }

    /// Decodes a packet into the current revolution, and returns true if that finished a revolution.
    pub fn decode_and_cut(&mut self, ordered: &OrderedPacket<'_>, may_cut: MayCut) -> bool {
        let OrderedPacket { packet, mode, arrival_ns, gap } = *ordered;
        let may_cut = may_cut == MayCut::Yes;
        let mut is_done = self.change_mode(mode) && may_cut;
        self.status.packets += 1;
        let telemetry = self.status_bytes.push(&packet, self.spec.model, self.mode, &self.current.calibration);
        if let Some(telemetry) = telemetry {
            self.clock.apply_telemetry(&telemetry, true, arrival_ns);
        }

        let before = self.packet_azimuth;
        let firings = PacketFirings::from_packet(&packet, self.spec, mode, self.step_between_packets(&packet));
        self.step = firings.step;
        let time_ns = self.stamp_packet(&packet, before, arrival_ns);
        let passed_ns = time_ns - std::mem::replace(&mut self.packet_ns, time_ns);
        let is_torn = self.count_gap(firings.azimuths(), gap, passed_ns);

        let first_row = self.current.firings.len();
        let cut = self.add_firings(&firings, time_ns, is_torn, may_cut && !is_done);
        self.write_returns(&packet, 0, first_row);
        self.current.packets += 1;
        self.current.packets_expected += 1;
        if let Some(cut) = cut {
            self.end_revolution(first_row + cut.firing, if is_torn { 0 } else { cut.travelled }, cut.time_ns);
            self.first_ns = cut.time_ns;
            (self.current.partial, self.current.packets, self.current.packets_expected) = (cut.partial, 1, 1);
            if self.apply_status_bytes() {
                self.write_returns(&packet, cut.firing, 0);
            }
            is_done = true;
        }
        is_done
    }

    /// Ends the stream, and returns true if that finished a revolution.
    pub fn finish(&mut self) -> bool {
        let Some(last) = self.current.firings.last() else { return false };
        let last_ns = self.first_ns + i64::from(last.offset_ns);
        if !self.cutter.ends_at_cut(self.firing_step()) {
            self.current.partial.get_or_insert(Partial::End);
        }
        let travelled = self.cutter.travelled();
        self.end_revolution(self.current.firings.len(), travelled, last_ns);
        self.cutter.reset();
        self.packet_azimuth = None;
        self.loss.finish();
        self.apply_status_bytes();
        true
    }

    /// Ends the current revolution if the return mode changes, because the range images of both modes differ. Returns
    /// true if that finished a revolution.
    fn change_mode(&mut self, mode: ReturnMode) -> bool {
        if mode == self.mode && self.status.return_mode.is_some() {
            return false;
        }
        let ended = !self.current.firings.is_empty();
        if ended {
            self.current.partial.get_or_insert(Partial::End);
            self.finish();
        }
        self.mode = mode;
        self.status.return_mode = Some(mode);
        (self.step, self.complete_firings) = (None, None);
        self.current = Revolution::new(self.spec.model, mode, Arc::clone(&self.current.calibration));
        if !ended {
            self.finished = self.current.clone();
        }
        ended
    }

    /// The time of a packet's first firing on the clock's timeline, in ns.
    fn stamp_packet(&mut self, packet: &Packet<'_>, azimuth_before: Option<u32>, arrival_ns: i64) -> i64 {
        let span_ns = i64::from(self.spec.packet_period_ns(self.mode));
        let has_time = self.spec.model != Model::Hdl64eS1 && !self.notes_still_time(packet.device_us());
        let elapsed_ns = if has_time { span_ns } else { span_ns * self.packets_since(azimuth_before, packet) };
        let device_us = has_time.then(|| packet.device_us());
        self.clock.push_packet(device_us, elapsed_ns, arrival_ns, span_ns)
    }

    /// Notes the device time of a packet, and returns true if it stands still.
    fn notes_still_time(&mut self, device_us: u32) -> bool {
        let (before_us, packets) = self.device_time;
        self.device_time = (device_us, if before_us == device_us { packets.saturating_add(1) } else { 0 });
        self.status.device_time_stands = self.device_time.1 >= STILL_PACKETS;
        self.status.device_time_stands
    }

    /// Counts from the packet before to this packet: the step of a sensor whose packets have a single firing (VLS-128
    /// in dual-return mode). It is the nominal step if the measured step differs by more than half of it: then a packet
    /// was lost, or the rate of rotation is not known yet.
    fn step_between_packets(&mut self, packet: &Packet<'_>) -> Option<u32> {
        let azimuth = packet.azimuth(0);
        let before = self.packet_azimuth.replace(azimuth);
        let nominal = self.spec.firing_step(self.mode, self.rpm());
        let measured = before.map(|before| forward(before, azimuth));
        let possible = nominal / 2..=nominal + nominal / 2;
        Some(measured.filter(|step| possible.contains(step)).unwrap_or(nominal))
    }

    /// Number of packets from the packet that began at azimuth `before` to this packet, by the angle between them.
    fn packets_since(&self, before: Option<u32>, packet: &Packet<'_>) -> i64 {
        let turned = before.map_or(0, |before| forward(before, packet.azimuth(0)));
        let by_rate =
            self.spec.firing_step(self.mode, self.rpm()).max(1) * self.spec.firings_per_packet(self.mode) as u32;
        // Without device time the rate follows from these steps: a wrong one would confirm itself.
        let is_wrong = self.span() > 0 && self.span().abs_diff(by_rate) > by_rate / 4;
        let span = if is_wrong { self.span() } else { by_rate };
        if turned > FORWARD_MAX { 1 } else { i64::from((turned + span / 2) / span).max(1) }
    }

    fn rpm(&self) -> f32 {
        self.rpm_configured.or(self.status.rpm).unwrap_or(self.spec.rpm_nominal)
    }

    /// Counts from firing to firing.
    fn firing_step(&self) -> u32 {
        self.step.unwrap_or(0) / self.spec.firings_per_block as u32
    }

    /// Counts from packet to packet, as the blocks of the newest packet show it.
    fn span(&self) -> u32 {
        self.firing_step() * self.spec.firings_per_packet(self.mode) as u32
    }

    /// Adds the firings of a packet to the current revolution and finds the firing at which to cut: the first one if
    /// the revolution is torn before the packet.
    fn add_firings(&mut self, firings: &PacketFirings, time_ns: i64, is_torn: bool, may_cut: bool) -> Option<Cut> {
        let (period_ns, expected) = (i64::from(self.spec.period_ns(self.mode)), self.firing_step());
        let is_overlong = self.current.firings.len() + MAX_FIRINGS > MAX_FIRINGS_PER_REVOLUTION;
        let mut cut: Option<Cut> = None;
        let mut rows = [Firing { azimuth_rad: 0.0, offset_ns: 0 }; MAX_FIRINGS];
        let mut offset_ns = self.current.firings.last().map_or(0, |firing| firing.offset_ns);
        let mut first_ns = self.first_ns;
        for (firing, azimuth) in firings.azimuths().iter().copied().enumerate() {
            let time_ns = time_ns.saturating_add(firing as i64 * period_ns);
            if self.current.firings.is_empty() && firing == 0 {
                self.begin_revolution(azimuth, time_ns, expected);
                first_ns = time_ns;
            }
            let last = self.cutter.last();
            let (mut step, passes_cut) = self.cutter.push(azimuth, expected);
            if step == Step::Gap && last.is_some_and(|last| self.loss.is_fov_gap(last, azimuth, self.span())) {
                step = Step::Even;
            }
            let is_torn = is_torn && firing == 0;
            let (step, passes_cut) = (if is_torn { Step::Gap } else { step }, passes_cut || is_torn);
            let flaw = match step {
                Step::Even => (passes_cut && (!may_cut || cut.is_some())).then_some(Partial::Reversal),
                Step::Gap => Some(Partial::Gap),
                Step::Reversal => Some(Partial::Reversal),
            };
            let partial = cut.as_mut().map_or(&mut self.current.partial, |cut| &mut cut.partial);
            *partial = partial.or(flaw);
            if (passes_cut || is_overlong) && may_cut && cut.is_none() {
                let overlong = (!passes_cut).then_some(Partial::Overlong);
                self.current.partial = self.current.partial.or(overlong);
                let partial = flaw.or(overlong);
                cut = Some(Cut { firing, time_ns, travelled: self.cutter.restart(), partial });
                (first_ns, offset_ns) = (time_ns, 0);
            }
            // If device time runs backwards inside a revolution, the offset stays.
            offset_ns = offset_ns.max(u32::try_from((time_ns - first_ns).max(0)).unwrap_or(u32::MAX));
            rows[firing] = Firing::new(azimuth, offset_ns);
        }
        self.current.grow(&rows[..firings.azimuths().len()]);
        cut
    }

    /// Counts what is missing before a packet, and returns true if the current revolution is torn before it: a whole
    /// revolution or more is missing, or the length of the gap is unknown.
    fn count_gap(&mut self, azimuths: &[u32], gap: Gap, passed_ns: i64) -> bool {
        let span = self.span();
        if gap.jumped {
            self.loss.forget_packet_before();
        }
        let lost = self.loss.push(gap, azimuths, span);
        let has_turned = u64::from(gap.missing) * u64::from(span) >= u64::from(AZIMUTHS_PER_REVOLUTION);
        let is_torn = gap.jumped || has_turned || passed_ns > REVOLUTION_NS_MAX;
        if !self.current.firings.is_empty() {
            self.current.packets_expected = self.current.packets_expected.saturating_add(lost);
            return is_torn;
        }
        false
    }

    fn begin_revolution(&mut self, azimuth: u32, time_ns: i64, expected: u32) {
        self.first_ns = time_ns;
        if !self.cutter.starts_at_cut(azimuth, expected) {
            self.current.partial.get_or_insert(Partial::Start);
        }
    }

    /// Writes the returns of the packet's firings from `first` on into the rows from `row` on.
    fn write_returns(&mut self, packet: &Packet<'_>, first: usize, row: usize) {
        let step = self.step.unwrap_or(0);
        for block in 0..self.spec.blocks_used(self.mode) {
            let position = self.spec.block_position(block, self.mode);
            let Some(laser) = self.spec.first_laser(packet.flag(block)) else { continue };
            if position.firing < first {
                continue;
            }
            let slot = (row + position.firing - first) * self.spec.lasers + laser;
            let mut slots = self.current.echoes[position.echo].slots(slot);
            let (bank, azimuth) = (laser / RETURNS_PER_BLOCK, packet.azimuth(block));
            self.points.convert(packet.returns(block), bank, azimuth, step, &mut slots);
        }
        if let [strongest, last] = self.current.echoes.as_mut_slice() {
            last.remove_repeats(strongest, row * self.spec.lasers);
        }
    }

    /// Finishes the first `rows` firings of the current revolution; the others begin the next one.
    fn end_revolution(&mut self, rows: usize, travelled: u64, end_ns: i64) {
        self.finished.begin_like(&self.current);
        self.current.move_tail(rows, &mut self.finished);
        std::mem::swap(&mut self.current, &mut self.finished);

        let lasted_ns = end_ns - self.first_ns;
        if travelled > 0 && lasted_ns > 0 {
            let revolutions = travelled as f64 / f64::from(AZIMUTHS_PER_REVOLUTION);
            self.status.rpm = Some((revolutions * 60e9 / lasted_ns as f64) as f32);
        }
        let rpm = self.rpm();
        let finished = &mut self.finished;
        finished.sequence = self.status.revolutions;
        finished.rpm = rpm;
        if finished.partial.is_none() {
            self.complete_firings = Some(finished.firings.len() as u32);
        }
        let nominal = self.spec.firings_per_revolution(self.mode, rpm).min(MAX_FIRINGS_PER_REVOLUTION) as u32;
        finished.firings_expected = self.complete_firings.unwrap_or(nominal);
        let last_offset_ns = finished.firings.last().map(|firing| firing.offset_ns);
        let stamp = self.clock.end_revolution(self.first_ns, last_offset_ns);
        for firing in &mut finished.firings {
            firing.offset_ns = stamp.offset_ns(firing.offset_ns);
        }
        (finished.start_ns, finished.end_ns) = (stamp.start_ns, stamp.end_ns);
        (finished.clock, finished.clock_offset_ms) = (stamp.clock, stamp.clock_offset_ms);
        (finished.epoch, self.status.epoch) = (stamp.epoch, stamp.epoch);
        (self.status.clock, self.status.clock_offset_ms) = (Some(stamp.clock), stamp.clock_offset_ms);
        let count_rad = std::f32::consts::TAU / AZIMUTHS_PER_REVOLUTION as f32;
        finished.fov_gap_rad = self.loss.fov_gap().map(|ends| ends.map(|count| count as f32 * count_rad));
        self.status.revolutions += 1;
        self.status.returns += self.blocked.push(finished);
    }

    /// Uses what the status bytes have shown, between two revolutions. Returns true if the corrections have changed, so
    /// that the returns of the current revolution must be written again.
    fn apply_status_bytes(&mut self) -> bool {
        if let Some(model) = self.status_bytes.model.take() {
            self.spec = model.spec();
            self.status.model = Some(model);
            self.current.model = model;
        }
        let Some(calibration) = self.status_bytes.calibration.take() else { return false };
        self.points = PointCorrection::new(self.spec, &calibration);
        self.current.calibration = calibration;
        self.status.calibration = CalibrationSource::StatusBytes;
        true
    }
}

/// The cut between two revolutions inside a packet.
#[derive(Clone)]
struct Cut {
    /// First firing of the next revolution, as an index in the packet.
    firing: usize,
    time_ns: i64,
    /// Counts of the revolution that ends.
    travelled: u64,
    /// Reason for which the next revolution is partial from its start.
    partial: Option<Partial>,
}

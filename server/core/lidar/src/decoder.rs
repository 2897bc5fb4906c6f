//! Packets of a known model to revolutions.
//!
//! In: [`Packet`]s that were found to fit. Out: a finished [`Revolution`] whenever a cut is crossed. Two revolutions
//! take turns: one is filled while the caller reads the other, so that nothing is allocated once both have grown.

use std::sync::Arc;

use crate::beam::Beams;
use crate::blocked::View;
use crate::calibration::{Calibration, unit_table::UnitTable};
use crate::clock::DeviceClock;
use crate::firing::{MAX_FIRINGS, PacketFirings};
use crate::identify;
use crate::loss::Loss;
use crate::model::{AZIMUTHS_PER_TURN, Model, ModelSpec, RETURNS_PER_BLOCK, ReturnMode};
use crate::order::Gap;
use crate::packet::{Packet, Refusal};
use crate::revolution::{Firing, Partial, Revolution};
use crate::sensor::{CalibrationSource, SensorConfig, SensorStatus};
use crate::telemetry::Telemetry;
use crate::turns::{LONGEST_FORWARD, MAX_FIRINGS_PER_TURN, Step, Turns, expected_step};
use crate::unit_clock::UnitClock;

/// At 60 rpm; where more time has passed from packet to packet, another turn has begun.
const TURN_NS_MAX: i64 = 1_000_000_000;

#[derive(Clone, Debug)]
pub(crate) struct Decoder {
    spec: &'static ModelSpec,
    mode: ReturnMode,
    beams: Beams,
    clock: DeviceClock,
    turns: Turns,
    loss: Loss,
    view: View,
    /// Being filled.
    current: Revolution,
    /// The newest finished one; its memory is used again.
    done: Revolution,
    /// The first firing of `current` on the clock's timeline.
    first_ns: i64,
    /// Of the newest packet, on the timeline.
    packet_ns: i64,
    /// Firings of the newest turn that missed nothing.
    firings_whole: Option<u32>,
    /// Counts the sensor turns a block, and the azimuth at which the packet before began.
    step: Option<u32>,
    packet_azimuth: Option<u32>,
    rpm_configured: Option<f32>,
    unit: Unit,
    status: SensorStatus,
}

/// What an HDL-64E tells of itself, to be used from the next turn on.
#[derive(Clone, Debug, Default)]
struct Unit {
    table: UnitTable,
    clock: UnitClock,
    model_open: bool,
    calibration_open: bool,
    model: Option<Model>,
    calibration: Option<Arc<Calibration>>,
}

impl Decoder {
    pub fn new(model: Model, config: &SensorConfig) -> Result<Self, Refusal> {
        let spec = model.spec();
        let calibration = match &config.calibration {
            Some(own) => own.clone().cut_to(model).map_err(Refusal::Calibration)?,
            None => Calibration::factory(model),
        };
        let calibration = Arc::new(calibration);
        let revolution = Revolution::new(model, ReturnMode::Strongest, Arc::clone(&calibration));
        let source =
            if config.calibration.is_some() { CalibrationSource::Configured } else { CalibrationSource::Factory };
        Ok(Self {
            spec,
            mode: ReturnMode::Strongest,
            beams: Beams::new(spec, &calibration),
            clock: DeviceClock::new(config.gps_late_ns_max),
            turns: Turns::new(config.cut_azimuth_deg),
            loss: Loss::default(),
            view: View::default(),
            done: revolution.clone(),
            current: revolution,
            first_ns: 0,
            packet_ns: 0,
            firings_whole: None,
            step: None,
            packet_azimuth: None,
            rpm_configured: config.rpm,
            unit: Unit {
                model_open: config.model.is_none(),
                calibration_open: config.calibration.is_none(),
                ..Unit::default()
            },
            status: SensorStatus { model: Some(model), calibration: source, ..SensorStatus::default() },
        })
    }

    /// Whether a packet is this sensor's.
    pub fn check(&self, packet: &Packet<'_>) -> Result<ReturnMode, Refusal> {
        identify::check(packet, self.spec.model)
    }

    pub fn take_telemetry(&mut self, telemetry: &Telemetry, arrival_ns: i64) {
        // An HDL-64E S1 sends no time that telemetry could place.
        if self.spec.model != Model::Hdl64eS1 {
            let tells_pps = self.spec.model != Model::Hdl32e && !self.spec.model.is_hdl64e();
            self.clock.telemetry(telemetry, tells_pps, arrival_ns);
        }
    }

    /// The revolution that [`Decoder::take`] or [`Decoder::finish`] said was done.
    pub fn finished(&self) -> &Revolution {
        &self.done
    }

    /// Revolutions finished so far.
    pub fn revolutions(&self) -> u64 {
        self.status.revolutions
    }

    /// The model's figures.
    pub fn spec(&self) -> &'static ModelSpec {
        self.spec
    }

    pub fn status(&self) -> SensorStatus {
        SensorStatus { packets_lost: self.loss.lost(), blocked: self.done.blocked.clone(), ..self.status.clone() }
    }

    /// Decodes a packet that [`Decoder::check`] let through and that comes after `gap`; whether it completed a turn,
    /// which it does only if it `may_cut`.
    pub fn take(&mut self, packet: &Packet<'_>, mode: ReturnMode, arrival_ns: i64, gap: Gap, may_cut: bool) -> bool {
        let mut done = self.change_mode(mode) && may_cut;
        self.status.packets += 1;
        self.listen_to_unit(packet, arrival_ns);

        let before = self.packet_azimuth;
        let firings = PacketFirings::new(packet, self.spec, mode, self.step_across(packet));
        self.step = firings.step;
        let span_ns = i64::from(self.spec.packet_period_ns(mode));
        let timed = self.spec.model != Model::Hdl64eS1;
        let elapsed_ns = if timed { span_ns } else { span_ns * self.packets_since(before, packet) };
        let device_us = timed.then(|| packet.device_us());
        let time_ns = self.clock.packet(device_us, elapsed_ns, arrival_ns, span_ns);

        let passed_ns = time_ns - std::mem::replace(&mut self.packet_ns, time_ns);
        let torn = self.take_gap(firings.azimuths(), gap, passed_ns);
        let first_row = self.current.firings.len();
        let cut = self.follow(&firings, time_ns, torn, may_cut && !done);
        self.decode(packet, 0, first_row);
        self.current.packets += 1;
        self.current.packets_expected += 1;
        if let Some(cut) = cut {
            self.end_turn(first_row + cut.firing, if torn { 0 } else { cut.travelled }, cut.time_ns);
            self.first_ns = cut.time_ns;
            (self.current.partial, self.current.packets, self.current.packets_expected) = (cut.partial, 1, 1);
            if self.learn_from_unit() {
                self.decode(packet, cut.firing, 0);
            }
            done = true;
        }
        done
    }

    /// Decodes a packet that was held, as [`Decoder::take`] does.
    pub fn take_due(&mut self, packet: &Packet<'_>, arrival_ns: i64, gap: Gap, may_cut: bool) -> bool {
        // It was let through when it came, which at most another of the HDL-64E's names has changed since.
        self.check(packet).is_ok_and(|mode| self.take(packet, mode, arrival_ns, gap, may_cut))
    }

    /// Ends the stream; whether there was an unfinished turn.
    pub fn finish(&mut self) -> bool {
        let Some(last) = self.current.firings.last() else { return false };
        let last_ns = self.first_ns + i64::from(last.offset_ns);
        if !self.turns.ends_at_cut(self.expected()) {
            self.current.partial.get_or_insert(Partial::End);
        }
        let travelled = self.turns.travelled();
        self.end_turn(self.current.firings.len(), travelled, last_ns);
        self.turns.forget();
        self.packet_azimuth = None;
        self.loss.finish();
        self.learn_from_unit();
        true
    }

    /// Ends the turn under way if the sensor was told to report other echoes: images of both do not mix.
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
        (self.step, self.firings_whole) = (None, None);
        self.current = Revolution::new(self.spec.model, mode, Arc::clone(&self.current.calibration));
        if !ended {
            self.done = self.current.clone();
        }
        ended
    }

    /// The step between packets, for those of a single firing (VLS-128, dual return).
    fn step_across(&mut self, packet: &Packet<'_>) -> Option<u32> {
        let azimuth = packet.azimuth(0);
        let before = self.packet_azimuth.replace(azimuth);
        let nominal = expected_step(self.spec, self.mode, self.rpm());
        let across = before.map(|before| crate::firing::forward(before, azimuth));
        Some(across.filter(|step| (nominal / 2..=nominal + nominal / 2).contains(step)).unwrap_or(nominal))
    }

    /// Packets from the one that began at azimuth `before` to this one, as a sensor without a clock shows them by
    /// turning.
    fn packets_since(&self, before: Option<u32>, packet: &Packet<'_>) -> i64 {
        let turned = before.map_or(0, |before| crate::firing::forward(before, packet.azimuth(0)));
        let firing = expected_step(self.spec, self.mode, self.rpm()).max(1);
        let one = firing * self.spec.firings_per_packet(self.mode) as u32;
        if turned > LONGEST_FORWARD { 1 } else { i64::from((turned + one / 2) / one).max(1) }
    }

    fn rpm(&self) -> f32 {
        self.rpm_configured.or(self.status.rpm).unwrap_or(self.spec.rpm_nominal)
    }

    /// Counts from firing to firing.
    fn expected(&self) -> u32 {
        self.step.unwrap_or(0) / self.spec.firings_per_block as u32
    }

    /// Counts from packet to packet.
    fn span(&self) -> u32 {
        self.expected() * self.spec.firings_per_packet(self.mode) as u32
    }

    /// Adds the packet's firings to the current turn and finds the one at which to cut: the first, if the turn is
    /// `torn` before it.
    fn follow(&mut self, firings: &PacketFirings, time_ns: i64, torn: bool, may_cut: bool) -> Option<Cut> {
        let (period_ns, expected) = (i64::from(self.spec.period_ns(self.mode)), self.expected());
        let overlong = self.current.firings.len() + MAX_FIRINGS > MAX_FIRINGS_PER_TURN;
        let mut cut: Option<Cut> = None;
        let mut rows = [Firing { azimuth_rad: 0.0, offset_ns: 0 }; MAX_FIRINGS];
        let mut offset_ns = self.current.firings.last().map_or(0, |firing| firing.offset_ns);
        let mut first_ns = self.first_ns;
        for (firing, azimuth) in firings.azimuths().iter().copied().enumerate() {
            let time_ns = time_ns.saturating_add(firing as i64 * period_ns);
            if self.current.firings.is_empty() && firing == 0 {
                self.begin_turn(azimuth, time_ns, expected);
                first_ns = time_ns;
            }
            let last = self.turns.last();
            let (mut step, crossed) = self.turns.follow(azimuth, expected);
            if step == Step::Gap && last.is_some_and(|last| self.loss.is_dark(last, azimuth, self.span())) {
                step = Step::Even;
            }
            let torn = torn && firing == 0;
            let (step, crossed) = (if torn { Step::Gap } else { step }, crossed || torn);
            let flaw = match step {
                Step::Even => (crossed && (!may_cut || cut.is_some())).then_some(Partial::Reversal),
                Step::Gap => Some(Partial::Gap),
                Step::Reversal => Some(Partial::Reversal),
            };
            let partial = cut.as_mut().map_or(&mut self.current.partial, |cut| &mut cut.partial);
            *partial = partial.or(flaw);
            if (crossed || overlong) && may_cut && cut.is_none() {
                let overlong = (!crossed).then_some(Partial::Overlong);
                self.current.partial = self.current.partial.or(overlong);
                let partial = flaw.or(overlong);
                cut = Some(Cut { firing, time_ns, travelled: self.turns.restart(), partial });
                (first_ns, offset_ns) = (time_ns, 0);
            }
            // Device time that runs backwards inside a turn stands still instead.
            offset_ns = offset_ns.max(u32::try_from((time_ns - first_ns).max(0)).unwrap_or(u32::MAX));
            rows[firing] = Firing::new(azimuth, offset_ns);
        }
        self.current.grow(&rows[..firings.azimuths().len()]);
        cut
    }

    /// Takes note of what is missing before a packet; whether that is a turn or more, or nobody knows how much.
    fn take_gap(&mut self, azimuths: &[u32], gap: Gap, passed_ns: i64) -> bool {
        let span = self.span();
        if gap.jumped {
            self.loss.jump();
        }
        let lost = self.loss.take(gap, azimuths, span);
        let turned = u64::from(gap.missing) * u64::from(span) >= u64::from(AZIMUTHS_PER_TURN);
        let torn = gap.jumped || turned || passed_ns > TURN_NS_MAX;
        if !self.current.firings.is_empty() {
            self.current.packets_expected = self.current.packets_expected.saturating_add(lost);
            return torn;
        }
        false
    }

    fn begin_turn(&mut self, azimuth: u32, time_ns: i64, expected: u32) {
        self.first_ns = time_ns;
        if !self.turns.starts_at_cut(azimuth, expected) {
            self.current.partial.get_or_insert(Partial::Start);
        }
    }

    /// Decodes the packet's firings from `first` on into rows from `row` on.
    fn decode(&mut self, packet: &Packet<'_>, first: usize, row: usize) {
        let step = self.step.unwrap_or(0);
        for block in 0..self.spec.blocks_used(self.mode) {
            let place = self.spec.place(block, self.mode);
            let Some(laser) = self.spec.first_laser(packet.flag(block)) else { continue };
            if place.firing < first {
                continue;
            }
            let slot = (row + place.firing - first) * self.spec.lasers + laser;
            let mut slots = self.current.echoes[place.echo].slots(slot);
            let (bank, azimuth) = (laser / RETURNS_PER_BLOCK, packet.azimuth(block));
            self.beams.decode(packet.returns(block), bank, azimuth, step, &mut slots);
        }
        if let [strongest, last] = self.current.echoes.as_mut_slice() {
            last.drop_repeats(strongest, row * self.spec.lasers);
        }
    }

    /// Gives away the first `rows` firings of the current turn; the others begin the next.
    fn end_turn(&mut self, rows: usize, travelled: u64, end_ns: i64) {
        self.done.begin_like(&self.current);
        self.current.move_tail(rows, &mut self.done);
        std::mem::swap(&mut self.current, &mut self.done);

        let lasted_ns = end_ns - self.first_ns;
        if travelled > 0 && lasted_ns > 0 {
            let turns = travelled as f64 / f64::from(AZIMUTHS_PER_TURN);
            self.status.rpm = Some((turns * 60e9 / lasted_ns as f64) as f32);
        }
        let rpm = self.rpm();
        let done = &mut self.done;
        done.sequence = self.status.revolutions;
        done.rpm = rpm;
        if done.partial.is_none() {
            self.firings_whole = Some(done.firings.len() as u32);
        }
        let nominal = self.spec.firings_per_turn(self.mode, rpm).min(MAX_FIRINGS_PER_TURN) as u32;
        done.firings_expected = self.firings_whole.unwrap_or(nominal);
        let stamp = self.clock.stamp(self.first_ns, &mut done.firings);
        (done.start_ns, done.end_ns) = (stamp.start_ns, stamp.end_ns);
        (done.clock, done.clock_offset_ms) = (stamp.clock, stamp.clock_offset_ms);
        (self.status.clock, self.status.clock_offset_ms) = (Some(stamp.clock), stamp.clock_offset_ms);
        let count_rad = std::f32::consts::TAU / AZIMUTHS_PER_TURN as f32;
        done.dark_rad = self.loss.dark().map(|ends| ends.map(|count| count as f32 * count_rad));
        self.status.revolutions += 1;
        self.status.returns += self.view.take(done);
    }

    fn listen_to_unit(&mut self, packet: &Packet<'_>, arrival_ns: i64) {
        if !self.spec.model.is_hdl64e() || self.spec.model == Model::Hdl64eS1 {
            return;
        }
        if let Some(told) = self.unit.clock.push(packet.status(), packet.device_us()) {
            self.clock.telemetry(&told, true, arrival_ns);
        }
        let found = self.unit.table.push(packet.status());
        let s3 = self.unit.table.is_s3() || self.mode == ReturnMode::Dual;
        if s3 && self.unit.model_open && self.spec.model == Model::Hdl64eS2 {
            self.unit.model = Some(Model::Hdl64eS3);
        }
        if let Some((_, calibration)) = found.filter(|_| self.unit.calibration_open)
            && *self.current.calibration != calibration
        {
            self.unit.calibration = Some(Arc::new(calibration));
        }
    }

    /// Between two turns: uses what the unit told of itself. Whether the turn begun must be decoded again.
    fn learn_from_unit(&mut self) -> bool {
        if let Some(model) = self.unit.model.take() {
            self.spec = model.spec();
            self.status.model = Some(model);
            self.current.model = model;
        }
        let Some(calibration) = self.unit.calibration.take() else { return false };
        self.beams = Beams::new(self.spec, &calibration);
        self.current.calibration = calibration;
        self.status.calibration = CalibrationSource::Unit;
        true
    }
}

/// Where a packet's firings are parted.
struct Cut {
    /// The first of the next turn, counted from the packet's first.
    firing: usize,
    time_ns: i64,
    travelled: u64,
    /// What the next turn misses from the start.
    partial: Option<Partial>,
}

//! One sensor behind one door: datagram in, revolution out.
//!
//! In: UDP payloads of one sensor, data and telemetry alike, in the order of their arrival. Out: [`Revolution`]s, in
//! the sensor's frame. A datagram that is refused leaves everything as it was.

use crate::blocked::Blocked;
use crate::calibration::Calibration;
use crate::clock::{Clock, GPS_LATE_NS_MAX};
use crate::decoder::Decoder;
use crate::identify::{self, Finding, PACKETS_HELD};
use crate::model::{Model, ReturnMode};
use crate::order::{Order, Way};
pub use crate::packet::Refusal;
use crate::packet::{PACKET_LENGTH, Packet};
use crate::revolution::Revolution;
use crate::telemetry::{Gprmc, Pps, TELEMETRY_LENGTH, Telemetry};

/// What is known of a sensor before its first datagram. `Default`: everything found from the data, turns cut behind
/// the vehicle.
#[derive(Clone, Debug, PartialEq)]
pub struct SensorConfig {
    /// Overrides the model found from the data.
    pub model: Option<Model>,
    /// Overrides the rpm found from the data.
    pub rpm: Option<f32>,
    /// The sensor's own table; otherwise the factory's, or the one in an HDL-64E's status bytes.
    pub calibration: Option<Calibration>,
    /// Where turns are cut, degrees of encoder angle.
    pub cut_azimuth_deg: f32,
    /// GPS time older than its arrival by more than this is not believed: [`crate::clock`].
    pub gps_late_ns_max: i64,
}

impl Default for SensorConfig {
    fn default() -> Self {
        Self { model: None, rpm: None, calibration: None, cut_azimuth_deg: 180.0, gps_late_ns_max: GPS_LATE_NS_MAX }
    }
}

/// Decodes one sensor's datagrams.
#[derive(Clone, Debug)]
pub struct Sensor {
    config: SensorConfig,
    /// Packets that came before the model was known.
    held: Vec<(Box<[u8]>, i64)>,
    held_unfit: u64,
    order: Order,
    decoder: Option<Box<Decoder>>,
    /// The newest telemetry with its arrival, and how many there were.
    telemetry: Option<(Telemetry, i64)>,
    telemetry_count: u64,
}

/// Whose per-laser corrections are in use.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum CalibrationSource {
    /// The model's nominal table.
    #[default]
    Factory,
    /// The one in [`SensorConfig`].
    Configured,
    /// The one an HDL-64E S2 or S3 sent of itself.
    Unit,
}

/// What the sensor has shown of itself so far.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SensorStatus {
    /// Found or configured.
    pub model: Option<Model>,
    /// From the packets.
    pub return_mode: Option<ReturnMode>,
    /// Measured over the last turn (or configured).
    pub rpm: Option<f32>,
    /// Data packets decoded; those held are not counted yet.
    pub packets: u64,
    /// Data packets held until the model is known, or until those before them have come.
    pub packets_held: usize,
    /// Data packets that were held, and then did not fit the model found: taken and not decoded.
    pub packets_unfit: u64,
    /// Data packets that never came, or too late, ±1 a gap. A long gap is counted a turn later, when it has not come
    /// back at the same place as the dark side of a field of view does. Of an HDL-64E S1, whose packets carry no time,
    /// gaps of less than half a turn.
    pub packets_lost: u64,
    /// Telemetry datagrams read.
    pub telemetry: u64,
    /// Returns (echoes with a range) in the revolutions given.
    pub returns: u64,
    /// Revolutions given.
    pub revolutions: u64,
    /// Where the sensor used to see and did not in the newest revolution.
    pub blocked: Blocked,
    /// Whose table is in use.
    pub calibration: CalibrationSource,
    /// The clock the newest revolution's stamps follow; `None` before the first.
    pub clock: Option<Clock>,
    /// By how much the host's clock is ahead of it, ms ([`Revolution::clock_offset_ms`]).
    pub clock_offset_ms: i64,
    /// State of the pulse per second in the newest telemetry.
    pub pps: Option<Pps>,
    /// The newest GPRMC.
    pub gprmc: Option<Gprmc>,
}

impl Sensor {
    /// A sensor that has seen nothing.
    pub fn new(config: SensorConfig) -> Self {
        Self {
            config,
            held: Vec::new(),
            held_unfit: 0,
            order: Order::default(),
            decoder: None,
            telemetry: None,
            telemetry_count: 0,
        }
    }

    /// Takes one UDP payload that arrived at `arrival_ns` (ns since the Unix epoch); gives the revolution it completed,
    /// if any. At most one turn is cut a datagram.
    ///
    /// Copies of packets and packets out of order by up to 32 leave no trace in the revolutions: a packet that follows
    /// the one before is decoded at once; behind a gap, and where the stream begins, packets are held until the missing
    /// one has come or 32 packet periods have passed.
    ///
    /// # Errors
    /// [`Refusal`] with the value that was wrong; the sensor's state is as if the datagram had not come.
    pub fn push(&mut self, payload: &[u8], arrival_ns: i64) -> Result<Option<&Revolution>, Refusal> {
        match payload.len() {
            TELEMETRY_LENGTH => self.push_telemetry(Telemetry::new(payload)?, arrival_ns),
            PACKET_LENGTH => return self.push_packet(&Packet::new(payload)?, payload, arrival_ns),
            length => return Err(Refusal::Length { length }),
        }
        Ok(None)
    }

    fn push_telemetry(&mut self, telemetry: Telemetry, arrival_ns: i64) {
        if let Some(decoder) = &mut self.decoder {
            decoder.take_telemetry(&telemetry, arrival_ns);
        }
        self.telemetry_count += 1;
        self.telemetry = Some((telemetry, arrival_ns));
    }

    fn push_packet(
        &mut self,
        packet: &Packet<'_>,
        payload: &[u8],
        arrival_ns: i64,
    ) -> Result<Option<&Revolution>, Refusal> {
        if self.decoder.is_none() {
            if self.held.iter().any(|(held, _)| **held == *payload) {
                let device_us = Some(packet.device_us());
                return Err(Refusal::Duplicate { device_us, azimuth: packet.azimuth(0) });
            }
            let Some(model) = self.find_model(packet)? else {
                self.held.push((payload.into(), arrival_ns));
                return Ok(None);
            };
            self.start(model, Some((packet, arrival_ns)))?;
            return Ok(None);
        }
        let Some(decoder) = &mut self.decoder else { return Ok(None) };
        let mode = decoder.check(packet)?;
        let mut done = match self.order.take(packet, decoder.spec(), mode, arrival_ns)? {
            Way::Next(gap) => decoder.take(packet, mode, arrival_ns, gap, true),
            Way::Held => false,
        };
        // What is due behind a cut waits for the next datagram: one revolution at a time.
        while !done && let Some(cut) = self.order.due(false, |packet, ns, gap| decoder.take_due(packet, ns, gap, true))
        {
            done = cut;
        }
        Ok(done.then(|| decoder.finished()))
    }

    /// The model, or `None` while the packet must be held.
    fn find_model(&self, packet: &Packet<'_>) -> Result<Option<Model>, Refusal> {
        if let Some(model) = self.config.model {
            return Ok(Some(model));
        }
        Ok(match identify::find(packet)? {
            Finding::Model(model) => Some(model),
            Finding::Hdl32eOrVlp16 => self.held.last().and_then(|(before, _)| {
                let before = Packet::new(before).ok()?;
                let full = (self.held.len() >= PACKETS_HELD).then_some(Model::Hdl32e);
                identify::by_rate(&before, packet).or(full)
            }),
        })
    }

    /// Makes the decoder and puts what was held, and `packet`, in order; without `packet`, at the stream's end. A
    /// stream's first packets all wait, and more than these: none passes yet.
    fn start(&mut self, model: Model, packet: Option<(&Packet<'_>, i64)>) -> Result<(), Refusal> {
        let mut decoder = Decoder::new(model, &self.config)?;
        if let Some((telemetry, arrival_ns)) = &self.telemetry {
            decoder.take_telemetry(telemetry, *arrival_ns);
        }
        let newest = packet.map(|(packet, ns)| Ok((packet, decoder.check(packet)?, ns))).transpose()?;
        let (mut order, mut unfit) = (Order::default(), 0);
        for (payload, arrival_ns) in &self.held {
            let held = Packet::new(payload)?;
            let taken = identify::is_of_two(model)
                && decoder.check(&held).is_ok_and(|mode| order.take(&held, decoder.spec(), mode, *arrival_ns).is_ok());
            unfit += u64::from(!taken);
        }
        if let Some((packet, mode, ns)) = newest
            && order.take(packet, decoder.spec(), mode, ns).is_err()
        {
            // What was held is from another time: the stream begins here.
            (order, unfit) = (Order::default(), self.held.len() as u64);
            order.take(packet, decoder.spec(), mode, ns)?;
        }
        self.held.clear();
        self.held_unfit += unfit;
        (self.order, self.decoder) = (order, Some(Box::new(decoder)));
        Ok(())
    }

    /// Ends the stream: the unfinished revolution, flagged partial unless it ends at the cut. The sensor can go on with
    /// a new turn afterwards.
    pub fn finish(&mut self) -> Option<&Revolution> {
        if self.decoder.is_none() && !self.held.is_empty() {
            // Too few packets to tell their rate: the byte is believed.
            self.start(Model::Hdl32e, None).ok()?;
        }
        let decoder = self.decoder.as_mut()?;
        while self.order.due(true, |packet, ns, gap| decoder.take_due(packet, ns, gap, false)).is_some() {}
        self.order.forget();
        decoder.finish().then(|| decoder.finished())
    }

    /// The newest revolution given, until the next one is.
    pub fn newest(&self) -> Option<&Revolution> {
        let decoder = self.decoder.as_ref()?;
        (decoder.revolutions() > 0).then(|| decoder.finished())
    }

    /// [`SensorStatus::packets_unfit`].
    pub fn packets_unfit(&self) -> u64 {
        self.held_unfit
    }

    /// The newest telemetry's GPRMC, if it had one.
    pub fn gprmc(&self) -> Option<&Gprmc> {
        self.telemetry.as_ref()?.0.gprmc.as_ref()
    }

    /// What is known so far.
    pub fn status(&self) -> SensorStatus {
        let mut status = self.decoder.as_ref().map(|decoder| decoder.status()).unwrap_or_default();
        status.model = status.model.or(self.config.model);
        status.rpm = self.config.rpm.or(status.rpm);
        status.packets_held = self.held.len() + self.order.held();
        status.packets_unfit = self.held_unfit;
        status.telemetry = self.telemetry_count;
        status.pps = self.telemetry.as_ref().map(|(telemetry, _)| telemetry.pps);
        status.gprmc = self.telemetry.as_ref().and_then(|(telemetry, _)| telemetry.gprmc.clone());
        status
    }
}

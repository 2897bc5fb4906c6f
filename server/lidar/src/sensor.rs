//! One sensor behind one door: datagram in, revolution out.
//!
//! In: UDP payloads of one sensor, data and telemetry alike, in the order of their arrival. Out: [`Revolution`]s, in the
//! sensor's frame. A datagram that is refused leaves everything as it was.

use crate::calibration::Calibration;
use crate::clock::Clock;
use crate::decoder::Decoder;
use crate::identify::{self, Finding, PACKETS_HELD};
use crate::model::{Model, ReturnMode};
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
}

impl Default for SensorConfig {
    fn default() -> Self {
        Self { model: None, rpm: None, calibration: None, cut_azimuth_deg: 180.0 }
    }
}

/// Decodes one sensor's datagrams.
#[derive(Clone, Debug)]
pub struct Sensor {
    config: SensorConfig,
    /// Packets that came before the model was known.
    held: Vec<(Box<[u8]>, i64)>,
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
    /// Data packets decoded; those held until the model is known are not counted yet.
    pub packets: u64,
    /// Data packets held until the model is known.
    pub packets_held: usize,
    /// Telemetry datagrams read.
    pub telemetry: u64,
    /// Returns (echoes with a range) in the revolutions given.
    pub returns: u64,
    /// Revolutions given.
    pub revolutions: u64,
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
        Self { config, held: Vec::new(), decoder: None, telemetry: None, telemetry_count: 0 }
    }

    /// Takes one UDP payload that arrived at `arrival_ns` (ns since the Unix epoch); gives the revolution it completed,
    /// if any. At most one turn is cut a datagram.
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
        let mut done = false;
        if self.decoder.is_none() {
            let Some(model) = self.find_model(packet)? else {
                self.held.push((payload.into(), arrival_ns));
                return Ok(None);
            };
            done = self.start(model, packet)?;
        }
        let Some(decoder) = &mut self.decoder else { return Ok(None) };
        let mode = decoder.check(packet)?;
        done = decoder.take(packet, mode, arrival_ns, !done) || done;
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

    /// Makes the decoder, if `packet` fits it, and decodes what was held; whether that completed a turn.
    fn start(&mut self, model: Model, packet: &Packet<'_>) -> Result<bool, Refusal> {
        let mut decoder = Decoder::new(model, &self.config)?;
        decoder.check(packet)?;
        if let Some((telemetry, arrival_ns)) = &self.telemetry {
            decoder.take_telemetry(telemetry, *arrival_ns);
        }
        let mut done = false;
        for (payload, arrival_ns) in self.held.drain(..) {
            let Ok(held) = Packet::new(&payload) else { continue };
            if let Ok(mode) = decoder.check(&held) {
                done = decoder.take(&held, mode, arrival_ns, !done) || done;
            }
        }
        self.decoder = Some(Box::new(decoder));
        Ok(done)
    }

    /// Ends the stream: the unfinished revolution, flagged partial unless it ends at the cut. The sensor can go on with
    /// a new turn afterwards.
    pub fn finish(&mut self) -> Option<&Revolution> {
        if let (None, Some((first, _))) = (&self.decoder, self.held.first()) {
            // Too few packets to tell their rate: the byte is believed.
            let first = first.clone();
            self.start(Model::Hdl32e, &Packet::new(&first).ok()?).ok()?;
        }
        let decoder = self.decoder.as_mut()?;
        decoder.finish().then(|| decoder.finished())
    }

    /// The newest revolution given, until the next one is.
    pub fn newest(&self) -> Option<&Revolution> {
        let decoder = self.decoder.as_ref()?;
        (decoder.revolutions() > 0).then(|| decoder.finished())
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
        status.packets_held = self.held.len();
        status.telemetry = self.telemetry_count;
        status.pps = self.telemetry.as_ref().map(|(telemetry, _)| telemetry.pps);
        status.gprmc = self.telemetry.as_ref().and_then(|(telemetry, _)| telemetry.gprmc.clone());
        status
    }
}

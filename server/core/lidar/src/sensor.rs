//! One sensor: datagrams in, revolutions out.
//!
//! In: UDP payloads of one sensor, data and telemetry, in order of arrival. Out: [`Revolution`]s in the sensor's frame.
//! A datagram that is refused changes nothing.

use crate::config::SensorConfig;
use crate::datagram::DatagramError;
use crate::datagram::nmea::Gprmc;
use crate::datagram::packet::Packet;
use crate::datagram::telemetry::{TELEMETRY_LENGTH, Telemetry};
use crate::model::Model;
use crate::revolution::Revolution;
use crate::status::SensorStatus;
use crate::stream::decoder::{Decoder, MayCut};
use crate::stream::identify::{self, Finding, PACKETS_WAITING_MAX};
use crate::stream::order::Order;

/// The decoder of one sensor's datagrams.
///
/// ```
/// use clearway_lidar::{Model, Sensor, SensorConfig};
///
/// // A packet of a VLP-16: 12 blocks, each with flag, azimuth and 32 returns at 1,000 counts of 2 mm.
/// let mut packet = Vec::new();
/// for block in 0..12_u16 {
///     packet.extend([0xFF, 0xEE]);
///     packet.extend((block * 40).to_le_bytes());
///     (0..32).for_each(|_| packet.extend([0xE8, 0x03, 100]));
/// }
/// packet.extend(5_000_000_u32.to_le_bytes()); // microseconds past the hour
/// packet.extend([0x37, 0x22]); // strongest return, VLP-16
///
/// let mut sensor = Sensor::new(SensorConfig::default());
/// let arrival_ns = 1_700_000_000_000_000_000;
/// assert!(sensor.push(&packet, arrival_ns)?.is_none()); // the revolution is not complete
/// assert_eq!(sensor.status().model, Some(Model::Vlp16));
///
/// let revolution = sensor.finish().expect("one packet was pushed");
/// assert_eq!(revolution.points().count(), 24 * 16);
/// let point = revolution.points().next().expect("a return");
/// assert_eq!((point.range_m, point.intensity), (2.0, 100));
/// # Ok::<(), clearway_lidar::DatagramError>(())
/// ```
#[derive(Clone, Debug)]
pub struct Sensor {
    config: SensorConfig,
    /// Packets that wait for the model, with their arrivals.
    waiting: Vec<(Box<[u8]>, i64)>,
    packets_unfit: u64,
    order: Order,
    /// `None` until the model is known.
    decoder: Option<Box<Decoder>>,
    /// Newest telemetry and its arrival.
    telemetry: Option<(Telemetry, i64)>,
    telemetry_count: u64,
}

impl Sensor {
    /// A sensor without any datagrams.
    pub fn new(config: SensorConfig) -> Self {
        Self {
            config,
            waiting: Vec::new(),
            packets_unfit: 0,
            order: Order::default(),
            decoder: None,
            telemetry: None,
            telemetry_count: 0,
        }
    }

    /// Adds one UDP payload that arrived at `arrival_ns` (ns since the Unix epoch), and returns the revolution that it
    /// completes, if any. A datagram ends at most one revolution.
    ///
    /// Copies of packets, and packets that are late by up to 32 packets, change no revolution: a packet that follows
    /// the packet before is decoded at once. Behind a gap, and at the start of a stream, packets wait until the missing
    /// packet has arrived or 32 packet periods have passed.
    ///
    /// # Errors
    /// The state of the sensor is then as if the datagram had not arrived.
    /// - [`DatagramError::Length`], [`DatagramError::BlockFlag`], [`DatagramError::Azimuth`] or [`DatagramError::Nmea`]
    ///   if the datagram cannot be parsed.
    /// - [`DatagramError::BlockFlag`] or [`DatagramError::Model`] if it is of no model, or of another model.
    /// - [`DatagramError::Duplicate`], [`DatagramError::Late`] or [`DatagramError::DeviceTime`] if it is a copy, too
    ///   late, or its device time does not follow.
    /// - [`DatagramError::Calibration`] if the configured calibration does not fit the model.
    pub fn push(&mut self, payload: &[u8], arrival_ns: i64) -> Result<Option<&Revolution>, DatagramError> {
        // Parse.
        if payload.len() == TELEMETRY_LENGTH {
            self.apply_telemetry(Telemetry::new(payload)?, arrival_ns);
            return Ok(None);
        }
        let packet = Packet::new(payload)?;

        // Identify.
        let Some(decoder) = &mut self.decoder else { return self.identify(packet, arrival_ns).map(|()| None) };
        let mode = decoder.check(&packet, self.config.model.is_some())?;

        // Reorder; decode and cut. Packets behind a cut wait for the next datagram, which may end another revolution.
        let in_order = self.order.push(packet, decoder.spec(), mode, arrival_ns)?;
        let mut is_done = in_order.is_some_and(|packet| decoder.decode_and_cut(&packet, MayCut::Yes));
        while !is_done && let Some(packet) = self.order.pop_due() {
            is_done = decoder.decode_and_cut(&packet, MayCut::Yes);
        }
        Ok(if is_done { self.newest() } else { None })
    }

    fn apply_telemetry(&mut self, telemetry: Telemetry, arrival_ns: i64) {
        if let Some(decoder) = &mut self.decoder {
            decoder.apply_telemetry(&telemetry, arrival_ns);
        }
        self.telemetry_count += 1;
        self.telemetry = Some((telemetry, arrival_ns));
    }

    /// Finds the model from a packet, and starts the decoder if it is known; otherwise the packet waits.
    fn identify(&mut self, packet: Packet<'_>, arrival_ns: i64) -> Result<(), DatagramError> {
        let payload = packet.bytes();
        if self.waiting.iter().any(|(waiting, _)| **waiting == *payload) {
            let device_us = Some(packet.device_us());
            return Err(DatagramError::Duplicate { device_us, azimuth: packet.azimuth(0) });
        }
        match self.find_model(&packet)? {
            Some(model) => self.start(model, Some((packet, arrival_ns))),
            None => {
                self.waiting.push((payload.as_slice().into(), arrival_ns));
                Ok(())
            }
        }
    }

    /// The model; `None` if another packet is needed to find it.
    fn find_model(&self, packet: &Packet<'_>) -> Result<Option<Model>, DatagramError> {
        if let Some(model) = self.config.model {
            return Ok(Some(model));
        }
        Ok(match identify::find(packet)? {
            Finding::Model(model) => Some(model),
            Finding::Hdl32eOrVlp16 => self.waiting.last().and_then(|(before, _)| {
                let before = Packet::new(before).ok()?;
                let is_full = (self.waiting.len() >= PACKETS_WAITING_MAX).then_some(Model::Hdl32e);
                identify::find_by_rate(&before, packet).or(is_full)
            }),
        })
    }

    /// Starts the decoder, and puts the waiting packets and `packet` in order; `packet` is `None` at the end of the
    /// stream. None of them passes yet, because more packets than these wait at the start of a stream.
    fn start(&mut self, model: Model, packet: Option<(Packet<'_>, i64)>) -> Result<(), DatagramError> {
        let mut decoder = Decoder::new(model, &self.config)?;
        if let Some((telemetry, arrival_ns)) = &self.telemetry {
            decoder.apply_telemetry(telemetry, *arrival_ns);
        }
        let is_given = self.config.model.is_some();
        let newest = packet.map(|(packet, ns)| Ok((packet, decoder.check(&packet, is_given)?, ns))).transpose()?;
        let (mut order, mut unfit) = (Order::default(), 0);
        for (payload, arrival_ns) in &self.waiting {
            let packet = Packet::new(payload)?;
            let fits = identify::is_of_two(model)
                && decoder
                    .check(&packet, is_given)
                    .is_ok_and(|mode| order.push(packet, decoder.spec(), mode, *arrival_ns).is_ok());
            unfit += u64::from(!fits);
        }
        if let Some((packet, mode, ns)) = newest
            && order.push(packet, decoder.spec(), mode, ns).is_err()
        {
            // The waiting packets are from another time: the stream begins with this packet.
            (order, unfit) = (Order::default(), self.waiting.len() as u64);
            order.push(packet, decoder.spec(), mode, ns)?;
        }
        self.waiting.clear();
        self.packets_unfit += unfit;
        (self.order, self.decoder) = (order, Some(Box::new(decoder)));
        Ok(())
    }

    /// Ends the stream, and returns the unfinished revolution. It is partial unless it ends at the cut. Another stream
    /// may follow.
    pub fn finish(&mut self) -> Option<&Revolution> {
        if self.decoder.is_none() && !self.waiting.is_empty() {
            // There are too few packets to measure their rate, so the model byte decides.
            self.start(Model::Hdl32e, None).ok()?;
        }
        let decoder = self.decoder.as_mut()?;
        while let Some(packet) = self.order.pop_waiting() {
            decoder.decode_and_cut(&packet, MayCut::No);
        }
        self.order.reset();
        decoder.finish().then(|| decoder.finished())
    }

    /// The newest revolution; `None` before the first.
    pub fn newest(&self) -> Option<&Revolution> {
        let decoder = self.decoder.as_ref()?;
        (decoder.revolutions() > 0).then(|| decoder.finished())
    }

    /// Number of packets that did not fit the model ([`SensorStatus::packets_unfit`]).
    pub fn packets_unfit(&self) -> u64 {
        self.packets_unfit
    }

    /// GPRMC of the newest telemetry, if it has one.
    pub fn gprmc(&self) -> Option<&Gprmc> {
        self.telemetry.as_ref()?.0.gprmc.as_ref()
    }

    /// The state of the sensor.
    pub fn status(&self) -> SensorStatus {
        let mut status = self.decoder.as_ref().map(|decoder| decoder.status()).unwrap_or_default();
        status.model = status.model.or(self.config.model);
        status.rpm = self.config.rpm.or(status.rpm);
        status.packets_waiting = self.waiting.len() + self.order.waiting();
        status.packets_unfit = self.packets_unfit;
        status.telemetry = self.telemetry_count;
        status.pps = self.telemetry.as_ref().map(|(telemetry, _)| telemetry.pps);
        status.gprmc = self.telemetry.as_ref().and_then(|(telemetry, _)| telemetry.gprmc.clone());
        status
    }
}

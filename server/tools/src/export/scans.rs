//! The events of a recording -> the scans of each sensor, decoded again: points in the sensor frame.
//!
//! The sensors come from the recorded configuration and calibrations. The points are not compensated for the motion of
//! the vehicle, and include points that the maps leave out (the vehicle itself, blind sectors).

use std::collections::BTreeMap;

use anyhow::{Context, Result};
use clearway_client::v1;
use clearway_lidar::Sensor;
use clearway_lidar::calibration::Calibration;
use clearway_lidar::revolution::Revolution;
use clearway_mapping::config::{Extrinsics, SensorConfig, TimeConfig};
use clearway_proto::packed::unpack;
use nalgebra::Isometry3;
use prost::Message;
use serde::Deserialize;

use clearway_journal::mcap_reader::Header;

/// One scan of one sensor.
pub struct DecodedScan<'a> {
    /// Name of the sensor.
    pub sensor: &'a str,
    /// Stamp of its end, in nanoseconds since the Unix epoch.
    pub stamp_ns: i64,
    /// Position and orientation of the sensor in the ego frame.
    pub ego_from_sensor: &'a Isometry3<f64>,
    /// The points in the sensor frame.
    pub points: ScanPoints,
}

/// The points of a scan, in the sensor frame.
#[derive(Default)]
pub struct ScanPoints {
    /// Positions in metres.
    pub at: Vec<[f32; 3]>,
    /// Rank of each point's laser by elevation; empty if unknown.
    pub ring: Vec<u16>,
    /// Time of each point relative to the stamp of the scan, in nanoseconds; empty if unknown.
    pub offset_ns: Vec<i32>,
}

/// The decoders of the sensors of a recording, by vehicle and index.
pub struct ScanDecoder(BTreeMap<String, BTreeMap<usize, OneSensor>>);

/// One sensor and its decoder.
struct OneSensor {
    name: String,
    /// Its declaration; `None` for a sensor of the configuration.
    declaration: Option<v1::Sensor>,
    ego_from_sensor: Isometry3<f64>,
    /// The rule of its vehicle ([`TimeConfig::ahead_ns_max`]).
    ahead_ns_max: i64,
    decoder: Sensor,
}

/// The parts of the recorded configuration that are needed to decode.
#[derive(Deserialize)]
struct RecordedConfig {
    #[serde(rename = "vehicle")]
    vehicles: Vec<RecordedSensors>,
}

#[derive(Deserialize)]
struct RecordedSensors {
    name: String,
    /// A recording without this table is older than epochs.
    #[serde(default = "without_epochs")]
    time: TimeConfig,
    #[serde(rename = "sensor")]
    sensors: Vec<SensorConfig>,
}

fn without_epochs() -> TimeConfig {
    TimeConfig::WITHOUT_EPOCHS
}

impl ScanDecoder {
    /// The decoders of the sensors in the recording's header; none if it has no configuration.
    ///
    /// # Errors
    /// If the configuration or a calibration in the header is wrong.
    pub fn new(header: &Header) -> Result<Self> {
        let Some(config) = &header.config else { return Ok(Self(BTreeMap::new())) };
        let config: RecordedConfig = toml::from_str(config).context("attachment config.toml")?;
        let sensors = |vehicle: RecordedSensors| {
            let one = |sensor: &SensorConfig| {
                let name = format!("calibration/{}/{}.yaml", vehicle.name, sensor.name);
                let table = header.calibrations.get(&name).map(|table| Calibration::load_str(table));
                let table = table.transpose().with_context(|| format!("attachment {name}"))?;
                Ok(OneSensor::new(sensor, vehicle.time.ahead_ns_max(), table))
            };
            let sensors = vehicle.sensors.iter().map(one).collect::<Result<Vec<_>>>()?;
            let sensors = sensors.into_iter().enumerate().collect();
            Ok((vehicle.name.clone(), sensors))
        };
        config.vehicles.into_iter().map(sensors).collect::<Result<_>>().map(Self)
    }

    /// Decodes an event of a vehicle's journal; returns the scan that it completes. A refused datagram completes none.
    ///
    /// # Errors
    /// If the bytes are not an event.
    pub fn decode(&mut self, vehicle: &str, event: &[u8]) -> Result<Option<DecodedScan<'_>>> {
        use v1::event::Body;
        let Some(sensors) = self.0.get_mut(vehicle) else { return Ok(None) };
        let event = v1::Event::decode(event).with_context(|| format!("journal of {vehicle}"))?;
        let index = event.source as usize;
        if let Some(Body::Sensor(sensor)) = &event.body {
            // A repeated declaration changes nothing; another declaration at its index follows its withdrawal.
            let is_known = |known: &OneSensor| known.declaration.as_ref().is_none_or(|known| known == sensor);
            if !sensors.get(&index).is_some_and(is_known) {
                let ahead_ns_max = sensors.values().next().map_or(0, |first| first.ahead_ns_max);
                let new = OneSensor::new(&declared(sensor), ahead_ns_max, None);
                sensors.insert(index, OneSensor { declaration: Some(sensor.clone()), ..new });
            }
            return Ok(None);
        }
        let Some(OneSensor { name, ego_from_sensor, decoder, .. }) = sensors.get_mut(&index) else { return Ok(None) };
        let scan = match &event.body {
            Some(Body::Datagram(payload)) => {
                decoder.push(payload, event.arrival_ns).ok().flatten().map(from_revolution)
            }
            Some(Body::End(_) | Body::Withdrawn(_)) => decoder.finish().map(from_revolution),
            Some(Body::Scan(scan)) => from_scan(scan),
            _ => None,
        };
        Ok(scan.map(|(stamp_ns, points)| DecodedScan { sensor: name, stamp_ns, ego_from_sensor, points }))
    }
}

impl OneSensor {
    fn new(config: &SensorConfig, ahead_ns_max: i64, table: Option<Calibration>) -> Self {
        Self {
            name: config.name.clone(),
            declaration: None,
            ego_from_sensor: config.extrinsics.ego_from_sensor(),
            ahead_ns_max,
            decoder: Sensor::new(config.lidar(table, ahead_ns_max)),
        }
    }
}

fn from_revolution(revolution: &Revolution) -> (i64, ScanPoints) {
    let mut points = ScanPoints::default();
    for point in revolution.points() {
        points.at.push([point.x, point.y, point.z]);
        points.ring.push(point.ring);
        points.offset_ns.push(point.time_ns.saturating_sub(revolution.end_ns) as i32);
    }
    (revolution.end_ns, points)
}

/// The stamp and the points of a recorded scan; `None` if its lists differ in length.
fn from_scan(scan: &v1::Scan) -> Option<(i64, ScanPoints)> {
    let [x, y, z]: [Vec<f32>; 3] = [unpack(&scan.x)?, unpack(&scan.y)?, unpack(&scan.z)?];
    let (ring, offset_ns): (Vec<u16>, Vec<i32>) = (unpack(&scan.ring)?, unpack(&scan.offset_ns)?);
    let n = x.len();
    let is_whole = [y.len(), z.len()] == [n; 2] && [ring.len(), offset_ns.len()].iter().all(|of| [0, n].contains(of));
    let at = x.iter().zip(&y).zip(&z).map(|((&x, &y), &z)| [x, y, z]).collect();
    is_whole.then_some((scan.stamp_ns, ScanPoints { at, ring, offset_ns }))
}

/// The configuration of a sensor that a client declared, as far as decoding needs it.
fn declared(sensor: &v1::Sensor) -> SensorConfig {
    let &v1::Sensor { x_m, y_m, z_m, roll_deg, pitch_deg, yaw_deg, .. } = sensor;
    let plain = SensorConfig::new(&sensor.name, Extrinsics { x_m, y_m, z_m, roll_deg, pitch_deg, yaw_deg });
    SensorConfig {
        model: sensor.model.as_deref().and_then(|name| name.parse().ok()),
        rpm: sensor.rpm,
        cut_azimuth_deg: sensor.cut_azimuth_deg.unwrap_or(plain.cut_azimuth_deg),
        gps_late_days_max: sensor.gps_late_days_max.unwrap_or(plain.gps_late_days_max),
        ..plain
    }
}

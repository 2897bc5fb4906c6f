//! A simulated vehicle: a scene driven, a sensor turning on the roof, datagrams without end.
//!
//! In: scene, sensor, start. Out: [`Datagram`]s in device-time order, the pose at any time, whole decoded turns with
//! the truth beside them.

use std::sync::Arc;

use clearway_lidar::model::Model;
use clearway_lidar::revolution::Revolution;
use clearway_lidar::{Sensor, SensorConfig};
use nalgebra::{Isometry3, Point3};

use crate::scene::course::{Course, Drive};
use crate::scene::scenes::Scene;
use crate::scene::truth::{Limits, TruthGrid};
use crate::scene::world::World;
use crate::sensor::encode::Encoder;
use crate::sensor::raycast::Caster;
use crate::sensor::scanner::{Scanner, ScannerConfig};
use crate::sensor::telemetry::{Datum, Fix, telemetry};

/// Which port a datagram goes to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// 1206 bytes (port 2368 out of the box).
    Data,
    /// 512 bytes (port 8308).
    Telemetry,
}

/// One datagram and when the sensor sends it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Datagram {
    /// ns since the Unix epoch: just after the last firing in it.
    pub stamp_ns: i64,
    /// What it is.
    pub kind: Kind,
    /// The UDP payload.
    pub payload: Vec<u8>,
}

/// A whole turn as the decoder gives it, with what the simulator knows.
#[derive(Clone, Debug)]
pub struct Turn {
    /// Decoded from the turn's own datagrams.
    pub revolution: Revolution,
    /// `map_from_ego` at the revolution's end stamp.
    pub map_from_ego: Isometry3<f64>,
    /// The truth about the ego frame at that stamp.
    pub truth: TruthGrid,
}

/// From one telemetry datagram to the next: the HDL-64E and its kin send about a hundred a second.
const TELEMETRY_PERIOD_NS: i64 = 10_000_000;
/// 2026-01-01 12:00:00 UTC.
const NOON_NS: i64 = 1_767_268_800_000_000_000;
const SECOND_NS: i64 = 1_000_000_000;

/// A vehicle that drives through a scene and sends what its sensor sees.
#[derive(Clone, Debug)]
pub struct SimulatedVehicle {
    scene: Scene,
    scanner: Scanner,
    datum: Datum,
    /// The scene's time 0, and firing 0, ns since the Unix epoch.
    start_ns: i64,
    caster: Caster<Arc<World>>,
    encoder: Encoder,
    next_firing: i64,
    next_telemetry_ns: i64,
    /// A packet that waits for the telemetry due before it.
    waiting: Option<Datagram>,
}

impl SimulatedVehicle {
    /// A vehicle at the beginning of its scene, which is noon on 2026-01-01, UTC.
    pub fn new(scene: Scene, config: ScannerConfig) -> Self {
        Self::starting_at(scene, config, NOON_NS)
    }

    /// The same beginning at `start_ns` (ns since the Unix epoch), as a live run wants it.
    pub fn starting_at(scene: Scene, config: ScannerConfig, start_ns: i64) -> Self {
        let scanner = Scanner::new(config);
        let config = scanner.config();
        let encoder = Encoder::new(config.model, config.return_mode, scanner.calibration());
        let at: [f64; 3] = (scene.pose_at(0.0) * config.ego_from_sensor).translation.vector.into();
        let caster = Caster::new(scene.world.clone(), at, 0.0, config.range_m_max);
        let next_telemetry_ns = start_ns;
        let datum = Datum::default();
        Self { scene, scanner, datum, start_ns, caster, encoder, next_firing: 0, next_telemetry_ns, waiting: None }
    }

    /// The scene it drives in.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// Its sensor.
    pub fn scanner(&self) -> &Scanner {
        &self.scanner
    }

    /// The scene's time 0, and firing 0, ns since the Unix epoch.
    pub fn start_ns(&self) -> i64 {
        self.start_ns
    }

    /// The place on the globe of the world's origin.
    pub fn datum(&self) -> Datum {
        self.datum
    }

    /// `map_from_ego` at `stamp_ns`.
    pub fn pose_at(&self, stamp_ns: i64) -> Isometry3<f64> {
        self.scene.pose_at(self.time(stamp_ns))
    }

    /// Speed at `stamp_ns`, m/s.
    pub fn speed_at(&self, stamp_ns: i64) -> f64 {
        self.scene.drive.speed_at(self.time(stamp_ns))
    }

    /// The truth about the ground around the vehicle at `stamp_ns`, `half_extent_m` to each side in cells of `cell_m`.
    pub fn truth_at(&self, stamp_ns: i64, half_extent_m: f64, cell_m: f64, limits: &Limits) -> TruthGrid {
        let (pose, time) = (self.pose_at(stamp_ns), self.time(stamp_ns));
        TruthGrid::about(&self.scene.world, &pose, time, (half_extent_m, cell_m), limits)
    }

    /// Whether the ground in each cell of a truth raster made for `stamp_ns` can be seen by the sensor then, in its
    /// order.
    pub fn sees(&self, stamp_ns: i64, truth: &TruthGrid) -> Vec<bool> {
        let (map_from_ego, time) = (self.pose_at(stamp_ns), self.time(stamp_ns));
        let eye: [f64; 3] = (map_from_ego * self.scanner.config().ego_from_sensor).translation.vector.into();
        let caster = Caster::new(self.scene.world.clone(), eye, time, self.scanner.config().range_m_max);
        let sees = |index: usize| {
            let (x, y) = truth.middle(index);
            let place = map_from_ego * Point3::new(x, y, f64::from(truth.heights[index]));
            caster.sees_ground(eye, place.x, place.y)
        };
        (0..truth.classes.len()).map(sees).collect()
    }

    /// The datagrams from the beginning of turn `number` on (0 starts at the scene's beginning; turns before exist
    /// too).
    pub fn from_turn(mut self, number: i64) -> Self {
        let per_packet = self.scanner.spec().firings_per_packet(self.scanner.config().return_mode) as i64;
        let packet = self.scanner.first_firing_of(number).div_euclid(per_packet);
        self.next_firing = packet * per_packet;
        self.encoder = self.encoder.at_packet(packet);
        let stamp_ns = self.start_ns + self.scanner.firing_ns(self.next_firing);
        self.next_telemetry_ns = stamp_ns - stamp_ns.rem_euclid(TELEMETRY_PERIOD_NS);
        self.waiting = None;
        self
    }

    /// Turn `number`, whole, through real datagrams and the decoder, and the truth 60 m around in cells of 0.2 m at its
    /// end.
    ///
    /// # Panics
    /// If the decoder refuses a datagram of the encoder's or finds no whole turn: a fault of this project.
    pub fn turn(&self, number: i64) -> Turn {
        let revolution = self.revolution(number);
        let map_from_ego = self.pose_at(revolution.end_ns);
        let truth = self.truth_at(revolution.end_ns, 60.0, 0.2, &Limits::default());
        Turn { revolution, map_from_ego, truth }
    }

    /// Turn `number`, whole, through real datagrams and the decoder: the one whose middle is the encoder's zero, ahead
    /// of the vehicle, at time `number * 60 / rpm`.
    ///
    /// # Panics
    /// As [`SimulatedVehicle::turn`].
    pub fn revolution(&self, number: i64) -> Revolution {
        let config = SensorConfig {
            model: Some(self.scanner.config().model),
            // A VLS-128's dual-return packets hold one firing: alone they do not show how fast it turns.
            rpm: Some(self.scanner.config().rpm as f32),
            calibration: Some(self.scanner.calibration().clone()),
            ..SensorConfig::default()
        };
        let mut sensor = Sensor::new(config);
        // The decoder cuts turns behind the vehicle, half a turn before the encoder's zero. An angle that rounds to
        // that begins a turn one firing early.
        let half_turn_ns = (30e9 / self.scanner.config().rpm) as i64;
        let slack_ns = self.scanner.firing_ns(2);
        let begins_ns =
            self.start_ns + self.scanner.firing_ns(self.scanner.first_firing_of(number)) - half_turn_ns - slack_ns;
        for datagram in self.clone().from_turn(number - 1) {
            let revolution = sensor.push(&datagram.payload, datagram.stamp_ns);
            if let Some(revolution) = revolution.expect("the decoder takes what the encoder makes")
                && revolution.partial.is_none()
                && revolution.start_ns > begins_ns
            {
                return revolution.clone();
            }
        }
        unreachable!("datagrams do not end")
    }

    /// From the next firing on, which this gives the stamp of, the vehicle follows an arc of this curvature (1/m, left
    /// positive) from where it is, at `speed` m/s. What is asked about the time before is from then on told as if it
    /// had always done so.
    pub fn steer(&mut self, curvature: f64, speed: f64) -> i64 {
        let offset_ns = self.scanner.firing_ns(self.next_firing);
        let time = offset_ns as f64 * 1e-9;
        let (x, y, heading) = self.scene.drive.at(time);
        let course = Course::from(x, y, heading);
        let course = if curvature == 0.0 {
            course.straight(1.0)
        } else {
            course.arc(curvature.recip().abs(), curvature.signum())
        };
        self.scene.drive = Drive::steady(Arc::new(course), -speed * time, 0.0, speed);
        self.start_ns + offset_ns
    }

    fn time(&self, stamp_ns: i64) -> f64 {
        (stamp_ns - self.start_ns) as f64 * 1e-9
    }

    fn next_packet(&mut self) -> Datagram {
        loop {
            let offset_ns = self.scanner.firing_ns(self.next_firing);
            let time = offset_ns as f64 * 1e-9;
            let map_from_sensor = self.scene.pose_at(time) * self.scanner.config().ego_from_sensor;
            self.caster.move_to(map_from_sensor.translation.vector.into(), time);
            let stamp_ns = self.start_ns + offset_ns;
            let firing = self.scanner.fire(&self.caster, &map_from_sensor, self.next_firing, stamp_ns);
            self.next_firing += 1;
            if let Some(payload) = self.encoder.push(firing) {
                let sent_ns = self.start_ns + self.scanner.firing_ns(self.next_firing);
                return Datagram { stamp_ns: sent_ns, kind: Kind::Data, payload: payload.to_vec() };
            }
        }
    }

    fn telemetry(&self, stamp_ns: i64) -> Datagram {
        // The receiver speaks once a second, of the last whole second.
        let fix_ns = stamp_ns - stamp_ns.rem_euclid(SECOND_NS);
        let (x, y, heading) = self.scene.drive.at(self.time(fix_ns));
        let (latitude_deg, longitude_deg) = self.datum.globe(x, y);
        let course_deg = (90.0 - heading.to_degrees()).rem_euclid(360.0);
        let fix = Fix { stamp_ns: fix_ns, latitude_deg, longitude_deg, speed_mps: self.speed_at(fix_ns), course_deg };
        Datagram { stamp_ns, kind: Kind::Telemetry, payload: telemetry(stamp_ns, &fix).to_vec() }
    }
}

impl Iterator for SimulatedVehicle {
    type Item = Datagram;

    /// The next datagram; there is always one.
    fn next(&mut self) -> Option<Datagram> {
        let packet = self.waiting.take().unwrap_or_else(|| self.next_packet());
        // An S1 has neither clock nor receiver.
        let speaks = self.scanner.config().model != Model::Hdl64eS1;
        if speaks && self.next_telemetry_ns <= packet.stamp_ns {
            let datagram = self.telemetry(self.next_telemetry_ns);
            self.next_telemetry_ns += TELEMETRY_PERIOD_NS;
            self.waiting = Some(packet);
            return Some(datagram);
        }
        Some(packet)
    }
}

//! A simulated vehicle that drives through a scene with one rotating sensor and sends datagrams without end.
//!
//! In: scene, sensor, start. Out: [`Datagram`]s in device-time order, the pose at any time, whole decoded revolutions
//! with the truth about the ground.

use std::sync::Arc;
use std::time::Duration;

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

/// Kind of a datagram, which decides its port.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Data packet of 1206 bytes (factory setting: port 2368).
    Data,
    /// Telemetry of 512 bytes (port 8308).
    Telemetry,
}

/// One datagram, and the time at which the sensor sends it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Datagram {
    /// Time just after the last firing in it, ns since the Unix epoch.
    pub stamp_ns: i64,
    /// Data packet or telemetry.
    pub kind: Kind,
    /// Payload of the UDP datagram, without headers.
    pub payload: Vec<u8>,
}

/// A whole revolution as the decoder gives it, with the truth of the simulation.
#[derive(Clone, Debug)]
pub struct TrueRevolution {
    /// Decoded from the revolution's own datagrams.
    pub revolution: Revolution,
    /// `map_from_ego` at the revolution's end stamp.
    pub map_from_ego: Isometry3<f64>,
    /// The truth about the ground in the ego frame at that stamp.
    pub truth: TruthGrid,
}

/// Time from one telemetry datagram to the next: the sensors send about a hundred a second.
const TELEMETRY_PERIOD_NS: i64 = 10_000_000;
/// 2026-01-01 12:00:00 UTC.
const NOON_NS: i64 = 1_767_268_800_000_000_000;
const SECOND_NS: i64 = 1_000_000_000;

/// A vehicle that drives through a scene and sends what its sensor measures.
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
    /// A vehicle at the beginning of its scene, at noon on 2026-01-01, UTC.
    pub fn new(scene: Scene, config: ScannerConfig) -> Self {
        Self::starting_at(scene, config, NOON_NS)
    }

    /// A vehicle whose scene begins at `start_ns` (ns since the Unix epoch), for a live run.
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

    /// The scene in which the vehicle drives.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// The LIDAR on the vehicle.
    pub fn scanner(&self) -> &Scanner {
        &self.scanner
    }

    /// The scene's time 0, and firing 0, ns since the Unix epoch.
    pub fn start_ns(&self) -> i64 {
        self.start_ns
    }

    /// The stamp of the next firing, ns since the Unix epoch.
    pub fn next_stamp_ns(&self) -> i64 {
        self.start_ns + self.scanner.firing_ns(self.next_firing)
    }

    /// Geographic position of the world's origin.
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

    /// The same raster, still about the vehicle at `stamp_ns`, with the things where they were `ago_ns` before.
    pub fn truth_before(
        &self,
        stamp_ns: i64,
        ago_ns: i64,
        half_extent_m: f64,
        cell_m: f64,
        limits: &Limits,
    ) -> TruthGrid {
        let (pose, time) = (self.pose_at(stamp_ns), self.time(stamp_ns - ago_ns));
        TruthGrid::about(&self.scene.world, &pose, time, (half_extent_m, cell_m), limits)
    }

    /// For each cell of a truth raster made for `stamp_ns`, true if the sensor can see the ground in it at that time.
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

    /// The vehicle moved to the beginning of revolution `number`. Revolution 0 starts at the scene's beginning; numbers
    /// below 0 exist too.
    pub fn from_revolution(mut self, number: i64) -> Self {
        self.move_to(self.scanner.first_firing_of(number));
        self
    }

    /// True if the next packet is the last one before the angle at which a decoder ends a revolution by default: behind
    /// the vehicle, half a revolution from the encoder's zero.
    pub fn is_at_revolution_end(&self) -> bool {
        let next = self.next_firing + self.firings_per_packet();
        let [first, next] = [self.next_firing, next].map(|firing| self.scanner.encoder_share(firing));
        self.waiting.is_none() && first < 0.5 && next >= 0.5
    }

    /// Skips as many whole revolutions as lie between the next packet and `stamp_ns`, without simulating them, and the
    /// packet in which a revolution ends. The scene goes on meanwhile. Returns the skipped time, 0 if `stamp_ns` is
    /// less than a revolution ahead.
    ///
    /// At [`SimulatedVehicle::is_at_revolution_end`], a decoder then sees one revolution end and the next one begin,
    /// both without a few firings. Elsewhere it sees two parts of revolutions.
    pub fn skip_to(&mut self, stamp_ns: i64) -> Duration {
        let revolution_ns = 60e9 / self.scanner.config().rpm;
        let revolutions = ((stamp_ns - self.next_stamp_ns()) as f64 / revolution_ns).floor();
        if revolutions < 1.0 {
            return Duration::ZERO;
        }
        let firings = revolutions * revolution_ns / self.scanner.firing_ns(1) as f64;
        let before = self.next_firing;
        // One packet after the first packet that begins no earlier than this angle: it may still hold the end.
        self.move_to(before + firings as i64 + 2 * self.firings_per_packet());
        let skipped_ns = self.scanner.firing_ns(self.next_firing - before);
        Duration::from_nanos(skipped_ns.unsigned_abs())
    }

    fn firings_per_packet(&self) -> i64 {
        self.scanner.spec().firings_per_packet(self.scanner.config().return_mode) as i64
    }

    /// Makes the packet that holds `firing` the next one.
    fn move_to(&mut self, firing: i64) {
        let packet = firing.div_euclid(self.firings_per_packet());
        self.next_firing = packet * self.firings_per_packet();
        self.encoder.begin_packet(packet);
        let stamp_ns = self.start_ns + self.scanner.firing_ns(self.next_firing);
        self.next_telemetry_ns = stamp_ns - stamp_ns.rem_euclid(TELEMETRY_PERIOD_NS);
        self.waiting = None;
    }

    /// Revolution `number`, whole, through real datagrams and the decoder, with the truth 60 m to every side, in cells
    /// of 0.2 m, at its end.
    ///
    /// # Panics
    /// If the decoder refuses a datagram of the encoder or finds no whole revolution, which is a fault of this project.
    pub fn true_revolution(&self, number: i64) -> TrueRevolution {
        let revolution = self.revolution(number);
        let map_from_ego = self.pose_at(revolution.end_ns);
        let truth = self.truth_at(revolution.end_ns, 60.0, 0.2, &Limits::default());
        TrueRevolution { revolution, map_from_ego, truth }
    }

    /// Revolution `number`, whole, through real datagrams and the decoder: the revolution whose middle is the encoder's
    /// zero, ahead of the vehicle, at time `number * 60 / rpm`.
    ///
    /// # Panics
    /// As [`SimulatedVehicle::true_revolution`].
    pub fn revolution(&self, number: i64) -> Revolution {
        let config = SensorConfig {
            model: Some(self.scanner.config().model),
            // A dual-return packet of a VLS-128 holds one firing, so it does not show the rotation rate.
            rpm: Some(self.scanner.config().rpm as f32),
            calibration: Some(self.scanner.calibration().clone()),
            ..SensorConfig::default()
        };
        let mut sensor = Sensor::new(config);
        // The decoder ends revolutions behind the vehicle, half a revolution before the encoder's zero. A firing whose
        // angle rounds to that angle begins a revolution one firing early.
        let half_revolution_ns = (30e9 / self.scanner.config().rpm) as i64;
        let slack_ns = self.scanner.firing_ns(2);
        let begins_ns = self.start_ns + self.scanner.firing_ns(self.scanner.first_firing_of(number))
            - half_revolution_ns
            - slack_ns;
        for datagram in self.clone().from_revolution(number - 1) {
            let revolution = sensor.push(&datagram.payload, datagram.stamp_ns);
            if let Some(revolution) = revolution.expect("the decoder accepts what the encoder makes")
                && revolution.partial.is_none()
                && revolution.start_ns > begins_ns
            {
                return revolution.clone();
            }
        }
        unreachable!("datagrams do not end")
    }

    /// Steers the vehicle onto an arc of this curvature (1/m, left positive) at `speed` m/s, from the next firing on;
    /// returns the stamp of that firing. Poses and speeds of the time before are from then on computed from the arc
    /// too.
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
        let has_telemetry = self.scanner.config().model != Model::Hdl64eS1;
        if has_telemetry && self.next_telemetry_ns <= packet.stamp_ns {
            let datagram = self.telemetry(self.next_telemetry_ns);
            self.next_telemetry_ns += TELEMETRY_PERIOD_NS;
            self.waiting = Some(packet);
            return Some(datagram);
        }
        Some(packet)
    }
}

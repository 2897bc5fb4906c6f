//! What a simulated car with several sensors sends without faults; cast once, used in every run.

use std::sync::OnceLock;

use clearway_daemon::config::Config;
use clearway_proto::v1;
use clearway_sim::scenes::{self, Scene};
use clearway_sim::traffic;
use clearway_sim::vehicle::Datagram;
use clearway_tools::demo::rig::Rig;

use super::fault_plan::{END_NS, REVOLUTION_NS};

/// Start of the drive, in ns since the Unix epoch: noon UTC, far from the end of an hour.
const START_NS: i64 = 1_767_270_000_000_000_000;

/// One reading, and when its sensor sends it.
#[derive(Clone, Debug)]
pub struct Sent {
    /// Time after the beginning of the drive, in ns.
    pub offset_ns: i64,
    /// The reading that is sent.
    pub reading: Reading,
}

/// Kinds of readings.
#[derive(Clone, Debug)]
pub enum Reading {
    /// A datagram of a rotating sensor, and the index of the sensor.
    Datagram(usize, Datagram),
    /// An observation of the car, or of the sensor that it names.
    Observation(Box<v1::Observation>),
}

/// A simulated drive: what the car and its sensors send.
#[derive(Debug)]
pub struct Drive {
    /// The car and its sensors.
    pub rig: Rig,
    /// Configuration of the car's server.
    pub config: Config,
    /// Everything that the car sends, in order of time.
    pub sent: Vec<Sent>,
}

/// All drives, cast at the first call.
pub fn drives() -> &'static [Drive] {
    static DRIVES: OnceLock<Vec<Drive>> = OnceLock::new();
    DRIVES.get_or_init(|| vec![Drive::through(traffic::street(8.0)), Drive::through(scenes::town())])
}

impl Drive {
    fn through(scene: Scene) -> Self {
        let mut rig = Rig::many(scene, START_NS);
        // Two units, ahead and behind, coarse and slow: they fail in the same ways, and are cheap to cast.
        rig.units.retain(|(name, _)| name == "ahead" || name == "behind");
        for (_, unit) in &mut rig.units {
            (unit.azimuths, unit.period_ns) = (110, 50_000_000);
        }
        let end_ns = START_NS + REVOLUTION_NS + END_NS + REVOLUTION_NS;
        let mut sent = Vec::new();
        for index in 0..rig.scanners.len() {
            let datagrams = rig.vehicle(index).take_while(|datagram| datagram.stamp_ns < end_ns);
            sent.extend(
                datagrams.map(|d| Sent { offset_ns: d.stamp_ns - START_NS, reading: Reading::Datagram(index, d) }),
            );
        }
        let observations = rig.observations().take_while(|timed| timed.stamp_ns < end_ns);
        sent.extend(observations.map(|timed| Sent {
            offset_ns: timed.stamp_ns - START_NS,
            reading: Reading::Observation(Box::new(timed.observation.into())),
        }));
        sent.sort_by_key(|sent| sent.offset_ns);
        let mut config = Config::of_one_vehicle("car", "top");
        config.vehicles[0].sensors = rig.sensors();
        Self { rig, config, sent }
    }
}

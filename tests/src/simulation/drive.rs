//! What a simulated car with several sensors sends while nothing is wrong, cast once and driven in every run.

use std::sync::OnceLock;

use clearway_proto::v1;
use clearway::config::Config;
use clearway::cli::demo::rig::Rig;
use clearway_sim::scenes::{self, Scene};
use clearway_sim::traffic;
use clearway_sim::vehicle::Datagram;

use super::fate::{END_NS, TURN_NS};

/// Noon of a day, UTC: not near a full hour's end.
const START_NS: i64 = 1_767_270_000_000_000_000;

/// One reading, as its sensor sends it.
#[derive(Clone, Debug)]
pub struct Sent {
    /// ns after the drive's beginning.
    pub offset_ns: i64,
    /// What is sent.
    pub what: What,
}

/// Kinds of readings.
#[derive(Clone, Debug)]
pub enum What {
    /// Of a turning sensor, by its index.
    Datagram(usize, Datagram),
    /// Of the whole car, or of the sensor it names.
    Observation(Box<v1::Observation>),
}

/// A drive, and the configuration of the car.
#[derive(Debug)]
pub struct Drive {
    /// The car.
    pub rig: Rig,
    /// Its configuration.
    pub config: Config,
    /// All it sends, in the order in which it does.
    pub sent: Vec<Sent>,
}

/// The drives there are.
pub fn drives() -> &'static [Drive] {
    static DRIVES: OnceLock<Vec<Drive>> = OnceLock::new();
    DRIVES.get_or_init(|| vec![Drive::through(traffic::street(8.0)), Drive::through(scenes::town())])
}

impl Drive {
    fn through(scene: Scene) -> Self {
        let mut rig = Rig::many(scene, START_NS);
        // Two units that look ahead and back, coarse and slow: what they do wrong is the same, and cheap.
        rig.units.retain(|(name, _)| name == "ahead" || name == "behind");
        for (_, unit) in &mut rig.units {
            (unit.azimuths, unit.period_ns) = (110, 50_000_000);
        }
        let end_ns = START_NS + TURN_NS + END_NS + TURN_NS;
        let mut sent = Vec::new();
        for index in 0..rig.scanners.len() {
            let datagrams = rig.vehicle(index).take_while(|datagram| datagram.stamp_ns < end_ns);
            sent.extend(datagrams.map(|d| Sent { offset_ns: d.stamp_ns - START_NS, what: What::Datagram(index, d) }));
        }
        let told = rig.observations().take_while(|told| told.stamp_ns < end_ns);
        sent.extend(told.map(|told| Sent {
            offset_ns: told.stamp_ns - START_NS,
            what: What::Observation(Box::new(told.observation.into())),
        }));
        sent.sort_by_key(|sent| sent.offset_ns);
        let mut config = Config::of_one_vehicle("car", "top");
        config.vehicles[0].sensors = rig.sensors();
        Self { rig, config, sent }
    }
}

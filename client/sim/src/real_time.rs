//! A simulated vehicle in real time, on a machine that may be too slow for it.
//!
//! In: a vehicle whose stamps are times of a clock, that clock, and how far the server has come. Out: the vehicle's
//! datagrams, without whole revolutions that are skipped, and not simulated, when the vehicle or the server is late. So
//! the age of the maps stays bounded. Between two skips the datagrams equal the vehicle's own.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use crate::vehicle::{Datagram, SimulatedVehicle};

/// Greatest lateness of a simulation that does not skip: one revolution at 10 Hz. A machine that is fast enough makes
/// up for less; more would be part of the age of every map.
const LATE_NS_MAX: i64 = 100_000_000;
/// Greatest backlog of a server for which the simulation does not wait: more than two revolutions at 10 Hz, because the
/// maps of two may be under way in a server that is in time.
const BACKLOG_NS_MAX: i64 = 250_000_000;
/// Longest gap between two stamps for a server that is late. After a gap of a second or more a decoder assumes that the
/// sensor's clock was set, and refuses a packet; and a vehicle that waits is stopped only after the wait.
const WAIT_NS_MAX: i64 = 900_000_000;

/// The simulated time that was skipped so far. Clones count together.
#[derive(Clone, Debug, Default)]
pub struct Skipped(Arc<AtomicU64>);

impl Skipped {
    /// Adds skipped time.
    pub fn add(&self, time: Duration) {
        self.0.fetch_add(u64::try_from(time.as_nanos()).unwrap_or(u64::MAX), Ordering::Relaxed);
    }

    /// The sum of the times added.
    pub fn time(&self) -> Duration {
        Duration::from_nanos(self.0.load(Ordering::Relaxed))
    }
}

/// The present time, and how far the server has come.
#[derive(Clone, Copy, Debug)]
pub struct Progress {
    /// Time of the clock, ns since the Unix epoch.
    pub now_ns: i64,
    /// End of the capture of the newest map, ns since the Unix epoch; `None` before the first map.
    pub mapped_ns: Option<i64>,
}

impl Progress {
    /// The stamp to which a simulation skips, or `None` if it goes on. `next_ns`: its next stamp. `sent_ns`: the end of
    /// the last revolution or scan that it has sent.
    pub fn skip_target_ns(&self, next_ns: i64, sent_ns: Option<i64>) -> Option<i64> {
        let backlog_ns = sent_ns.zip(self.mapped_ns).map_or(0, |(sent_ns, mapped_ns)| sent_ns - mapped_ns);
        if backlog_ns > BACKLOG_NS_MAX {
            return Some((self.now_ns + backlog_ns).min(next_ns + WAIT_NS_MAX).max(self.now_ns));
        }
        (self.now_ns - next_ns > LATE_NS_MAX).then_some(self.now_ns)
    }
}

/// A vehicle that skips revolutions when it, or the server, is late.
#[derive(Clone, Debug)]
pub struct RealTimeVehicle<P> {
    vehicle: SimulatedVehicle,
    progress: P,
    skipped: Skipped,
    /// Stamp of the last packet of the newest whole revolution.
    sent_ns: Option<i64>,
}

impl<P: FnMut() -> Progress> RealTimeVehicle<P> {
    /// A vehicle that adds to `skipped` the time that it skips. It calls `progress` once a revolution.
    pub fn new(vehicle: SimulatedVehicle, progress: P, skipped: Skipped) -> Self {
        Self { vehicle, progress, skipped, sent_ns: None }
    }
}

impl<P: FnMut() -> Progress> Iterator for RealTimeVehicle<P> {
    type Item = Datagram;

    fn next(&mut self) -> Option<Datagram> {
        // A skip inside a revolution would tear it.
        if self.vehicle.is_at_revolution_end() {
            let next_ns = self.vehicle.next_stamp_ns();
            if let Some(target_ns) = (self.progress)().skip_target_ns(next_ns, self.sent_ns) {
                self.skipped.add(self.vehicle.skip_to(target_ns));
            }
            self.sent_ns = Some(next_ns);
        }
        self.vehicle.next()
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;
    use crate::scene::scenes::flat;
    use crate::sensor::scanner::ScannerConfig;

    use clearway_lidar::model::Model;
    use clearway_lidar::{Sensor, SensorConfig};

    fn vehicle() -> SimulatedVehicle {
        SimulatedVehicle::new(flat(), ScannerConfig { model: Model::Vlp16, ..ScannerConfig::default() })
    }

    fn at(now_ns: i64) -> Progress {
        Progress { now_ns, mapped_ns: None }
    }

    #[test]
    fn a_vehicle_in_time_gives_all_its_datagrams() {
        let clock = vehicle().start_ns();
        let skipped = Skipped::default();
        let in_time = RealTimeVehicle::new(vehicle(), || at(clock), skipped.clone());
        assert!(in_time.take(1_000).eq(vehicle().take(1_000)));
        assert_eq!(skipped.time(), Duration::ZERO);
    }

    #[test]
    fn a_late_vehicle_skips_whole_revolutions_and_catches_up() {
        let start_ns = vehicle().start_ns();
        // A machine that needs twice the simulated time.
        let clock = Cell::new(start_ns);
        let skipped = Skipped::default();
        let mut stamp_ns = start_ns;
        let late = RealTimeVehicle::new(vehicle(), || at(clock.get()), skipped.clone());
        for datagram in late.take_while(|datagram| datagram.stamp_ns < start_ns + 3_000_000_000) {
            let step_ns = datagram.stamp_ns - stamp_ns;
            // A step is a packet, or whole revolutions and a packet.
            clock.set(clock.get() + 2 * (step_ns % 100_000_000));
            stamp_ns = datagram.stamp_ns;
            let late_ms = (clock.get() - stamp_ns) / 1_000_000;
            assert!(late_ms <= 310, "{late_ms} ms late");
        }
        let skipped_ms = skipped.time().as_millis();
        assert!((1_200..=1_600).contains(&skipped_ms), "{skipped_ms} ms of 3 s skipped");
    }

    #[test]
    fn the_revolutions_around_a_skip_are_nearly_whole() {
        let start_ns = vehicle().start_ns();
        let clock = Cell::new(start_ns);
        let late = RealTimeVehicle::new(vehicle(), || at(clock.get()), Skipped::default());
        let mut sensor = Sensor::new(SensorConfig { model: Some(Model::Vlp16), ..SensorConfig::default() });
        let mut firings = Vec::new();
        for datagram in late.take(2_000) {
            // The machine stops for a quarter of a second, after half a second.
            let is_past_stop = datagram.stamp_ns > start_ns + 500_000_000;
            clock.set(datagram.stamp_ns.max(if is_past_stop { start_ns + 750_000_000 } else { 0 }));
            if let Ok(Some(revolution)) = sensor.push(&datagram.payload, datagram.stamp_ns) {
                firings.push(revolution.firings.len());
            }
        }
        // A VLP-16 fires 1,808 times a revolution at 600 rpm, 24 times a packet.
        let (first, whole) = firings.split_first().expect("revolutions");
        assert!(*first < 1_000 && whole.len() > 10, "{firings:?}");
        assert!(whole.iter().all(|firings| firings.abs_diff(1_808) <= 48), "{firings:?}");
    }

    #[test]
    fn a_simulation_waits_for_a_server_that_is_two_revolutions_late() {
        let late = |mapped_ns| Progress { now_ns: 5_000_000_000, mapped_ns };
        let target = |progress: Progress| progress.skip_target_ns(5_000_000_000, Some(4_900_000_000));
        assert_eq!(target(late(None)), None);
        assert_eq!(target(late(Some(4_700_000_000))), None);
        assert_eq!(target(late(Some(4_600_000_000))), Some(5_300_000_000));
        assert_eq!(target(late(Some(1_000_000_000))), Some(5_900_000_000), "less than a second at once");
    }
}

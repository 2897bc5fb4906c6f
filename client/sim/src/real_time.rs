//! A simulated vehicle in real time, on a machine that may be too slow for it.
//!
//! In: a vehicle whose stamps are times of a clock, and that clock. Out: the vehicle's datagrams, but for whole
//! revolutions that are skipped, without being simulated, when the vehicle is late. So stamps never fall behind the
//! clock for long. Between two skips the datagrams are those that the vehicle gives by itself.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use crate::vehicle::{Datagram, SimulatedVehicle};

/// How late a simulation may be before it skips time: one revolution at 10 Hz. Less is made up for by a machine that is
/// fast enough; more would show as age in every map.
pub const LATE_MAX: Duration = Duration::from_millis(100);

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

/// A vehicle that skips revolutions when it is later than [`LATE_MAX`] by the clock `now_ns` (ns since the Unix epoch).
#[derive(Clone, Debug)]
pub struct RealTimeVehicle<C> {
    vehicle: SimulatedVehicle,
    now_ns: C,
    skipped: Skipped,
}

impl<C: FnMut() -> i64> RealTimeVehicle<C> {
    /// A vehicle that counts in `skipped` what it skips.
    pub fn new(vehicle: SimulatedVehicle, now_ns: C, skipped: Skipped) -> Self {
        Self { vehicle, now_ns, skipped }
    }
}

impl<C: FnMut() -> i64> Iterator for RealTimeVehicle<C> {
    type Item = Datagram;

    fn next(&mut self) -> Option<Datagram> {
        // A skip inside a revolution would tear it.
        if self.vehicle.is_at_revolution_end() {
            let now_ns = (self.now_ns)();
            if now_ns - self.vehicle.next_stamp_ns() > LATE_MAX.as_nanos() as i64 {
                self.skipped.add(self.vehicle.skip_to(now_ns));
            }
        }
        self.vehicle.next()
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;
    use crate::scanner::ScannerConfig;
    use crate::scenes::flat;

    use clearway_lidar::model::Model;
    use clearway_lidar::sensor::{Sensor, SensorConfig};

    fn vehicle() -> SimulatedVehicle {
        SimulatedVehicle::new(flat(), ScannerConfig { model: Model::Vlp16, ..ScannerConfig::default() })
    }

    #[test]
    fn a_vehicle_in_time_gives_all_its_datagrams() {
        let clock = vehicle().start_ns();
        let skipped = Skipped::default();
        let in_time = RealTimeVehicle::new(vehicle(), || clock, skipped.clone());
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
        let late = RealTimeVehicle::new(vehicle(), || clock.get(), skipped.clone());
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
        let late = RealTimeVehicle::new(vehicle(), || clock.get(), Skipped::default());
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
}

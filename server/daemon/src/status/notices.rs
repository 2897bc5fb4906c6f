//! What the log says once about the sensors of a vehicle.

use std::collections::{BTreeMap, BTreeSet};

use clearway_mapping::map::ElevationSource;
use clearway_mapping::pipeline::NamedStatus;
use clearway_mapping::sensor::mount::check::MountDeviation;

/// What was logged of each sensor of one vehicle, by name.
#[derive(Debug, Default)]
pub(super) struct Notices {
    /// Sensors with each source of their elevations: after a jump of a replay a sensor begins with the first one again.
    elevations: BTreeSet<(String, ElevationSource)>,
    reference_sensor: String,
    /// Number of the epoch of each sensor.
    epochs: BTreeMap<String, u32>,
    /// Sensors whose mount the ground contradicts.
    contradicted: BTreeSet<String>,
}

impl Notices {
    /// Logs what has changed since the last call: sensors whose elevations are not their own, sensors whose stamps went
    /// back, and sensors whose mount the ground contradicts.
    pub fn update(&mut self, vehicle: &str, sensors: &[NamedStatus]) {
        if let Some(chosen) = sensors.iter().find(|sensor| sensor.is_reference && self.reference_sensor != sensor.name)
        {
            self.reference_sensor.clone_from(&chosen.name);
            if sensors.len() > 1 {
                tracing::info!(vehicle, sensor = %chosen.name, "reference sensor");
            }
        }
        for sensor in sensors {
            self.update_elevations(vehicle, sensor);
            self.update_epoch(vehicle, sensor);
            self.update_mount(vehicle, sensor);
        }
    }

    fn update_elevations(&mut self, vehicle: &str, sensor: &NamedStatus) {
        let Some(source) = sensor.elevations else { return };
        if !self.elevations.insert((sensor.name.clone(), source)) {
            return;
        }
        let (name, elevations) = (&sensor.name, source.as_str());
        match source.advice() {
            Some(advice) => tracing::warn!(vehicle, sensor = %name, elevations, "{advice}"),
            None => tracing::info!(vehicle, sensor = %name, elevations, "elevations of the lasers"),
        }
    }

    fn update_epoch(&mut self, vehicle: &str, sensor: &NamedStatus) {
        let (name, epoch) = (&sensor.name, sensor.status.epoch);
        if epoch != self.epochs.get(name).copied().unwrap_or(0) {
            self.epochs.insert(name.clone(), epoch);
            let clock = sensor.status.clock.map_or("sender", |clock| clock.as_str());
            tracing::warn!(vehicle, sensor = %name, epoch, clock, "stamps went back to this clock: a new epoch");
        }
    }

    fn update_mount(&mut self, vehicle: &str, sensor: &NamedStatus) {
        let Some(deviation) = sensor.mount else { return };
        let name = &sensor.name;
        if deviation.contradicts && self.contradicted.insert(name.clone()) {
            tracing::warn!(vehicle, sensor = %name, "{}", describe(&deviation));
        } else if !deviation.contradicts && self.contradicted.remove(name) {
            tracing::info!(vehicle, sensor = %name, "the ground fits the configured mount again");
        }
    }
}

/// A deviation in one line, and what to do.
fn describe(deviation: &MountDeviation) -> String {
    let MountDeviation { height_m, pitch_rad, roll_rad, std, scans, .. } = deviation;
    let (offset_m, direction) = (height_m.abs(), if *height_m < 0.0 { "lower" } else { "higher" });
    format!(
        "the ground contradicts the configured mount: in the median of {scans} scans the sensor is {offset_m:.2} ± \
         {:.2} m {direction} than configured, and the ground is tilted by {:+.1} ± {:.1} deg in pitch and {:+.1} ± \
         {:.1} deg in roll: check `extrinsics` of the sensor",
        std[0],
        pitch_rad.to_degrees(),
        std[1].to_degrees(),
        roll_rad.to_degrees(),
        std[2].to_degrees(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sensor(height_m: f64, contradicts: bool, elevations: ElevationSource) -> NamedStatus {
        let mount = Some(MountDeviation { height_m, contradicts, scans: 20, ..MountDeviation::default() });
        NamedStatus {
            source: 0,
            name: "top".to_owned(),
            is_reference: true,
            status: clearway_lidar::SensorStatus::default(),
            elevations: Some(elevations),
            mount,
            other_clock: Default::default(),
            ledger: clearway_mapping::ledger::Ledger::default(),
        }
    }

    #[test]
    fn a_contradicted_mount_and_a_missing_table_are_logged_once() {
        #[derive(Clone, Default)]
        struct Lines(std::sync::Arc<std::sync::Mutex<Vec<u8>>>);
        impl std::io::Write for Lines {
            fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
                self.0.lock().unwrap().write(bytes)
            }

            fn flush(&mut self) -> std::io::Result<()> {
                Ok(())
            }
        }
        let lines = Lines::default();
        let writer = lines.clone();
        let subscriber = tracing_subscriber::fmt().with_writer(move || writer.clone()).finish();
        tracing::subscriber::with_default(subscriber, || {
            let mut notices = Notices::default();
            for contradicts in [false, true, true, false, false, true] {
                for elevations in [ElevationSource::Nominal, ElevationSource::StatusBytes] {
                    notices.update("car", &[sensor(-0.58, contradicts, elevations)]);
                }
            }
        });
        let text = String::from_utf8(lines.0.lock().unwrap().clone()).unwrap();
        assert_eq!(text.matches("off by 0.33 m in the median").count(), 1, "{text}");
        assert_eq!(text.matches("status_bytes").count(), 1, "{text}");
        assert_eq!(text.matches(" m lower than configured").count(), 2, "{text}");
        assert_eq!(text.matches("fits the configured mount again").count(), 1, "{text}");
    }
}

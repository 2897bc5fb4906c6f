//! The rules of `recorder.save_on`: a stale map or a lost sensor -> a save of the last seconds.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use crate::config::{Config, SaveRule};
use crate::publish::Vehicles;
use crate::record::writer::{Command, RecorderControl};

/// Interval at which the conditions are looked at. Ours: a save is due within 2 s.
const INTERVAL: Duration = Duration::from_millis(500);

/// Saves the last seconds when a condition begins, at most once in `recorder.save_s`; returns when the recorder ends.
pub(super) async fn watch(config: Config, vehicles: Vehicles, control: RecorderControl) {
    let quiet = Duration::from_secs(config.recorder.save_s);
    let mut conditions = Conditions::default();
    let mut saved_at: Option<Instant> = None;
    let mut every = tokio::time::interval(INTERVAL);
    loop {
        every.tick().await;
        let begun = conditions.update(&config.recorder.save_on, &observe(&config, &vehicles));
        let Some(reason) = begun.filter(|_| saved_at.is_none_or(|at| at.elapsed() >= quiet)) else { continue };
        match control.send(Command::Save { seconds: 0, reason: reason.clone() }).await {
            Ok(_) => saved_at = Some(Instant::now()),
            Err(error) => tracing::warn!(reason, %error, "the last seconds cannot be saved"),
        }
    }
}

/// What is seen of one vehicle.
#[derive(Clone, Debug, Default)]
struct Observed {
    /// True if its newest map is stale.
    is_stale: bool,
    /// Of each sensor, whether its data arrive and are in the newest map.
    in_maps: Vec<bool>,
}

fn observe(config: &Config, vehicles: &Vehicles) -> Vec<Observed> {
    let of_vehicle = |(vehicle, status): (&crate::config::Vehicle, std::sync::Arc<crate::status::VehicleStatus>)| {
        let is_stale = status.assess().map_age_ms.is_some_and(|age_ms| age_ms > f64::from(vehicle.maps.valid_ms));
        Observed { is_stale, in_maps: status.sensors_in_maps() }
    };
    config.vehicles.iter().zip(vehicles.statuses()).map(of_vehicle).collect()
}

/// What was good and is no longer: only this begins a save.
#[derive(Debug, Default)]
struct Conditions {
    /// Conditions that hold, by vehicle.
    wrong: BTreeSet<(usize, String)>,
    /// Conditions that did not hold at some time, by vehicle.
    were_good: BTreeSet<(usize, String)>,
}

impl Conditions {
    /// Takes what is seen of the vehicles; returns the reason of a condition that has begun. Names of sensors may have
    /// characters that names of folders must not have, so a reason has the sensor's number.
    fn update(&mut self, rules: &[SaveRule], observed: &[Observed]) -> Option<String> {
        let mut begun = None;
        for (vehicle, Observed { is_stale, in_maps }) in observed.iter().enumerate() {
            let stale = rules.contains(&SaveRule::MapStale).then(|| ("map-stale".to_owned(), *is_stale));
            let sensors = in_maps.iter().enumerate().filter(|_| rules.contains(&SaveRule::SensorLost));
            let lost = sensors.map(|(index, is_in_map)| (format!("sensor-{index}-lost"), !is_in_map));
            for (reason, holds) in stale.into_iter().chain(lost) {
                let condition = (vehicle, reason.clone());
                if !holds {
                    self.wrong.remove(&condition);
                    self.were_good.insert(condition);
                } else if self.were_good.contains(&condition) && self.wrong.insert(condition) {
                    begun.get_or_insert(reason);
                }
            }
        }
        begun
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_condition_begins_once_and_only_after_it_did_not_hold() {
        let rules = [SaveRule::MapStale, SaveRule::SensorLost];
        let mut conditions = Conditions::default();
        let mut update = |seen: [(bool, &[bool]); 2]| {
            conditions.update(&rules, &seen.map(|(is_stale, in_maps)| Observed { is_stale, in_maps: in_maps.to_vec() }))
        };
        // The second sensor of the first vehicle starts late; the second vehicle has none.
        assert_eq!(update([(true, &[]), (false, &[])]), None);
        assert_eq!(update([(false, &[true, false]), (false, &[])]), None);
        assert_eq!(update([(false, &[true, true]), (false, &[true])]), None);
        assert_eq!(update([(false, &[true, false]), (false, &[true])]).as_deref(), Some("sensor-1-lost"));
        assert_eq!(update([(false, &[true, false]), (false, &[true])]), None, "it has begun before");
        assert_eq!(update([(false, &[true, false]), (false, &[false])]).as_deref(), Some("sensor-0-lost"));
        assert_eq!(update([(true, &[true, true]), (false, &[true])]).as_deref(), Some("map-stale"));
        assert_eq!(update([(false, &[true, false]), (false, &[true])]).as_deref(), Some("sensor-1-lost"), "again");
        assert_eq!(Conditions::default().update(&[], &[Observed { is_stale: true, in_maps: vec![false] }]), None);
    }
}

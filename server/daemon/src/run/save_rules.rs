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
    /// Each sensor by its name, and whether its data arrive and are in the newest map.
    in_maps: Vec<(String, bool)>,
}

fn observe(config: &Config, vehicles: &Vehicles) -> Vec<Observed> {
    let of_vehicle = |(vehicle, status): (&crate::config::Vehicle, std::sync::Arc<crate::status::VehicleStatus>)| {
        let is_stale = status.assess().map_age_ms.is_some_and(|age_ms| age_ms > f64::from(vehicle.maps.valid_ms));
        let names = vehicle.sensors.iter().map(|sensor| sensor.name.clone());
        Observed { is_stale, in_maps: names.zip(status.sensors_in_maps()).collect() }
    };
    config.vehicles.iter().zip(vehicles.statuses()).map(of_vehicle).collect()
}

/// A vehicle and the name of its sensor that is lost, or none if its map is stale.
type Condition = (usize, Option<String>);

/// Which conditions hold, and which have not held at some time. A condition that begins to hold begins a save; a
/// condition that has held since the start does not.
#[derive(Debug, Default)]
struct Conditions {
    /// Conditions that hold.
    wrong: BTreeSet<Condition>,
    /// Conditions that did not hold at some time.
    were_good: BTreeSet<Condition>,
}

impl Conditions {
    /// Takes what is seen of the vehicles; returns the reason of a condition that has begun.
    fn update(&mut self, rules: &[SaveRule], observed: &[Observed]) -> Option<String> {
        let mut begun = None;
        for (vehicle, Observed { is_stale, in_maps }) in observed.iter().enumerate() {
            let stale = rules.contains(&SaveRule::MapStale).then_some((None, *is_stale));
            let sensors = in_maps.iter().filter(|_| rules.contains(&SaveRule::SensorLost));
            let lost = sensors.map(|(sensor, is_in_map)| (Some(sensor), !is_in_map));
            for (sensor, holds) in stale.into_iter().chain(lost) {
                let condition = (vehicle, sensor.cloned());
                if !holds {
                    self.wrong.remove(&condition);
                    self.were_good.insert(condition);
                } else if self.were_good.contains(&condition) && self.wrong.insert(condition) {
                    begun.get_or_insert_with(|| reason(sensor));
                }
            }
        }
        begun
    }
}

/// The reason of a save, with the characters and the length that it may have: the sensor that is lost, or a stale map.
fn reason(sensor: Option<&String>) -> String {
    const LENGTH_MAX: usize = 30;
    let Some(sensor) = sensor else { return "map-stale".into() };
    let name = sensor.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '-' });
    format!("{}-lost", name.take(LENGTH_MAX).collect::<String>())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sensors_whose_long_names_begin_alike_are_lost_one_by_one() {
        let [first, second] = ["1", "2"].map(|last| format!("{}{last}", "a".repeat(30)));
        let mut conditions = Conditions::default();
        let mut update = |is_first, is_second| {
            let in_maps = vec![(first.clone(), is_first), (second.clone(), is_second)];
            conditions.update(&[SaveRule::SensorLost], &[Observed { is_stale: false, in_maps }])
        };
        let lost = Some(format!("{}-lost", "a".repeat(30)));
        assert_eq!([update(true, true), update(false, true), update(false, false)], [None, lost.clone(), lost]);
        assert_eq!(update(false, false), None);
    }

    #[test]
    fn a_condition_begins_once_and_only_after_it_did_not_hold() {
        let rules = [SaveRule::MapStale, SaveRule::SensorLost];
        let mut conditions = Conditions::default();
        let mut update = |seen: [(bool, &[bool]); 2]| {
            let named = |in_maps: &[bool]| ["front left", "rear"].map(String::from).into_iter().zip(in_maps.to_vec());
            let observed = |(is_stale, in_maps)| Observed { is_stale, in_maps: named(in_maps).collect() };
            conditions.update(&rules, &seen.map(observed))
        };
        // The second sensor of the first vehicle starts late; the second vehicle has none.
        assert_eq!(update([(true, &[]), (false, &[])]), None);
        assert_eq!(update([(false, &[true, false]), (false, &[])]), None);
        assert_eq!(update([(false, &[true, true]), (false, &[true])]), None);
        assert_eq!(update([(false, &[true, false]), (false, &[true])]).as_deref(), Some("rear-lost"));
        assert_eq!(update([(false, &[true, false]), (false, &[true])]), None, "it has begun before");
        assert_eq!(update([(false, &[true, false]), (false, &[false])]).as_deref(), Some("front-left-lost"));
        assert_eq!(update([(true, &[true, true]), (false, &[true])]).as_deref(), Some("map-stale"));
        assert_eq!(update([(false, &[true, false]), (false, &[true])]).as_deref(), Some("rear-lost"), "again");
        assert_eq!(
            Conditions::default().update(&[], &[Observed { is_stale: true, in_maps: vec![("rear".into(), false)] }]),
            None
        );
    }
}

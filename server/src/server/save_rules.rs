//! The rules of `recorder.save_on`: a stale map or a lost sensor -> a save of the last seconds.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use crate::clock::now_ns;
use crate::config::{Config, SaveRule};
use crate::publish::Vehicles;
use crate::record::writer::{Command, RecorderControl};

/// Interval at which the conditions are looked at. Ours: a save is due within 2 s.
const INTERVAL: Duration = Duration::from_millis(500);
/// States of a sensor whose scan is in the newest map.
const STATES_IN_MAP: [&str; 2] = ["ok", "partial"];

/// What is wrong with one vehicle: the reasons of saves.
type Reasons = BTreeSet<String>;

/// Saves the last seconds when a condition begins, at most once in `recorder.save_s`; returns when the recorder ends.
pub(super) async fn watch(config: Config, vehicles: Vehicles, control: RecorderControl) {
    let rules = &config.recorder.save_on;
    let quiet = Duration::from_secs(config.recorder.save_s);
    let mut before: Option<Reasons> = None;
    let mut saved_at: Option<Instant> = None;
    let mut every = tokio::time::interval(INTERVAL);
    loop {
        every.tick().await;
        let now = reasons(rules, &config, &vehicles);
        // What was wrong at the start has not begun since.
        let begun = now.difference(before.as_ref().unwrap_or(&now)).next().cloned();
        before = Some(now);
        let Some(reason) = begun.filter(|_| saved_at.is_none_or(|at| at.elapsed() >= quiet)) else { continue };
        match control.send(Command::Save { seconds: 0, reason: reason.clone() }).await {
            Ok(_) => saved_at = Some(Instant::now()),
            Err(error) => tracing::warn!(reason, %error, "the last seconds cannot be saved"),
        }
    }
}

/// The conditions that hold now.
fn reasons(rules: &[SaveRule], config: &Config, vehicles: &Vehicles) -> Reasons {
    let mut reasons = Reasons::new();
    for (vehicle, status) in config.vehicles.iter().zip(vehicles.statuses()) {
        let state = status.to_proto();
        let age_ms = now_ns().saturating_sub(state.newest_capture_end_ns) / 1_000_000;
        let is_stale = state.maps > 0 && age_ms > i64::from(vehicle.maps.valid_ms);
        if rules.contains(&SaveRule::MapStale) && is_stale {
            reasons.insert("map-stale".to_owned());
        }
        let is_lost = |sensor: &&clearway_proto::v1::SensorState| !STATES_IN_MAP.contains(&&*sensor.state);
        if rules.contains(&SaveRule::SensorLost) {
            // Names of sensors may have characters that names of folders must not have.
            reasons.extend(
                state
                    .sensors
                    .iter()
                    .enumerate()
                    .filter(|(_, sensor)| is_lost(sensor))
                    .map(|(index, _)| format!("sensor-{index}-lost")),
            );
        }
    }
    reasons
}

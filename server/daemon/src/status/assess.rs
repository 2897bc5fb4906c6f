//! The status of a vehicle -> its state ([`super::health`]), at each call and five times a second.

use std::sync::Arc;
use std::time::{Duration, Instant};

use clearway_lidar::SensorStatus;
use clearway_mapping::pipeline::NamedStatus;
use clearway_proto::v1;
use futures::future::select_all;
use tokio::sync::watch;
use tokio::time::MissedTickBehavior;

use super::health::{Facts, SILENT_AFTER, SensorFacts, State};
use super::json::run_text;
use super::message::server_name;
use super::vehicle::{Changing, VehicleStatus, packet_counts};
use crate::base::clock::now_ns;
use crate::base::sync::locked;
use crate::ingest::drops::UnknownSender;

/// Interval at which the vehicles are assessed. Ours: short beside the time in which a person or a probe reacts.
const ASSESS_PERIOD: Duration = Duration::from_millis(200);
/// Time after which another server that claims the vehicle's name is forgotten. Ours: it publishes once a second.
const CLAIM_AGE_MAX: Duration = Duration::from_secs(4);

/// The result of an assessment of one vehicle.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Assessment {
    /// State of the vehicle's maps.
    pub state: State,
    /// Time for which the state has lasted.
    pub state_for: Duration,
    /// Why it is not `ok`, worst first.
    pub reasons: Vec<String>,
    /// Age of the newest map; `None` before the first.
    pub map_age_ms: Option<f64>,
    /// Share of the packets of the last 10 s that were lost or refused, 0 to 1; `None` if none was expected.
    pub loss: Option<f64>,
    /// Speed of the vehicle, if maps are made.
    pub speed_m_s: Option<f64>,
    /// Names of other servers that serve a vehicle of the same name.
    pub claimed_by: Vec<String>,
}

/// Assesses the vehicles again and again, so that a change of a state is seen without a reader.
pub async fn watch_states(statuses: Vec<Arc<VehicleStatus>>) {
    let mut every = tokio::time::interval(ASSESS_PERIOD);
    every.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        every.tick().await;
        for status in &statuses {
            let assessed = status.assess();
            status.keep_row(&assessed);
            if let Some(age_ms) = assessed.map_age_ms {
                let age = Duration::from_secs_f64(age_ms.max(0.0) / 1e3);
                locked(&status.changing).counts.ages.observe(age);
            }
        }
    }
}

/// Resolves when one of the states has changed; never without a vehicle.
pub async fn state_changed(states: &mut [watch::Receiver<State>]) {
    let changes: Vec<_> = states.iter_mut().map(|state| Box::pin(state.changed())).collect();
    match changes.is_empty() {
        true => std::future::pending().await,
        // The senders live as long as the vehicles that the caller holds.
        false => _ = select_all(changes).await,
    }
}

impl VehicleStatus {
    /// The state of the vehicle as it changes, the present state first.
    pub fn states(&self) -> watch::Receiver<State> {
        self.health_state.subscribe()
    }

    /// Time until the newest map, whose capture ended then, is stale; 0 if it is. The stamp of a recorded map says
    /// nothing about now, so that its age counts from its publication.
    #[cfg(feature = "zenoh")]
    pub(crate) fn fresh_for(&self, capture_end_ns: i64) -> Duration {
        let state = locked(&self.changing);
        let age = if state.has_recorded_stamps {
            self.started.elapsed().saturating_sub(state.mapped_at)
        } else {
            Duration::from_nanos(now_ns().saturating_sub(capture_end_ns).max(0).unsigned_abs())
        };
        state.validity.saturating_sub(age)
    }

    /// Assesses the vehicle now.
    pub fn assess(&self) -> Assessment {
        let mut health = locked(&self.health);
        let facts = self.facts();
        health.update(&facts);
        let (state, reasons) = (health.state(), health.reasons().to_vec());
        let state_for = facts.up.saturating_sub(health.since());
        self.health_state.send_if_modified(|last| std::mem::replace(last, state) != state);
        let file = || self.recorder.get().map_or_else(String::new, |counts| counts.to_proto().file);
        locked(&self.history).push_state(facts.up, state, &reasons, || file().replace(".unfinished.", "."));
        drop(health);
        let changing = locked(&self.changing);
        let by_clock_ms = now_ns().saturating_sub(changing.counts.newest_capture_end_ns) as f64 / 1e6;
        // The stamp of a recorded map says nothing about now.
        let by_arrival_ms = facts.map_age.filter(|_| changing.has_recorded_stamps).map(|age| age.as_secs_f64() * 1e3);
        let is_made =
            changing.counts.maps > 0 && self.started.elapsed().saturating_sub(changing.mapped_at) <= SILENT_AFTER;
        Assessment {
            state,
            state_for,
            reasons,
            map_age_ms: (changing.counts.maps > 0).then_some(by_arrival_ms.unwrap_or(by_clock_ms)),
            loss: facts.loss,
            speed_m_s: changing.speed_m_s.filter(|_| is_made),
            claimed_by: facts.claimed_by,
        }
    }

    /// Adds a row to the history, if a second has begun that has none.
    fn keep_row(&self, assessed: &Assessment) {
        let now = self.started.elapsed();
        if !locked(&self.history).is_row_due(now) {
            return;
        }
        let changing = locked(&self.changing);
        let (window, drivable_share) = (&changing.window, changing.counts.drivable_share);
        let latency_ms = window.latency_ms(now).get("total").copied();
        let numbers = [assessed.map_age_ms, latency_ms, Some(window.map_rate_hz(now)), assessed.loss, drivable_share];
        drop(changing);
        locked(&self.history).push_row(now, numbers);
    }

    /// The last ten minutes as JSON ([`super::history`]).
    pub fn history_json(&self) -> String {
        locked(&self.history).to_json(self.started.elapsed(), now_ns() / 1_000_000)
    }

    /// Of each sensor, whether its data arrive and are in the newest map.
    pub fn sensors_in_maps(&self) -> Vec<bool> {
        let arrives = |sensor: &SensorFacts| sensor.silent.is_some_and(|silent| silent <= SILENT_AFTER);
        let is_in_map = |sensor: &SensorFacts| sensor.left_out.is_empty() && sensor.completeness.is_some();
        self.facts().sensors.iter().map(|sensor| arrives(sensor) && is_in_map(sensor)).collect()
    }

    /// Why the vehicle is not ready: its worst reason, if no fresh map is made; else `None`.
    pub fn not_ready(&self) -> Option<String> {
        let Assessment { state, reasons, .. } = self.assess();
        (state == State::Error).then(|| reasons.into_iter().next().unwrap_or_default())
    }

    fn facts(&self) -> Facts {
        let claimed_by = self.claimed_by();
        let mut changing = locked(&self.changing);
        let up = self.started.elapsed();
        let mut sensors = changing.counts.sensors.clone();
        let mut of_vehicle = clearway_mapping::ledger::Ledger::default();
        let ledgers = sensors.iter_mut().map(|sensor| (sensor.source, &mut sensor.ledger));
        self.drops.add_unreported_to(&mut of_vehicle, ledgers);
        let counts = packet_counts(&sensors);
        let loss = changing.window.loss(counts);
        changing.window.push_counts(up, counts);
        let since_mapped = up.saturating_sub(changing.mapped_at);
        let by_clock = now_ns().saturating_sub(changing.counts.newest_capture_end_ns);
        let map_ahead = Duration::from_nanos(u64::try_from(by_clock.saturating_neg()).unwrap_or(0));
        let by_clock = Duration::from_nanos(u64::try_from(by_clock).unwrap_or(0));
        // As in a client: no step of a clock makes an old map look young.
        let age = if changing.has_recorded_stamps { since_mapped } else { by_clock.max(since_mapped) };
        let senders = |source| self.drops.senders.at_once(source, Instant::now());
        let of_sensors =
            changing.counts.sensors.iter().map(|sensor| sensor_facts(sensor, senders(sensor.source), &changing, up));
        let sensors = of_sensors.collect();
        let is_recent = |sender: &UnknownSender| now_ns() - sender.newest_ns <= SILENT_AFTER.as_nanos() as i64;
        let unknown_senders = self.drops.unknown_senders().into_iter().filter(is_recent);
        Facts {
            unknown_senders: unknown_senders.map(|sender| sender.address.to_string()).collect(),
            fault: self.fault(),
            up,
            makes_maps: !self.layers.is_empty(),
            map_age: (changing.counts.maps > 0).then_some(age),
            map_ahead: if changing.has_recorded_stamps { Duration::ZERO } else { map_ahead },
            not_fresh_for: up.saturating_sub(changing.fresh_at),
            validity: changing.validity,
            has_recorded_stamps: changing.has_recorded_stamps,
            replay: changing.replay.map(|(phase, at)| (phase, up.saturating_sub(at))),
            replay_awaited: changing.replay_awaited.clone(),
            sensors,
            loss,
            recorder_problem: self.recorder_problem(),
            store_problem: self.recorder.get().and_then(|counts| counts.store_problem()),
            network_problems: self.network.problems(Instant::now(), now_ns()),
            claimed_by,
        }
    }

    /// Names of other servers that serve a vehicle of the same name; with their runs if names do not tell them apart.
    fn claimed_by(&self) -> Vec<String> {
        let mut claims = locked(&self.claims);
        claims.retain(|_, (_, newest)| newest.elapsed() <= CLAIM_AGE_MAX);
        let count = |name: &str| claims.values().filter(|(server, _)| server == name).count();
        let text =
            |(boot_id, (server, _)): (&u64, &(String, Instant))| match count(server) > 1 || server == server_name() {
                true => format!("{server} ({})", run_text(*boot_id)),
                false => server.clone(),
            };
        claims.iter().map(text).collect()
    }
}

fn sensor_facts(sensor: &NamedStatus, senders: Vec<String>, changing: &Changing, up: Duration) -> SensorFacts {
    let seen = changing.seen.get(&sensor.name).copied().unwrap_or_default();
    let since = |at: Option<Duration>| at.map(|at| up.saturating_sub(at));
    let silent = since(seen.read_at);
    let state = changing.states.iter().find(|state| state.name == sensor.name);
    let left_out = state.map_or("", |state| &state.state);
    let whole = state.filter(|state| state.partial.is_empty());
    let other_clock = sensor.other_clock.describe().filter(|_| sensor.other_clock.lasts);
    SensorFacts {
        name: sensor.name.clone(),
        silent,
        is_refused: since(seen.received_at).is_some_and(|age| age <= SILENT_AFTER)
            && silent.is_none_or(|age| age > SILENT_AFTER),
        left_out: if matches!(left_out, "late" | "ahead" | "empty" | "silent") {
            left_out.to_owned()
        } else {
            String::new()
        },
        completeness: state.filter(|_| left_out != "silent").map(|state| state.completeness),
        packets: whole.and_then(|state| Some([state.packets, packets_of_model(&sensor.status, state)?])),
        clock: sensor.status.clock.map_or("", |clock| clock.as_str()).to_owned(),
        clock_offset_ms: sensor.status.clock_offset_ms,
        senders,
        blocked_deg: sensor.status.blocked.sectors.iter().map(|s| f64::from(s.to_deg) - f64::from(s.from_deg)).sum(),
        remarks: sensor.status.remarks().into_iter().chain(other_clock).collect(),
        mount: sensor
            .mount
            .filter(|mount| mount.contradicts)
            .map(|mount| [mount.height_m, mount.pitch_rad.to_degrees(), mount.roll_rad.to_degrees()]),
    }
}

/// Packets that a sensor of this model sends in a revolution; `None` if it sends no packets.
fn packets_of_model(sensor: &SensorStatus, state: &v1::SensorState) -> Option<u32> {
    let period_ns = sensor.model?.spec().packet_period_ns(sensor.return_mode?);
    (state.rpm > 0.0).then(|| (60e9 / (f64::from(state.rpm) * f64::from(period_ns))).round() as u32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::status::vehicle::{CLAIMS_MAX, SERVER_NAME_MAX};

    #[test]
    fn another_server_that_claims_the_vehicle_is_named_and_a_flood_of_claims_is_bounded() {
        let status = VehicleStatus::new("car".into(), 7, vec![], Arc::default());
        status.note_claim(7, "itself");
        assert_eq!(status.assess().claimed_by, Vec::<String>::new());
        status.note_claim(8, "b\u{1b}[2J");
        assert_eq!(status.assess().claimed_by, ["b[2J"]);
        status.note_claim(1_311_768_467_463_790_320, "b\u{1b}[2J");
        assert_eq!(status.assess().claimed_by, ["b[2J (run 00000000)", "b[2J (run 12345678)"], "two of one name");
        (100..200).for_each(|boot_id: u64| status.note_claim(boot_id, &format!("{boot_id:>99}")));
        let claimed_by = status.assess().claimed_by;
        assert!(
            claimed_by.len() <= CLAIMS_MAX
                && claimed_by.iter().all(|name| name.len() <= SERVER_NAME_MAX + " (run 12345678)".len())
        );
    }
}

//! What is found of the facts, and when a state gets better.

use super::*;

const fn ms(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

fn sensor(name: &str, silent_ms: u64) -> SensorFacts {
    SensorFacts {
        name: name.into(),
        silent: Some(ms(silent_ms)),
        completeness: Some(1.0),
        clock: "device".into(),
        ..SensorFacts::default()
    }
}

fn fine() -> Facts {
    Facts {
        up: ms(60_000),
        makes_maps: true,
        map_age: Some(ms(90)),
        validity: ms(300),
        sensors: vec![sensor("top", 1), sensor("rear", 2)],
        ..Facts::default()
    }
}

fn words(facts: &Facts) -> Vec<(&'static str, String)> {
    findings(facts, facts.loss > Some(LOSS_WARNS)).into_iter().map(|of| (of.state.as_str(), of.text)).collect()
}

#[test]
fn nothing_is_wrong_with_fresh_maps_of_whole_scans() {
    assert_eq!(words(&fine()), []);
}

#[test]
fn each_thing_that_is_wrong_has_its_words() {
    type Change = fn(&mut Facts);
    let cases: [(&str, &str, Change); 24] = [
        ("warn", "datagrams of 127.0.0.1:9 are refused: vehicle.udp.from names other senders", |f| {
            f.unknown_senders = vec!["127.0.0.1:9".to_owned()];
        }),
        ("error", "the engine has hung for 4 s", |f| f.fault = Some("the engine has hung for 4 s".into())),
        ("warn", "no packets from rear for 76 s", |f| f.sensors[1].silent = Some(ms(76_000))),
        ("warn", "no packets from rear since the server started 60 s ago", |f| f.sensors[1].silent = None),
        ("warn", "no readable packets from rear for 5.0 s", |f| {
            (f.sensors[1].silent, f.sensors[1].is_refused) = (Some(ms(5000)), true);
        }),
        ("error", "no map yet", |f| f.map_age = None),
        ("warn", "the newest map is 0.4 s old, and valid for 0.3 s", |f| f.map_age = Some(ms(400))),
        ("error", "the newest map is 1.4 s old, and valid for 0.3 s", |f| f.map_age = Some(ms(1400))),
        ("error", "the newest map is 0.4 s old, and valid for 0.3 s", |f| {
            (f.map_age, f.not_fresh_for) = (Some(ms(400)), ms(1400));
        }),
        ("error", "the stamps are 6.0 s ahead of this server's clock: readers call the maps stale", |f| {
            (f.map_ahead, f.not_fresh_for) = (ms(6000), ms(1400));
        }),
        ("warn", "maps are replayed with the stamps of the recording: readers call them stale", |f| {
            f.has_recorded_stamps = true;
        }),
        ("warn", "top is 0.4 m higher over the ground than configured", |f| {
            f.sensors[0].mount = Some([0.4, 0.1, 0.0]);
        }),
        (
            "warn",
            "top is 0.2 m lower over the ground than configured, and the ground is tilted by -2.0 deg in pitch and \
             +0.0 deg in roll",
            |f| f.sensors[0].mount = Some([-0.2, -2.0, 0.0]),
        ),
        ("warn", "several send the data of top, each in place of the others': a, b", |f| {
            f.sensors[0].senders = vec!["a".into(), "b".into()];
        }),
        ("warn", "rear is left out of the newest map: its scan is late", |f| f.sensors[1].left_out = "late".into()),
        ("warn", "top covers 72 % of its revolution", |f| f.sensors[0].completeness = Some(0.72)),
        (
            "warn",
            "top sends 181 instead of 76 packets a revolution, more than its model: check `model` of the sensor",
            |f| f.sensors[0].packets = Some([181, 76]),
        ),
        ("warn", "the host's clock is 0.9 s ahead of the clock of top", |f| f.sensors[0].clock_offset_ms = 900),
        ("warn", "the host's clock is 0.2 s behind the clock of top", |f| f.sensors[0].clock_offset_ms = -200),
        ("warn", "the clock of top is holdover", |f| f.sensors[0].clock = "holdover".into()),
        ("warn", "4.2 % of the packets of the last 10 s were lost or refused", |f| f.loss = Some(0.042)),
        ("warn", "1 part not yet in the store: no", |f| {
            f.store_problem = Some("1 part not yet in the store: no".into())
        }),
        ("warn", "recorder: the disk is too slow", |f| f.recorder_problem = Some("the disk is too slow".into())),
        ("warn", "server b serves a vehicle of the same name", |f| f.claimed_by = vec!["b".into()]),
    ];
    for (state, text, change) in cases {
        let mut facts = fine();
        change(&mut facts);
        assert_eq!(words(&facts), [(state, text.to_owned())]);
    }
}

#[test]
fn the_worst_stands_first() {
    let mut facts = fine();
    facts.loss = Some(0.5);
    facts.map_age = Some(ms(9000));
    facts.sensors.iter_mut().for_each(|sensor| sensor.silent = Some(ms(9000)));
    let states: Vec<_> = words(&facts).into_iter().map(|(state, _)| state).collect();
    assert_eq!(states, ["error", "error", "error", "warn"]);
}

#[test]
fn many_silent_sensors_have_one_reason_with_the_longest_time() {
    let mut facts = fine();
    facts.sensors.extend(["left", "right"].map(|name| sensor(name, 1)));
    facts.sensors[1..].iter_mut().zip([5000, 190_000, 9000]).for_each(|(of, age_ms)| of.silent = Some(ms(age_ms)));
    assert_eq!(words(&facts), [("warn", "3 of 4 sensors silent for 190 s: rear, left, right".to_owned())]);
    facts.sensors[0].silent = Some(ms(3000));
    assert_eq!(words(&facts)[0], ("error", "4 of 4 sensors silent for 190 s: top, rear, left, right".to_owned()));
}

#[test]
fn many_sensors_that_are_left_out_have_one_reason() {
    let mut facts = fine();
    facts.sensors.extend(["left", "right"].map(|name| sensor(name, 1)));
    facts.sensors[1..].iter_mut().zip(["late", "ahead", "late"]).for_each(|(of, why)| of.left_out = why.to_owned());
    let text = "3 of 4 sensors left out of the newest map: rear late, left ahead, right late".to_owned();
    assert_eq!(words(&facts), [("warn", text)]);
}

#[test]
fn a_vehicle_without_any_packet_is_an_error_that_says_so() {
    let never = SensorFacts { silent: None, completeness: None, ..sensor("top", 0) };
    let facts = Facts { sensors: vec![never], map_age: None, ..fine() };
    let text = "no packets from top since the server started 60 s ago".to_owned();
    assert_eq!(words(&facts), [("error", text), ("error", "no map yet".to_owned())]);
    let mut health = Health::default();
    assert!(!health.update(&facts));
    assert_eq!(health.state(), State::Error);
}

#[test]
fn a_replay_that_waits_is_a_warning_and_one_that_is_paused_is_none() {
    let never = SensorFacts { silent: None, completeness: None, ..sensor("top", 0) };
    let in_phase = |phase, since_ms| Some((phase, ms(since_ms)));
    let replay = in_phase(ReplayPhase::Waiting, 9000);
    let waiting = Facts { replay, sensors: vec![never], map_age: None, ..fine() };
    assert_eq!(words(&waiting), [("warn", "the replay waits for readers".to_owned())]);
    let begun = Facts { replay: in_phase(ReplayPhase::Playing, 100), ..waiting };
    assert_eq!(words(&begun), []);
    let replay = in_phase(ReplayPhase::Paused, 9000);
    let paused = Facts { replay, map_age: Some(ms(9000)), sensors: vec![sensor("top", 9000)], ..fine() };
    let old = "the newest map is 9.0 s old, and valid for 0.3 s".to_owned();
    assert_eq!(words(&paused), [("ok", "the replay is paused".to_owned()), ("ok", old.clone())]);
    let (replay, replay_awaited) = (in_phase(ReplayPhase::Playing, 9000), "the acknowledgement of map 3".to_owned());
    let awaiting = Facts { replay, replay_awaited, ..paused.clone() };
    let waits = "the replay waits for the acknowledgement of map 3".to_owned();
    assert_eq!(words(&awaiting), [("warn", waits), ("warn", old)]);
    let as_recorded = Facts { has_recorded_stamps: true, ..paused };
    assert!(words(&as_recorded).iter().all(|(state, _)| *state == "ok"), "{:?}", words(&as_recorded));
    let resumed = Facts { replay: in_phase(ReplayPhase::Playing, 100), ..as_recorded.clone() };
    assert!(words(&resumed).iter().all(|(state, _)| *state == "warn"), "{:?}", words(&resumed));
    let silent = Facts { replay: in_phase(ReplayPhase::Playing, 9000), ..as_recorded };
    assert_eq!(words(&silent)[0], ("error", "no packets from top for 9.0 s".to_owned()));
}

/// A time in ms, and what is observed then other than that all is fine.
type Line = (u64, fn(&mut Facts));

/// Plays a script; returns the state after each line.
fn play(script: &[Line]) -> Vec<&'static str> {
    let mut health = Health::default();
    let mut step = |(at, change): &Line| {
        let mut facts = fine();
        facts.up = ms(*at);
        change(&mut facts);
        health.update(&facts);
        health.state().as_str()
    };
    script.iter().map(&mut step).collect()
}

#[test]
fn a_state_gets_worse_at_once_and_better_after_three_seconds() {
    let script: [Line; 11] = [
        (0, |f| (f.map_age, f.sensors[0].silent, f.sensors[1].silent) = (None, None, None)),
        (200, |_| {}),
        (1000, |f| f.map_age = Some(ms(400))),
        (1200, |f| f.map_age = Some(ms(2000))),
        (1400, |f| f.map_age = Some(ms(400))),
        (4200, |f| f.map_age = Some(ms(400))),
        (4400, |f| f.map_age = Some(ms(400))),
        (4600, |_| {}),
        (6000, |f| f.map_age = Some(ms(400))),
        (6200, |_| {}),
        (9300, |_| {}),
    ];
    let states = ["error", "ok", "warn", "error", "error", "error", "warn", "warn", "warn", "warn", "ok"];
    assert_eq!(play(&script), states);
}

#[test]
fn loss_warns_above_one_percent_and_until_it_is_below_half_a_percent() {
    let script: [Line; 7] = [
        (0, |_| {}),
        (1000, |f| f.loss = Some(0.009)),
        (2000, |f| f.loss = Some(0.011)),
        (9000, |f| f.loss = Some(0.009)),
        (20_000, |f| f.loss = Some(0.006)),
        (30_000, |f| f.loss = Some(0.004)),
        (33_000, |f| f.loss = Some(0.009)),
    ];
    assert_eq!(play(&script), ["ok", "ok", "warn", "warn", "warn", "warn", "ok"]);
}

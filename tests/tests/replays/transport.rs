//! Controlled replays: as live, in steps, set back, waiting for their readers. The maps equal the recorded maps.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

use bytes::Bytes;
use clearway_client::{Client, ClientError, MapStream, MapView, StreamEvent, Subscription};
use clearway_daemon::ingest::queue::Reading;
use clearway_daemon::record::verify;
use clearway_journal::encode::as_served;
use clearway_mapping::event::{Body, EgoPose};
use clearway_proto::v1;
use clearway_proto::v1::replay_service_client::ReplayServiceClient;
use clearway_replay::{ReplayError, ReplayOptions, ReplayRun, ReplaySummary, ServedReplay};
use prost::Message;
use tonic::transport::Channel;

use crate::fixture::{self, before_another_look, within};

/// A recorded drive of this many tenths of a second, one map each, with ego poses, with memory, and with a plan after
/// half a second and after one and a half.
async fn recorded_drive(folder: &Path, tenths: i64) -> PathBuf {
    recorded_drive_of("car", folder, tenths).await
}

async fn recorded_drive_of(vehicle: &str, folder: &Path, tenths: i64) -> PathBuf {
    let file = folder.join(format!("{vehicle}.mcap"));
    let mut config = fixture::config();
    config.vehicles[0].name = vehicle.to_owned();
    config.recorder.file = file.clone();
    config.vehicles[0].maps.memory.enabled = true;
    let running = fixture::start(config).await;
    let mut readings: Vec<Reading> = Vec::new();
    for reading in fixture::readings(tenths) {
        let stamp_ns = reading.arrival_ns;
        if readings.last().is_none_or(|last| last.arrival_ns / 50_000_000 != stamp_ns / 50_000_000) {
            let x = (stamp_ns % 1_000_000_000_000) as f64 * 8e-9;
            let map_from_ego = nalgebra::Isometry3::translation(x, 0.0, 0.0);
            let body = Body::EgoPose(EgoPose { stamp_ns, map_from_ego, speed_mps: 8.0 });
            readings.push(Reading { arrival_ns: stamp_ns, source: 0, body });
        }
        readings.push(reading);
    }
    let first_ns = readings[0].arrival_ns;
    let plans = [(5, "first"), (15, "second")].into_iter().filter(|(after, _)| *after < tenths);
    for (after_ns, text) in plans.map(|(after, text)| (after * 100_000_000, text)) {
        let (vehicle, stamp_ns, frame) = (vehicle.into(), first_ns + after_ns, v1::PlanFrame::Ego.into());
        let plan =
            v1::Plan { vehicle, stamp_ns, frame, x: vec![0.0], y: vec![0.0], text: text.into(), ..v1::Plan::default() };
        readings.push(Reading { arrival_ns: stamp_ns, source: 0, body: Body::Plan(plan.encode_to_vec().into()) });
    }
    readings.sort_by_key(|reading| reading.arrival_ns);
    let queue = running.inputs[0].queue.clone();
    let push = move || readings.into_iter().try_for_each(|reading| queue.push_captured(reading));
    tokio::task::spawn_blocking(push).await.unwrap().unwrap();
    running.shutdown().await.unwrap();
    file
}

/// ReplayOptions of a replay for tests: no other program's ports.
fn served(file: &Path, served: ServedReplay) -> ReplayOptions {
    let served = Some(ServedReplay { any_port: true, ..served });
    ReplayOptions { files: vec![file.to_owned()], served, ..ReplayOptions::default() }
}

/// A replay that waits for one reader, and ends at its end.
fn for_one_reader() -> ServedReplay {
    ServedReplay { exits_at_end: true, wait_readers: 1, ..ServedReplay::default() }
}

/// A replay of one reader that has to acknowledge each map in this time.
fn in_lockstep(file: &Path, seconds: f64) -> ReplayOptions {
    let lockstep = Some(Duration::from_secs_f64(seconds));
    served(file, ServedReplay { lockstep, ..for_one_reader() })
}

/// A replay that begins paused.
fn paused() -> ServedReplay {
    ServedReplay { paused: true, ..ServedReplay::default() }
}

/// Replays, and runs `test` with the address of gRPC meanwhile; the replay ends when both have.
async fn replayed<F: Future<Output = T>, T>(
    options: ReplayOptions,
    test: impl FnOnce(String) -> F,
) -> (Result<ReplaySummary, ReplayError>, Option<T>) {
    let ends_itself = options.served.as_ref().is_none_or(|of| of.exits_at_end || of.lockstep.is_some());
    let replay = match ReplayRun::start(options).await {
        Ok(replay) => replay,
        Err(error) => return (Err(error), None),
    };
    // A replay that is not served has no address, and the test needs none.
    let address = replay.running.grpc.map(|address| address.to_string()).unwrap_or_default();
    let mut outcome = None;
    let stop = async {
        outcome = Some(test(address).await);
        if ends_itself {
            std::future::pending::<()>().await;
        }
    };
    let summary = within("a replay", replay.play(stop)).await;
    (summary, outcome)
}

async fn transport(address: &str) -> ReplayServiceClient<Channel> {
    ReplayServiceClient::connect(format!("http://{address}")).await.expect("gRPC answers")
}

/// The recorded maps: all layers of each in one message, with the arrival of the event that completed it.
fn recorded_maps(file: &Path) -> Vec<(i64, Bytes)> {
    let mut maps: BTreeMap<u64, v1::Map> = BTreeMap::new();
    let layers = fixture::recorded(file);
    for name in ["drivability", "height_difference", "terrain", "occupancy", "speed", "safe_path", "freespace"] {
        for ((sequence, layer), bytes) in layers.iter().filter(|((_, layer), _)| layer == name) {
            let mut map = v1::Map::decode(bytes.clone()).unwrap();
            assert_eq!(map.layers.len(), 1, "{layer}");
            maps.entry(*sequence)
                .or_insert(v1::Map { header: map.header, layers: Vec::new() })
                .layers
                .append(&mut map.layers);
        }
    }
    let completed = |map: &v1::Map| map.header.as_ref().unwrap().completed_ns;
    maps.into_values().map(|map| (completed(&map), map.encode_to_vec().into())).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn maps_as_live_are_the_recorded_ones_moved_by_one_constant_until_the_end() {
    let folder = tempfile::tempdir().unwrap();
    let drive = recorded_drive(folder.path(), 12).await;
    let (ready, again) = (folder.path().join("ready.json"), folder.path().join("again.mcap"));
    // As mktemp makes it.
    std::fs::write(&ready, "").unwrap();
    let as_live = ServedReplay { as_live: true, ready_file: Some(ready.clone()), ..for_one_reader() };
    let options = ReplayOptions { record: Some(again.clone()), ..served(&drive, as_live) };
    let test = async |address: String| {
        let file: serde_json::Value = serde_json::from_slice(&std::fs::read(&ready).unwrap()).unwrap();
        assert_eq!((file["grpc"].as_str(), file["pid"].as_u64()), (Some(&*address), Some(std::process::id().into())));
        assert!(file["page"].as_str().unwrap().starts_with("http://127.0.0.1:"), "{file}");
        let mut stream = Client::connect(&address).await.unwrap().subscribe(Subscription::default()).await.unwrap();
        let mut transport = transport(&address).await;
        tokio::spawn(async move { while transport.control(v1::ReplayControl::default()).await.is_ok() {} });
        let mut maps = Vec::new();
        while let Ok(update) = stream.next().await {
            maps.push(update.map);
        }
        maps
    };
    let (summary, maps) = replayed(options, test).await;
    assert!(summary.unwrap().reached_end);
    assert!(!ready.exists());
    let (maps, recorded) = (maps.unwrap(), recorded_maps(&drive));
    assert_eq!(maps.last().unwrap().sequence() + 1, recorded.len() as u64, "the last map comes before the end");
    let replay_of = |map: &clearway_client::MapView| map.header().replay.expect("a replay");
    let first = replay_of(&maps[0]);
    for map in &maps {
        assert_eq!(replay_of(map), first, "one constant, also while the state is asked for");
        assert_eq!(map.bytes(), &as_served(recorded[map.sequence() as usize].1.clone(), map.bytes()));
        let age_ns = clearway_client::now_ns() - map.header().capture_end_ns;
        assert!((0..600_000_000_000).contains(&age_ns), "in the last ten minutes");
    }
    // The recording of the replay has the moved stamps, and verify knows the constant.
    let report = verify(&again).unwrap();
    assert!(report.is_good() && report.maps == recorded.len() as u64, "{:?}", report.differences);
    assert_eq!(recorded_maps(&again)[0].0 - recorded[0].0, first.shift_ns);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_seek_to_any_of_a_hundred_moments_gives_the_map_of_the_straight_run() {
    let folder = tempfile::tempdir().unwrap();
    let drive = recorded_drive(folder.path(), 20).await;
    let recorded = recorded_maps(&drive);
    let mut random = 14_u64;
    println!("seed {random}");
    let test = async |address: String| {
        let client = Client::connect(&address).await.unwrap();
        let mut transport = transport(&address).await;
        let state = transport.watch_state(v1::WatchStateRequest {}).await.unwrap().into_inner().message().await;
        let state = state.unwrap().unwrap();
        assert_eq!(state.phase(), v1::ReplayPhase::Paused);
        for jump in 1..=100 {
            // A linear congruential generator (Knuth); its high bits are good enough.
            random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            let seek_ns = recorded[0].0 + (random >> 33) as i64 % (state.end_ns - recorded[0].0 + 1);
            let request = v1::ReplayControl { seek_ns: Some(seek_ns), ..Default::default() };
            let after = transport.control(request).await.unwrap().into_inner();
            assert_eq!((after.position_ns, after.jumps, after.phase()), (seek_ns, jump, v1::ReplayPhase::Paused));
            let newest = client.newest("", &[]).await.unwrap();
            let expected = recorded.iter().rev().find(|(completed_ns, _)| *completed_ns <= seek_ns).unwrap();
            assert_eq!(newest.bytes(), &as_served(expected.1.clone(), newest.bytes()), "jump {jump} to {seek_ns}");
            let header = newest.header();
            assert_eq!(header.boot_id, header.replay.unwrap().recorded_boot_id.wrapping_add(jump));
        }
        for (request, text) in [
            (v1::ReplayControl { seek_ns: Some(state.end_ns + 1), ..Default::default() }, "the replay plays 0.000 s"),
            (v1::ReplayControl { rate: Some(f64::NAN), ..Default::default() }, "rate NaN: 0.1 to 1000"),
            (v1::ReplayControl { rate: Some(0.0), ..Default::default() }, "rate 0: 0.1 to 1000"),
        ] {
            let refused = transport.control(request).await.unwrap_err();
            assert!(refused.message().contains(text), "{refused}");
        }
    };
    let (summary, tested) = replayed(served(&drive, paused()), test).await;
    assert!(tested.is_some());
    assert!(!summary.unwrap().reached_end, "it was stopped");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_jump_restores_the_plan_that_was_in_force() {
    let folder = tempfile::tempdir().unwrap();
    let drive = recorded_drive(folder.path(), 20).await;
    let replay = ReplayRun::start(served(&drive, paused())).await.unwrap();
    let address = replay.running.grpc.unwrap().to_string();
    let plans = replay.running.vehicles.0[0].wires.plans.subscribe();
    let test = async {
        let mut transport = transport(&address).await;
        let state = transport.control(v1::ReplayControl::default()).await.unwrap().into_inner();
        for (tenths, expected) in [(19, "second"), (10, "first"), (2, ""), (16, "second"), (4, "")] {
            let seek_ns = Some(state.begin_ns + tenths * 100_000_000);
            transport.control(v1::ReplayControl { seek_ns, ..Default::default() }).await.unwrap();
            let text = plans.borrow().as_ref().map(|plan| plan.text.clone()).unwrap_or_default();
            assert_eq!(text, expected, "after {tenths} tenths of a second");
        }
    };
    within("a replay", replay.play(test)).await.unwrap();
}

/// Reads to the end of the replay; returns the last map.
async fn to_end(stream: &mut MapStream) -> Option<MapView> {
    let mut last = None;
    loop {
        match stream.next().await {
            Ok(update) => last = Some(update.map),
            Err(ClientError::ReplayEnded { .. }) => return last,
            Err(other) => panic!("{other}"),
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_step_makes_so_many_maps_and_a_range_ends_and_begins_again() {
    let folder = tempfile::tempdir().unwrap();
    let drive = recorded_drive(folder.path(), 10).await;
    let recorded = recorded_maps(&drive);
    let test = async |address: String| {
        let client = Client::connect(&address).await.unwrap();
        let mut transport = transport(&address).await;
        let mut sequences = Vec::new();
        for step in [1, 2] {
            // The answer comes when the maps are made.
            let request = v1::ReplayControl { step: Some(step), ..Default::default() };
            let state = transport.control(request).await.unwrap().into_inner();
            assert_eq!(state.phase(), v1::ReplayPhase::Paused);
            let newest = client.newest("", &[]).await.unwrap().sequence();
            assert_eq!(state.maps, [newest + 1]);
            sequences.push(newest);
        }
        let mut stream = client.subscribe(Subscription::default()).await.unwrap();
        let (from_ns, to_ns) = (recorded[2].0, recorded[5].0);
        let request = v1::ReplayControl {
            from_ns: Some(from_ns),
            to_ns: Some(to_ns),
            rate: Some(f64::INFINITY),
            seek_ns: Some(from_ns),
            paused: Some(false),
            ..Default::default()
        };
        transport.control(request).await.unwrap();
        // It may have been told of a map before the jump.
        let mut last = to_end(&mut stream).await;
        let first_end = last.unwrap().sequence();
        // Asked again, a stream at the end says so again; at the end, `play` begins the range again.
        assert!(matches!(stream.next().await, Err(ClientError::ReplayEnded { .. })));
        let play = v1::ReplayControl { paused: Some(false), ..Default::default() };
        let again = transport.control(play).await.unwrap().into_inner();
        assert_eq!((again.phase(), again.position_ns, again.jumps), (v1::ReplayPhase::Playing, from_ns, 2));
        last = to_end(&mut stream).await;
        let boot_id = last.unwrap().header().boot_id;
        transport
            .control(v1::ReplayControl { repeat: Some(true), seek_ns: Some(from_ns), ..Default::default() })
            .await
            .unwrap();
        let mut boot_ids = std::collections::BTreeSet::new();
        while boot_ids.len() < 3 {
            let header = stream.next().await.unwrap().map.header().clone();
            assert!((2..=5).contains(&header.sequence));
            boot_ids.insert(header.boot_id.wrapping_sub(boot_id));
        }
        (sequences, first_end)
    };
    let (summary, outcome) = replayed(served(&drive, paused()), test).await;
    assert_eq!(outcome.unwrap(), (vec![0, 2], 5));
    summary.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn in_lockstep_a_reader_gets_every_map_and_one_that_never_acknowledges_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let drive = recorded_drive(folder.path(), 8).await;
    let maps = recorded_maps(&drive).len();
    let options = in_lockstep(&drive, 10.0);
    async fn reads(address: String, acknowledges: bool) -> (Vec<u64>, String) {
        let mut service = v1::map_service_client::MapServiceClient::connect(format!("http://{address}")).await.unwrap();
        let (requests, stream) = tokio::sync::mpsc::channel(8);
        requests.send(fixture::selection("", &["drivability"], 1)).await.unwrap();
        let stream = tokio_stream::wrappers::ReceiverStream::new(stream);
        let mut updates = service.watch(stream).await.unwrap().into_inner();
        let mut sequences = Vec::new();
        let why = loop {
            let update = match updates.message().await {
                Ok(Some(update)) if !update.replay_ended => update,
                Ok(_) => break String::new(),
                Err(status) => break status.message().to_owned(),
            };
            sequences.push(fixture::sequence(&update.map));
            let acknowledged = sequences.last().copied();
            if acknowledges {
                requests.send(v1::WatchRequest { acknowledged, ..Default::default() }).await.unwrap();
            }
        };
        (sequences, why)
    }
    let (summary, read) = replayed(options.clone(), |address| reads(address, true)).await;
    assert!(summary.unwrap().reached_end);
    assert_eq!(read.unwrap(), ((0..maps as u64).collect(), String::new()));

    let options = in_lockstep(&drive, 0.2);
    // The reader outlives the replay.
    let (send_read, read) = tokio::sync::oneshot::channel();
    let test = async move |address| drop(tokio::spawn(async move { send_read.send(reads(address, false).await) }));
    let (summary, _) = replayed(options, test).await;
    let error = summary.unwrap_err().to_string();
    let (sequences, why) = within("the reader's end", read).await.unwrap();
    assert_eq!(sequences, [0]);
    assert!(why.contains(&error), "the reader is told why: {why}");
    let named = "map 0 of vehicle car was not acknowledged within 0.2 s; awaited: gRPC reader of drivability";
    assert!(error.contains(named), "{error}");
}

#[tokio::test(flavor = "multi_thread")]
async fn while_a_step_waits_for_an_acknowledgement_the_state_says_so_and_a_seek_drops_the_steps_owed() {
    let folder = tempfile::tempdir().unwrap();
    let drive = recorded_drive(folder.path(), 8).await;
    let recorded = recorded_maps(&drive);
    let test = async |address: String| {
        let mut transport = transport(&address).await;
        let mut states = transport.watch_state(v1::WatchStateRequest {}).await.unwrap().into_inner();
        let mut steps = transport.clone();
        // No reader acknowledges the first map, so the second is not made.
        let request = v1::ReplayControl { lockstep: Some(true), step: Some(2), ..Default::default() };
        let stepped = tokio::spawn(async move { steps.control(request).await.unwrap().into_inner() });
        let awaited = loop {
            let state = states.message().await.unwrap().unwrap();
            if !state.awaited.is_empty() {
                break state.awaited;
            }
        };
        assert_eq!(awaited, "the acknowledgement of map 0 of vehicle car by any reader that acknowledges");
        let status = Client::connect(&address).await.unwrap().vehicles().await.unwrap().remove(0);
        let waits = status.reasons.contains(&format!("the replay waits for {awaited}"));
        assert!(waits && status.state != "error", "{}: {:?}", status.state, status.reasons);
        let request = v1::ReplayControl { seek_ns: Some(recorded[3].0), ..Default::default() };
        let state = transport.control(request).await.unwrap().into_inner();
        assert_eq!((state.phase(), state.position_ns), (v1::ReplayPhase::Paused, recorded[3].0));
        assert_eq!((&*state.awaited, &state.maps[..]), ("", &[4][..]));
        assert_eq!(stepped.await.unwrap().jumps, 1, "the step is over when the seek is made");
    };
    let (summary, tested) = replayed(served(&drive, paused()), test).await;
    tested.expect("the test ran");
    summary.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_drive_opened_at_a_moment_stands_there_between_its_whole_begin_and_end_and_is_no_error() {
    let folder = tempfile::tempdir().unwrap();
    let drive = recorded_drive(folder.path(), 8).await;
    let test = async |address: String| {
        let client = Client::connect(&address).await.unwrap();
        let step = v1::ReplayControl { step: Some(1), ..Default::default() };
        let state = client.replay_control(step).await.unwrap();
        assert_eq!((state.from_ns, state.to_ns), (state.begin_ns, state.end_ns));
        assert!(state.position_ns > state.begin_ns + 400_000_000, "{state:?}");
        let back = v1::ReplayControl { seek_ns: Some(state.begin_ns + 200_000_000), ..Default::default() };
        assert_eq!(client.replay_control(back).await.unwrap().phase(), v1::ReplayPhase::Paused);
        let status = client.vehicles().await.unwrap().remove(0);
        assert!(status.state == "ok" && status.reasons[0] == "the replay is paused", "{:?}", status.reasons);
        assert!(status.map_age_ms.unwrap() < 60_000.0, "by the replay's clock: {:?} ms", status.map_age_ms);
        let begin = v1::ReplayControl { seek_ns: Some(state.begin_ns), ..Default::default() };
        assert_eq!(client.replay_control(begin).await.unwrap().maps, [0]);
        let error = client.newest("", &[]).await.unwrap_err().to_string();
        assert!(error.contains("has no map yet"), "before the first map there is no newest one: {error}");
    };
    let (summary, tested) = replayed(served(&drive, ServedReplay { seek_s: Some(0.4), ..paused() }), test).await;
    tested.expect("the test ran");
    summary.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn in_lockstep_the_next_map_is_made_when_the_client_has_handled_the_last() {
    let folder = tempfile::tempdir().unwrap();
    let drive = recorded_drive(folder.path(), 8).await;
    let maps = recorded_maps(&drive).len() as u64;
    let options = in_lockstep(&drive, 10.0);
    let (summary, sequences) = replayed(options.clone(), async |address| {
        let client = Client::connect(&address).await.unwrap();
        let mut stream = client.subscribe(Subscription::default()).await.unwrap();
        let mut sequences = Vec::new();
        while let Ok(update) = stream.next().await {
            sequences.push(update.map.sequence());
        }
        sequences
    })
    .await;
    assert!(summary.unwrap().reached_end);
    assert_eq!(sequences.unwrap(), (0..maps).collect::<Vec<_>>());
    // A client that never asks for the next map still handles the first, although it has arrived.
    let options = in_lockstep(&drive, 0.2);
    let (summary, _) = replayed(options, async |address| {
        let client = Client::connect(&address).await.unwrap();
        let mut stream = client.subscribe(Subscription::default()).await.unwrap();
        let first = stream.next().await.unwrap().map.sequence();
        while stream.ended().is_none() {
            before_another_look().await;
        }
        assert_eq!((first, stream.newest().unwrap().sequence()), (0, 0));
    })
    .await;
    let error = summary.unwrap_err().to_string();
    assert!(error.contains("map 0 of vehicle car was not acknowledged within 0.2 s"), "{error}");
}

#[tokio::test(flavor = "multi_thread")]
async fn recorded_stamps_are_stale_by_the_wall_clock_and_fresh_by_the_replays() {
    let folder = tempfile::tempdir().unwrap();
    let drive = recorded_drive(folder.path(), 8).await;
    let (summary, _) =
        replayed(served(&drive, ServedReplay { wait_readers: 1, ..ServedReplay::default() }), async |address| {
            let client = Client::connect(&address).await.unwrap();
            let by_replay = Subscription { replay_clock: true, ..Subscription::default() };
            let mut by_replay = client.subscribe(by_replay).await.unwrap();
            let StreamEvent::Fresh(update) = by_replay.next_or_stale().await.unwrap() else { panic!("it is fresh") };
            assert!(!update.map.is_stale(update.map.now_ns()) && update.map.is_stale(clearway_client::now_ns()));
            let mut by_wall = client.subscribe(Subscription::default()).await.unwrap();
            assert!(matches!(by_wall.next_or_stale().await.unwrap(), StreamEvent::Stale(_)));
            // After the last map they are stale by both.
            while by_replay.next().await.is_ok() {}
            while !matches!(by_replay.next_or_stale().await.unwrap(), StreamEvent::Stale(_)) {}
        })
        .await;
    summary.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_range_outside_the_files_is_refused_and_a_stopped_replay_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let drive = recorded_drive(folder.path(), 5).await;
    let outside = ReplayOptions { from_s: Some(99.0), files: vec![drive.clone()], ..ReplayOptions::default() };
    let (error, _) = replayed(outside, async |_| {}).await;
    let error = error.unwrap_err().to_string();
    assert!(error.starts_with("--from 99.000 s: the replay plays 0.000 s to 0.5"), "{error}");
    let waits = served(&drive, ServedReplay { wait_readers: 2, ..ServedReplay::default() });
    let (summary, _) = replayed(waits, async |_| tokio::time::sleep(Duration::ZERO).await).await;
    let summary = summary.unwrap();
    assert!(!summary.reached_end && summary.snapshot.maps == 0);
    assert_eq!(summary.to_json()["reached_end"], false);
}

#[tokio::test(flavor = "multi_thread")]
async fn recordings_of_two_vehicles_run_in_one_time() {
    let folder = tempfile::tempdir().unwrap();
    let (car, van) =
        (recorded_drive_of("car", folder.path(), 6).await, recorded_drive_of("van", folder.path(), 4).await);
    let both = folder.path().join("both.mcap");
    let options =
        ReplayOptions { files: vec![car.clone(), van.clone()], record: Some(both.clone()), ..ReplayOptions::default() };
    let (summary, _) = replayed(options, async |_| {}).await;
    let summary = summary.unwrap();
    let text = summary.to_text();
    assert!(text.contains("vehicle car\n") && text.contains("vehicle van\n"), "{text}");
    assert!(summary.others[0].0 == "van" && summary.others[0].1.maps > 0, "{text}");
    let report = verify(&both).unwrap();
    assert!(report.is_good(), "{:?}", report.differences);
    assert_eq!(report.maps as usize, recorded_maps(&car).len() + recorded_maps(&van).len());
    // One of them is replayed as ever.
    let options = ReplayOptions { files: vec![both], vehicle: Some("van".into()), ..ReplayOptions::default() };
    let (summary, _) = replayed(options, async |_| {}).await;
    assert_eq!(summary.unwrap().snapshot.maps as usize, recorded_maps(&van).len());
}

#[tokio::test(flavor = "multi_thread")]
async fn the_same_faults_give_the_same_maps_and_are_counted() {
    let folder = tempfile::tempdir().unwrap();
    let drive = recorded_drive(folder.path(), 10).await;
    let faults = ["lost:top@0.4-0.65", "loss:5", "pose:1,0,5@0.5"].map(|fault| fault.parse().unwrap());
    let mut runs = Vec::new();
    for name in ["a.mcap", "b.mcap"] {
        let record = folder.path().join(name);
        let options = ReplayOptions {
            files: vec![drive.clone()],
            record: Some(record.clone()),
            faults: faults.to_vec(),
            ..ReplayOptions::default()
        };
        let (summary, _) = replayed(options, async |_| {}).await;
        let notes = summary.unwrap().notes;
        assert!(notes.iter().any(|note| note.starts_with("fault lost:top@0.4-0.65: ")), "{notes:?}");
        assert!(notes.iter().all(|note| !note.ends_with(": 0 readings")), "{notes:?}");
        let report = verify(&record).unwrap();
        assert!(report.is_good(), "{:?}", report.differences);
        runs.push(fixture::recorded(&record));
    }
    assert!(runs[0] == runs[1], "the faults are repeated");
    assert!(runs[0].len() < fixture::recorded(&drive).len(), "the lost sensor makes no maps");
    let unknown = ReplayOptions {
        files: vec![drive],
        faults: vec!["lost:front@1-2".parse().unwrap()],
        ..ReplayOptions::default()
    };
    let (error, _) = replayed(unknown, async |_| {}).await;
    assert!(error.unwrap_err().to_string().contains("sensor \"front\" is not known; known: top"));
}

#[tokio::test(flavor = "multi_thread")]
async fn overlapping_files_and_a_configuration_of_other_sensors_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let drive = recorded_drive(folder.path(), 3).await;
    let twice = ReplayOptions { files: vec![drive.clone(), drive.clone()], ..ReplayOptions::default() };
    let (error, _) = replayed(twice, async |_| {}).await;
    let error = error.unwrap_err().to_string();
    assert!(error.contains("car.mcap: it begins 0.") && error.contains("without overlap"), "{error}");
    let (file, mut config) = (folder.path().join("other.toml"), fixture::config());
    config.vehicles[0].sensors[0].name = "front".into();
    std::fs::write(&file, config.to_toml()).unwrap();
    let other = ReplayOptions { files: vec![drive], config: Some(file), ..ReplayOptions::default() };
    let (error, _) = replayed(other, async |_| {}).await;
    let error = error.unwrap_err().to_string();
    assert!(error.contains("vehicle car has the sensors [front], but the recording has [top]"), "{error}");
}

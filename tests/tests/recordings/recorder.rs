//! The recorder as a service: it replaces no file, its parts are verifiable alone, it says what the disk has, and it
//! loses nothing that it has confirmed.

use std::collections::BTreeSet;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use clearway_daemon::config::Config;
use clearway_daemon::ingest::queue::Reading;
use clearway_daemon::record::verify;
use clearway_daemon::run::{Running, Server, Setup};
use clearway_journal::RecordedMaps;
use clearway_journal::mcap_reader::{McapReader, Message};
use clearway_journal::reader::{RecordedMessage, RecordingReader};
use clearway_mapping::event::Body;
use clearway_proto::v1;
use clearway_proto::v1::recording_service_client::RecordingServiceClient;
use prost::Message as _;
use tonic::Code;
use tonic::transport::Channel;

use crate::fixture::copied::copy;
use crate::fixture::{self, config, feed, readings, until, with_short_warm_up, within};

/// Number of servers that are killed; 200 by `CLEARWAY_KILLS=200 cargo test --release --test system kill`.
fn kills() -> usize {
    std::env::var("CLEARWAY_KILLS").ok().and_then(|kills| kills.parse().ok()).unwrap_or(20)
}

/// Time between two packets of a VLP-16.
const PACKET_TIME: Duration = Duration::from_nanos(1_327_104);

/// A live server that records to `file` with a short warm-up.
async fn live(file: &Path) -> Running {
    let mut config = with_short_warm_up(config());
    config.recorder.file = file.to_owned();
    config.recorder.flush_ms = 50;
    Server::start(Setup { config, ..Setup::default() }).await.expect("the server starts")
}

async fn service(running: &Running) -> RecordingServiceClient<Channel> {
    let address = format!("http://{}", running.grpc.expect("gRPC is served"));
    RecordingServiceClient::connect(address).await.expect("gRPC answers")
}

/// The readings of three seconds, cut at these tenths of a second.
fn cut_at(tenths: &[i64]) -> Vec<Vec<Reading>> {
    let all = readings(30);
    let start_ns = all[0].arrival_ns;
    let mut groups: Vec<Vec<Reading>> = vec![Vec::new(); tenths.len() + 1];
    for reading in all {
        let tenth = (reading.arrival_ns - start_ns) / 100_000_000;
        let group = tenths.iter().filter(|cut| tenth >= **cut).count();
        groups[group].push(reading);
    }
    groups
}

/// The sequences of the events, and of the maps with their layers, of a recording.
fn contents(file: &Path) -> (BTreeSet<u64>, BTreeSet<(u64, String)>) {
    let (mut events, mut maps) = (BTreeSet::new(), BTreeSet::new());
    for message in RecordingReader::open(file).unwrap() {
        match message.unwrap() {
            RecordedMessage::Event { event, .. } => {
                events.insert(event.sequence);
            }
            RecordedMessage::Map { layer, bytes, .. } => {
                assert!(maps.insert((fixture::sequence(&bytes), layer)), "each map once");
            }
            _ => {}
        }
    }
    (events, maps)
}

#[tokio::test(flavor = "multi_thread")]
async fn parts_are_one_drive_in_the_order_in_which_the_engine_took_their_events() {
    let folder = tempfile::tempdir().unwrap();
    let running = live(&folder.path().join("car.mcap")).await;
    let mut groups = cut_at(&[8, 18]).into_iter();
    let (first, mut second) = (groups.next().unwrap(), groups.next().unwrap());
    // As a datagram of another sensor, whose socket was read later.
    second[0].arrival_ns = first.last().unwrap().arrival_ns - 1_000_000;
    feed(&running, first).await;
    service(&running).await.split(v1::SplitRecordingRequest {}).await.unwrap();
    feed(&running, second).await;
    within("shutdown", running.shutdown()).await.unwrap();
    let [first, second] = ["car.mcap", "car.part-0002.mcap"].map(|part| folder.path().join(part).display().to_string());
    let done = clearway_tests::run(Path::new("."), "clearway", &["replay", &first, &second]);
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
}

#[tokio::test(flavor = "multi_thread")]
async fn each_part_is_verifiable_alone_and_together_they_hold_everything() {
    let folder = tempfile::tempdir().unwrap();
    let running = live(&folder.path().join("car.mcap")).await;
    let mut service = service(&running).await;
    for group in cut_at(&[8, 18]) {
        feed(&running, group).await;
        service.split(v1::SplitRecordingRequest {}).await.unwrap();
    }
    let status = running.vehicles.0[0].status.clone();
    let made = status.snapshot().maps;
    within("shutdown", running.shutdown()).await.unwrap();
    let recorder = status.to_proto().recorder.unwrap();
    for topic in &recorder.topics {
        assert_eq!((topic.offered, topic.dropped), (topic.written, 0), "{topic:?}");
    }
    let (mut events, mut maps) = (BTreeSet::new(), BTreeSet::new());
    for part in ["car.mcap", "car.part-0002.mcap", "car.part-0003.mcap"] {
        let file = folder.path().join(part);
        let report = verify(&file).unwrap();
        assert!(report.is_good() && !report.cut && report.is_closed && report.unjudged == 0, "{part}: {report:?}");
        assert!(report.equal >= 3 * fixture::LAYERS, "{part}: {report:?}");
        let is_timed = |message: Message| message.log_ns > 1_000_000_000_000_000_000;
        assert!(
            McapReader::open(&file).unwrap().all(|message| is_timed(message.unwrap())),
            "{part}: a log time of 1970"
        );
        let (of_part, maps_of_part) = contents(&file);
        events.extend(of_part);
        maps_of_part.into_iter().for_each(|map| assert!(maps.insert(map), "{part}: each map is in one part"));
    }
    assert_eq!(maps.len() as u64, made * fixture::LAYERS);
    assert_eq!(events.len() as u64, recorder.durable_events["car"]);
    assert_eq!(events.last().copied(), Some(events.len() as u64 - 1), "no event is missing");
    // The later parts begin with events of the part before, which a replay passes over.
    let other = tempfile::tempdir().unwrap();
    let parts = folder.path().to_str().unwrap();
    let replay = clearway_tests::run(other.path(), "clearway", &["replay", parts, "--record", "whole.mcap"]);
    assert!(replay.status.success(), "{}", String::from_utf8_lossy(&replay.stderr));
    assert!(contents(&other.path().join("whole.mcap")) == (events, maps), "the parts are one drive");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_recording_is_stopped_started_saved_and_listed() {
    let folder = tempfile::tempdir().unwrap();
    let running = live(&folder.path().join("car.mcap")).await;
    let mut service = service(&running).await;
    let groups = cut_at(&[5, 10]);
    let mut groups = groups.into_iter();
    feed(&running, groups.next().unwrap()).await;
    let refused = service.start(v1::StartRecordingRequest {}).await.unwrap_err();
    assert_eq!(refused.code(), Code::FailedPrecondition, "{refused:?}");
    let wrong = v1::SaveRecordingRequest { seconds: 10, reason: "../x".into() };
    assert_eq!(service.save(wrong).await.unwrap_err().code(), Code::InvalidArgument);

    let save = v1::SaveRecordingRequest { seconds: 10, reason: "near-miss".into() };
    let saved = service.save(save).await.unwrap().into_inner().files;
    assert!(saved.len() == 1 && saved[0].contains("saved") && saved[0].contains("near-miss"), "{saved:?}");
    let (events, _) = contents(Path::new(&saved[0]));
    assert!(events.len() > 300, "the saved file holds what was recorded: {}", events.len());

    service.stop(v1::StopRecordingRequest {}).await.unwrap();
    let status = running.vehicles.0[0].status.clone();
    until("the recorder has stopped", || status.to_proto().recorder.unwrap().state == "stopped").await;
    assert!(verify(Path::new(&saved[0])).unwrap().is_closed, "the saved file is whole now");
    feed(&running, groups.next().unwrap()).await;
    assert_eq!(status.to_proto().recorder.unwrap().lost, 0, "what is not to be recorded is not lost");
    service.start(v1::StartRecordingRequest {}).await.unwrap();
    feed(&running, groups.next().unwrap()).await;
    let listed = service.list(v1::ListRecordingsRequest {}).await.unwrap().into_inner().parts;
    assert!(listed.iter().any(|part| part.file.ends_with("car.mcap")), "{listed:?}");
    assert!(listed.iter().any(|part| part.is_unfinished), "{listed:?}");
    let address = running.grpc.expect("gRPC is served").to_string();
    let clearway = async |request: &'static [&'static str]| {
        let arguments = [&["recorder"], request, &["--json", "--server", &address]].concat().join(" ");
        let run = move || clearway_tests::run(Path::new("."), "clearway", &arguments.split(' ').collect::<Vec<_>>());
        tokio::task::spawn_blocking(run).await.unwrap()
    };
    let json = async |request: &'static [&'static str]| {
        serde_json::from_slice::<serde_json::Value>(&clearway(request).await.stdout).expect("JSON")
    };
    let [listed_as_json, told] = [json(&["list"]).await, json(&["status"]).await];
    assert_eq!(listed_as_json["parts"].as_array().unwrap().len(), listed.len(), "{listed_as_json}");
    assert!(listed_as_json["parts"][0]["bytes"].as_u64().unwrap() > 0, "{listed_as_json}");
    assert_eq!((&told["state"], &told["saved"]), (&"recording".into(), &serde_json::json!([])), "{told}");
    assert_eq!(told["topics"].as_array().unwrap().len() as u64, 1 + fixture::LAYERS, "{told}");
    let part = service.status(v1::RecordingStatusRequest {}).await.unwrap().into_inner().status.unwrap().part;
    let wrong = clearway(&["save", "--reason", "../x"]).await;
    let told = String::from_utf8_lossy(&wrong.stderr).into_owned();
    assert_eq!((wrong.status.code(), told.contains("1 to 40 letters")), (Some(3), true), "{told}");
    let saved = json(&["save", "--reason", "as-json", "--seconds", "86400"]).await;
    assert!(saved["saved"][0].as_str().unwrap().contains("as-json"), "{saved}");
    assert!((f64::EPSILON..3600.0).contains(&saved["saved_s"].as_f64().unwrap()), "a day is not recorded: {saved}");
    within("shutdown", running.shutdown()).await.unwrap();
    let report = verify(&folder.path().join(format!("car.part-{part:04}.mcap"))).unwrap();
    assert!(report.is_good() && report.equal >= fixture::LAYERS && report.unjudged == 0, "{report:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn finished_parts_go_to_the_store_and_none_is_deleted_before_it_is_confirmed() {
    let folder = tempfile::tempdir().unwrap();
    let (recordings, away) = (folder.path().join("recordings"), folder.path().join("away"));
    // The store is away: its folder cannot be made while a file has the name of its parent.
    std::fs::write(&away, "").unwrap();
    let mut config = with_short_warm_up(config());
    config.recorder.file = recordings.join("car.mcap");
    config.recorder.keep_mb = 1;
    config.store.url = away.join("store").display().to_string();
    let running = Server::start(Setup { config, ..Setup::default() }).await.expect("the server starts");
    let (mut service, status) = (service(&running).await, running.vehicles.0[0].status.clone());
    let recorder = || status.to_proto().recorder.unwrap();
    let finished = |part: &str| recordings.join(part).exists();
    for group in cut_at(&[8, 18]) {
        feed(&running, group).await;
        service.split(v1::SplitRecordingRequest {}).await.unwrap();
    }
    until("the first part waits", || recorder().store_waiting >= 1 && recorder().store_failures >= 2).await;
    assert!(recorder().store_problem.contains("away/store"), "{}", recorder().store_problem);
    assert!(recorder().store_problem_since_ns > 0);
    assert_eq!(recorder().store_confirmed, 0);
    assert!(std::fs::metadata(recordings.join("car.mcap")).unwrap().len() > 1 << 20, "longer than keep_mb");
    until("the second part is whole", || finished("car.part-0002.mcap")).await;
    assert!(finished("car.mcap"), "keep_mb deletes no part that the store has not confirmed");

    std::fs::remove_file(&away).unwrap();
    until("both are confirmed", || recorder().store_confirmed >= 2 && recorder().store_problem.is_empty()).await;
    let stored = clearway_daemon::store::location::open(away.join("store").to_str().unwrap()).unwrap();
    let found = clearway_daemon::store::index::search(&*stored, &Default::default()).await.unwrap().entries;
    assert!(found.len() >= 2 && found.iter().all(|entry| entry.vehicle == "car" && entry.events > 0), "{found:?}");
    within("shutdown", running.shutdown()).await.unwrap();
    assert!(!finished("car.mcap"), "the end of the last part deletes the oldest confirmed one");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_recording_is_split_saved_stopped_and_listed_over_zenoh() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = with_short_warm_up(config());
    config.recorder.file = folder.path().join("car.mcap");
    config.zenoh.enabled = true;
    let running = Server::start(Setup { config, ..Setup::default() }).await.expect("the server starts");
    let settings = format!("{{ mode: \"client\", connect: {{ endpoints: [{:?}] }} }}", running.zenoh[0]);
    let session = zenoh::open(zenoh::Config::from_json5(&settings).unwrap()).await.expect("a session");
    let ask = async |request: &str, payload: Vec<u8>| {
        let replies = session.get(format!("clearway/car/recorder/{request}")).payload(payload).await.unwrap();
        let reply = within("a reply", replies.recv_async()).await.unwrap();
        let bytes = |payload: &zenoh::bytes::ZBytes| payload.to_bytes().into_owned();
        match reply.result() {
            Ok(sample) => Ok(bytes(sample.payload())),
            Err(error) => Err(String::from_utf8(bytes(error.payload())).unwrap()),
        }
    };
    let response = |answer: Result<Vec<u8>, String>| v1::RecordingResponse::decode(&*answer.unwrap()).unwrap();
    let groups = cut_at(&[8, 18]);
    let mut groups = groups.into_iter();
    feed(&running, groups.next().unwrap()).await;
    assert_eq!(response(ask("status", Vec::new()).await).status.unwrap().state, "recording");
    assert!(ask("start", Vec::new()).await.unwrap_err().contains("not stopped"));
    assert!(ask("erase", Vec::new()).await.unwrap_err().contains("save, list and status are allowed"));
    assert!(ask("save", b"\xff".to_vec()).await.unwrap_err().contains("SaveRecordingRequest"));
    let wrong = v1::SaveRecordingRequest { seconds: 10, reason: "../x".into() };
    assert!(ask("save", wrong.encode_to_vec()).await.unwrap_err().contains("\"../x\""));
    let save = v1::SaveRecordingRequest { seconds: 10, reason: "near-miss".into() };
    let saved = response(ask("save", save.encode_to_vec()).await).files;
    assert!(saved.len() == 1 && saved[0].contains("near-miss"), "{saved:?}");
    feed(&running, groups.next().unwrap()).await;
    let part = || running.vehicles.0[0].status.to_proto().recorder.unwrap().part;
    until("the part after the save", || part() == 2).await;
    ask("split", Vec::new()).await.unwrap();
    feed(&running, groups.next().unwrap()).await;
    let listed = v1::ListRecordingsResponse::decode(&*ask("list", Vec::new()).await.unwrap()).unwrap().parts;
    assert!(listed.len() >= 3, "{listed:?}");
    ask("stop", Vec::new()).await.unwrap();
    until("the recorder has stopped", || running.vehicles.0[0].status.to_proto().recorder.unwrap().state == "stopped")
        .await;
    let problem = running.vehicles.0[0].status.recorder_problem();
    assert_eq!(problem.as_deref(), Some("stopped by a request"), "it is in the state of the vehicle");
    session.close().await.unwrap();
    within("shutdown", running.shutdown()).await.unwrap();
    assert!(verify(Path::new(&saved[0])).unwrap().is_good());
}

#[tokio::test(flavor = "multi_thread")]
async fn digests_in_place_of_maps_prove_the_same_and_events_alone_make_the_maps_again() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    for maps in [RecordedMaps::Full, RecordedMaps::Digest, RecordedMaps::None] {
        let mut config = with_short_warm_up(config());
        config.recorder.file = at(&format!("{}.mcap", maps.as_str()));
        config.recorder.maps = maps;
        // The same boot id, because it is in each map.
        let setup = Setup { config, boot_id: Some(7), ..Setup::default() };
        let running = Server::start(setup).await.expect("the server starts");
        let groups = cut_at(&[8]);
        for group in groups {
            feed(&running, group).await;
            service(&running).await.split(v1::SplitRecordingRequest {}).await.unwrap();
        }
        within("shutdown", running.shutdown()).await.unwrap();
    }
    let length = |name: &str| std::fs::metadata(at(name)).unwrap().len();
    assert!(length("none.mcap").max(length("digest.mcap")) < length("full.mcap"));
    for part in [".mcap", ".part-0002.mcap"] {
        let [full, digest, none] =
            ["full", "digest", "none"].map(|name| verify(&at(&format!("{name}{part}"))).unwrap());
        for report in [&full, &digest, &none] {
            assert!(report.is_good() && report.is_closed && report.maps > 5, "{report:?}");
        }
        assert!(full.equal > 5 * fixture::LAYERS && full.cells > 0, "{full:?}");
        assert_eq!((digest.equal, digest.cells, none.equal), (full.equal, full.cells, 0));
    }
    // One packet with other ranges makes other maps, and the first of each layer is named.
    copy(&at("digest.mcap"), &at("changed.mcap"), |topic, sequence, data| {
        if topic != "/car/journal" || sequence != 400 {
            return Some(data);
        }
        let mut event = v1::Event::decode(&data[..]).unwrap();
        let Some(v1::event::Body::Datagram(packet)) = &mut event.body else { panic!("a datagram") };
        *packet = [&packet[..4], &[0; 96], &packet[100..]].concat().into();
        Some(event.encode_to_vec())
    });
    let report = verify(&at("changed.mcap")).unwrap();
    let first = report.differences.first().expect("a difference").to_string();
    assert!(report.different < report.equal && first.contains("sha256: recorded"), "{first}");

    let replay = ["replay", "none.mcap", "--record", "made.mcap"];
    let output = clearway_tests::run(folder.path(), "clearway", &replay);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let (made, full) = (fixture::recorded(&at("made.mcap")), fixture::recorded(&at("full.mcap")));
    assert!(full.len() as u64 > 5 * fixture::LAYERS);
    assert!(full.iter().all(|(map, bytes)| made.get(map) == Some(bytes)), "the maps of the drive that was live");
    for (arguments, says) in [
        (&["verify", "full.mcap", "--against", "digest.mcap"][..], "digest.mcap has no maps"),
        (&["export", "digest.mcap", "--format", "png", "--out", "pictures"], "has no maps; if it has events"),
        (&["verify", "none.mcap"], "no map is recorded"),
    ] {
        let output = clearway_tests::run(folder.path(), "clearway", arguments);
        let text = String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
        assert!(text.contains(says), "{arguments:?}: {text}");
    }
    let other_width = ["verify", "digest.mcap", "--set", "vehicle.maps.reach.vehicle_width_m=4.0"];
    let output = clearway_tests::run(folder.path(), "clearway", &other_width);
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(
        output.status.code() == Some(1) && text.contains("cells changed") && !text.contains("only after"),
        "{text}"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn a_recorder_that_has_failed_has_an_exit_code_of_its_own() {
    let folder = tempfile::tempdir().unwrap();
    let parts = folder.path().join("parts");
    std::fs::create_dir(&parts).unwrap();
    let running = live(&parts.join("car.mcap")).await;
    let server = format!("http://{}", running.grpc.expect("gRPC is served"));
    let recorder = |command: &str| {
        let arguments = ["recorder", command, "--server", &server];
        let output = clearway_tests::run(folder.path(), "clearway", &arguments);
        (output.status.code(), String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned())
    };
    let (code, said) = recorder("status");
    assert!(code == Some(0) && said.starts_with("recording "), "{code:?}: {said}");
    std::fs::remove_dir_all(&parts).unwrap();
    std::fs::write(&parts, "a file where the parts' folder should be").unwrap();
    recorder("stop");
    let (code, said) = recorder("start");
    assert!(code != Some(0) && said.contains("parts"), "{code:?}: {said}");
    let (code, said) = recorder("status");
    assert!(code == Some(4) && said.contains("failed") && said.contains("part"), "{code:?}: {said}");
    assert!(within("shutdown", running.shutdown()).await.is_err(), "the recording is incomplete");
}

#[tokio::test(flavor = "multi_thread")]
async fn without_a_recorder_each_request_is_refused() {
    let running = fixture::start(config()).await;
    let refused = service(&running).await.split(v1::SplitRecordingRequest {}).await.unwrap_err();
    assert!(refused.message().contains("recorder.file"), "{refused:?}");
    within("shutdown", running.shutdown()).await.unwrap();
}

/// A server in its own process that records to `folder`; its data address and its page.
fn serving(folder: &Path, run: usize) -> (Child, SocketAddr, SocketAddr) {
    let free = || std::net::UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    // Another address for each run, so that no port is in use.
    let page = SocketAddr::new([127, 0, 3, 1 + (run % 250) as u8].into(), free().port());
    let data = free();
    let mut config: Config = config();
    (config.grpc.enabled, config.page.enabled, config.page.listen) = (false, true, page);
    config.recorder.file = format!("run{run}.mcap").into();
    let udp = config.vehicles[0].udp.as_mut().unwrap();
    (udp.data, udp.telemetry) = (data, free());
    let path = folder.join("clearway.toml");
    std::fs::write(&path, config.to_toml()).unwrap();
    let mut server = Command::new(clearway_tests::binaries().join("clearway"));
    server.args(["serve", "--config"]).arg(&path).stderr(Stdio::null());
    (server.spawn().unwrap(), data, page)
}

/// The number of durable events by the server's status; `None` until it answers.
fn durable(page: SocketAddr) -> Option<u64> {
    let mut stream = TcpStream::connect(page).ok()?;
    stream.write_all(b"GET /vehicles HTTP/1.0\r\nHost: localhost\r\n\r\n").ok()?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer).ok()?;
    let (_, body) = answer.split_once("\r\n\r\n")?;
    let vehicles: serde_json::Value = serde_json::from_str(body).ok()?;
    vehicles[0]["recorder"]["durable_events"]["car"].as_u64()
}

#[test]
fn kill_9_costs_no_event_that_the_status_called_durable() {
    let folder = tempfile::tempdir().unwrap();
    let socket = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    let payloads: Vec<_> = readings(10)
        .into_iter()
        .filter_map(|reading| match reading.body {
            Body::Datagram(payload) if payload.len() == 1206 => Some(payload),
            _ => None,
        })
        .collect();
    let mut tails = Vec::new();
    for run in 0..kills() {
        let (mut server, data, page) = serving(folder.path(), run);
        // Killed so many looks at the status after this many events are durable, so at any time between two syncs.
        let (least, mut looks) = (200 + 37 * (run % 20) as u64, 7 * run % 20);
        let (began, mut confirmed) = (Instant::now(), 0);
        for (index, payload) in (0_u32..).zip(payloads.iter().cycle()) {
            let _ = socket.send_to(payload, data);
            if index % 50 == 0 {
                // At the pace of a VLP-16, so that nothing waits before it is recorded.
                std::thread::sleep((PACKET_TIME * index).saturating_sub(began.elapsed()));
                confirmed = durable(page).unwrap_or(0);
                match looks.checked_sub(usize::from(confirmed >= least)) {
                    Some(left) => looks = left,
                    None => break,
                }
                assert!(server.try_wait().unwrap().is_none(), "the server runs");
            }
        }
        server.kill().unwrap();
        let killed_ns = clearway_daemon::base::clock::now_ns();
        server.wait().unwrap();
        let file: PathBuf = folder.path().join(format!("run{run}.unfinished.mcap"));
        let report = verify(&file).unwrap();
        assert!(report.is_good() && report.cut, "run {run}: {report:?}");
        let (events, _) = contents(&file);
        let missing = (0..confirmed).filter(|sequence| !events.contains(sequence)).count();
        assert_eq!(missing, 0, "run {run}: {confirmed} events were durable, {} are there", events.len());
        let newest_ns = RecordingReader::open(&file).unwrap().filter_map(|message| match message.unwrap() {
            RecordedMessage::Event { event, .. } => Some(event.arrival_ns),
            _ => None,
        });
        tails.push((killed_ns - newest_ns.max().unwrap()) / 1_000_000);
        std::fs::remove_file(file).unwrap();
    }
    tails.sort_unstable();
    let (median, longest) = (tails[tails.len() / 2], tails[tails.len() - 1]);
    println!("{} kills: 0 durable events lost, the last {median} ms in the median, at most {longest} ms", kills());
}

//! The maps of a recording are the maps of its events; `verify` names the first map, layer and cell that differs.

use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::io::BufWriter;
use std::net::SocketAddr;
use std::path::Path;

use clearway_daemon::config::Config;
use clearway_daemon::ingest::queue::Reading;
use clearway_daemon::record::{run_config, verify};
use clearway_daemon::run::{Server, Setup};
use clearway_journal::reader::{RecordingError, RecordingReader};
use clearway_journal::verify::DifferenceKind;
use clearway_mapping::event::Body;
use clearway_proto::codec::{Cells, CellsRef, Limits, decode, encode_grid};
use clearway_proto::v1;
use prost::Message;

use crate::fixture::copied::copy;
use crate::fixture::{self, config, readings, start, until, within};

/// A recording of the simulated vehicle.
async fn recording(file: &Path) {
    let mut config = config();
    config.grpc.enabled = false;
    config.recorder.file = file.to_owned();
    let running = start(config).await;
    let mut readings = readings(5);
    let arrival_ns = readings.last().unwrap().arrival_ns;
    readings.push(Reading { arrival_ns, source: 0, body: Body::End });
    let queue = running.inputs[0].queue.clone();
    let fed = move || readings.into_iter().try_for_each(|reading| queue.push_captured(reading));
    tokio::task::spawn_blocking(fed).await.unwrap().unwrap();
    running.shutdown().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn verify_names_a_changed_cell_by_sequence_layer_row_and_column() {
    let folder = tempfile::tempdir().unwrap();
    let (whole, changed_copy) = (folder.path().join("whole.mcap"), folder.path().join("changed_copy.mcap"));
    recording(&whole).await;
    let report = verify(&whole).unwrap();
    assert!(report.is_good() && report.maps >= 5 && report.equal == fixture::LAYERS * report.maps, "{report:?}");

    // One class of the third map changes to an obstacle, or from an obstacle to drivable.
    let (row, column, columns) = (3, 17, 360);
    let mut was_and_is = None;
    copy(&whole, &changed_copy, |topic, sequence, data| {
        if topic != "/car/map/drivability" || sequence != 2 {
            return Some(data);
        }
        let mut map = v1::Map::decode(&data[..]).unwrap();
        let channel = &mut map.layers[0].channels[0];
        let Cells::U8(mut cells) = decode(channel, columns, &Limits::default()).unwrap() else {
            panic!("classes are u8")
        };
        let cell = &mut cells[row * columns + column];
        let was = *cell;
        *cell = if was == 3 { 1 } else { 3 };
        was_and_is = Some((i32::from(*cell), i32::from(was)));
        let v1::Channel { name, unit, scale, unknown, .. } = channel.clone();
        *channel = encode_grid(CellsRef::U8(&cells), columns).into_channel(&name, &unit, scale, unknown);
        Some(map.encode_to_vec())
    });
    let report = verify(&changed_copy).unwrap();
    assert_eq!(report.different, 1);
    let difference = &report.differences[0];
    assert_eq!((&*difference.vehicle, difference.sequence, &*difference.layer), ("car", 2, "drivability"));
    let (recorded, computed) = was_and_is.unwrap();
    let channel = "class".to_owned();
    assert_eq!(
        difference.kind,
        DifferenceKind::Cell { row: row as u32, column: column as u32, channel, recorded, computed }
    );
}

/// A core that is not deterministic: one cell by the order of a hash map, one header by the time of day.
#[tokio::test(flavor = "multi_thread")]
async fn planted_nondeterminism_is_named_by_sequence_layer_and_cell() {
    let folder = tempfile::tempdir().unwrap();
    let (whole, planted) = (folder.path().join("whole.mcap"), folder.path().join("planted.mcap"));
    recording(&whole).await;
    let (columns, mut changed) = (360, 0);
    copy(&whole, &planted, |topic, sequence, data| {
        let mut map = match (topic, sequence) {
            ("/car/map/drivability", 1) | ("/car/map/terrain", 3) => v1::Map::decode(&data[..]).unwrap(),
            _ => return Some(data),
        };
        if sequence == 3 {
            map.header.as_mut().unwrap().completed_ns = clearway_daemon::base::clock::now_ns();
            return Some(map.encode_to_vec());
        }
        let channel = &mut map.layers[0].channels[0];
        let Cells::U8(mut cells) = decode(channel, columns, &Limits::default()).unwrap() else {
            panic!("classes are u8")
        };
        let seen: HashMap<usize, u8> = cells.iter().copied().enumerate().filter(|(_, class)| *class > 0).collect();
        changed = *seen.keys().next().expect("a seen cell");
        cells[changed] = 0;
        let v1::Channel { name, unit, scale, unknown, .. } = channel.clone();
        *channel = encode_grid(CellsRef::U8(&cells), columns).into_channel(&name, &unit, scale, unknown);
        Some(map.encode_to_vec())
    });
    let report = verify(&planted).unwrap();
    let found: Vec<String> = report.differences.iter().map(ToString::to_string).collect();
    let cell = format!("sequence 1, layer drivability: cell row {} column {}, ", changed / columns, changed % columns);
    assert!(report.different == 2 && found[0].contains(&cell), "{found:?}, planted in cell {changed}");
    assert!(found[1].contains("sequence 3, layer terrain: header completed_ns: "), "{found:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn verify_names_a_missing_map_a_changed_header_and_a_journal_gap() {
    let folder = tempfile::tempdir().unwrap();
    let (whole, changed_copy) = (folder.path().join("whole.mcap"), folder.path().join("changed_copy.mcap"));
    recording(&whole).await;

    // By the recorder's counts it is lost from the file; without them the run may have made none.
    let lost = |topic: &str, sequence| topic == "/car/map/drivability" && sequence == 1;
    copy(&whole, &changed_copy, |topic, sequence, data| (!lost(topic, sequence)).then_some(data));
    let report = verify(&changed_copy).unwrap();
    assert_eq!((report.different, report.unjudged), (0, 1));
    assert!(report.incomplete.unwrap_or_default().contains("1 message of /car/map/drivability"));
    copy(&whole, &changed_copy, |topic, sequence, data| {
        (!lost(topic, sequence) && topic != "/recorder/counts").then_some(data)
    });
    let report = verify(&changed_copy).unwrap();
    assert_eq!((report.different, &report.differences[0].kind), (1, &DifferenceKind::Missing));
    assert_eq!(report.differences[0].sequence, 1);
    copy(&whole, &changed_copy, |topic, _, data| topic.contains("/map/").then_some(data));
    let report = verify(&changed_copy).unwrap();
    assert!(report.unjudged > 0 && report.different == 0 && !report.is_good(), "maps without events: {report:?}");

    copy(&whole, &changed_copy, |topic, sequence, data| {
        if topic != "/car/map/height_difference" || sequence != 0 {
            return Some(data);
        }
        let mut map = v1::Map::decode(&data[..]).unwrap();
        map.header.as_mut().unwrap().capture_end_ns += 1;
        Some(map.encode_to_vec())
    });
    let report = verify(&changed_copy).unwrap();
    let DifferenceKind::Field { field, .. } = &report.differences[0].kind else { panic!("{:?}", report.differences) };
    assert_eq!((report.different, field.as_str()), (1, "header capture_end_ns"));

    copy(&whole, &changed_copy, |topic, sequence, data| (topic != "/car/journal" || sequence != 40).then_some(data));
    let whole_events = verify(&whole).unwrap().events;
    let report = verify(&changed_copy).unwrap();
    let incomplete = report.incomplete.unwrap_or_default();
    assert_eq!((report.different, report.events), (0, whole_events - 1));
    assert!(incomplete.contains("event 41 of /car/journal stands in the place of event 40"), "{incomplete}");
    assert!(incomplete.contains("lost in all, by its own count: 1 message of /car/journal"), "{incomplete}");

    let is_lost = |topic: &str, sequence| topic == "/car/journal" && (40..160).contains(&sequence);
    copy(&whole, &changed_copy, |topic, sequence, data| (!is_lost(topic, sequence)).then_some(data));
    let (all, report) = (verify(&whole).unwrap().equal, verify(&changed_copy).unwrap());
    assert!(report.unjudged > 0, "a revolution is lost: {report:?}");
    assert_eq!((report.different, report.equal + report.unjudged), (0, all), "each recorded layer counts once");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_truncated_recording_is_read_to_its_last_whole_chunk() {
    let folder = tempfile::tempdir().unwrap();
    let (whole, cut) = (folder.path().join("whole.mcap"), folder.path().join("cut.mcap"));
    recording(&whole).await;
    let bytes = std::fs::read(&whole).unwrap();
    let events_in = |length: usize| {
        std::fs::write(&cut, &bytes[..length]).unwrap();
        verify(&cut).map(|report| (report.is_good(), report.cut, report.events))
    };
    let all = verify(&whole).unwrap().events;
    let mut most = 0;
    for percent in [60, 75, 90, 99] {
        let (good, is_cut, events) = events_in(bytes.len() * percent / 100).unwrap();
        assert!(good == (events > 0) && is_cut && events <= all, "{percent} %: {events} of {all}");
        most = most.max(events);
    }
    assert!(most > 0, "whole chunks before the cut are read");
    assert!(matches!(events_in(3), Err(clearway_journal::verify::VerifyError::Recording(_))));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_recording_has_the_configuration_and_calibration_of_its_maps() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("whole.mcap");
    recording(&file).await;
    let recording = RecordingReader::open(&file).unwrap();
    let notes: &BTreeMap<String, String> = &recording.header().metadata;
    assert_eq!(notes["vehicles"], "car");
    assert_eq!(notes["boot_id"], recording.header().boot_id.to_string());
    assert!(notes["calibration/car/top"].contains("factory"), "{notes:?}");
    let (config, tables) = run_config(&recording).unwrap();
    assert_eq!(config.vehicles, fixture::config().vehicles);
    assert_eq!(tables, [[None]]);
}

#[test]
fn an_mcap_file_without_a_configuration_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("foreign.mcap");
    mcap::Writer::new(BufWriter::new(File::create(&file).unwrap())).unwrap().finish().unwrap();
    let error = verify(&file).unwrap_err();
    assert!(
        matches!(error, clearway_journal::verify::VerifyError::Recording(RecordingError::NoConfig { .. })),
        "{error}"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn changed_bytes_cause_no_panic_and_no_additional_event() {
    use proptest::prelude::*;
    use proptest::test_runner::TestRunner;
    let folder = tempfile::tempdir().unwrap();
    let (whole, changed) = (folder.path().join("whole.mcap"), folder.path().join("changed.mcap"));
    recording(&whole).await;
    let bytes = std::fs::read(&whole).unwrap();
    let events = verify(&whole).unwrap().events;
    let changes = prop::collection::vec((0..bytes.len(), any::<u8>()), 1..4);
    let mut runner = TestRunner::new(ProptestConfig { cases: 60, ..ProptestConfig::default() });
    runner
        .run(&(changes, 0..bytes.len() / 4), |(changes, missing)| {
            let mut bytes = bytes.clone();
            for (at, byte) in changes {
                bytes[at] = byte;
            }
            bytes.truncate(bytes.len() - missing);
            std::fs::write(&changed, &bytes).unwrap();
            // The recording may be read, refused or found different; it must not cause a panic.
            if let Ok(report) = verify(&changed) {
                prop_assert!(report.events <= events, "{report:?}");
            }
            Ok(())
        })
        .unwrap();
}

/// Starts a server in its own process that records to `file`; returns its data address too.
fn serving(folder: &Path, file: &Path) -> (std::process::Child, SocketAddr) {
    let free = || std::net::UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let data = free();
    let mut config = config();
    (config.grpc.enabled, config.page.enabled, config.zenoh.enabled) = (false, false, false);
    // The path is relative to the folder of the configuration.
    config.recorder.file = file.file_name().unwrap().into();
    config.recorder.flush_ms = 50;
    let udp = config.vehicles[0].udp.as_mut().unwrap();
    (udp.data, udp.telemetry) = (data, free());
    let path = folder.join("clearway.toml");
    std::fs::write(&path, config.to_toml()).unwrap();
    let server = std::process::Command::new(clearway_tests::binaries().join("clearway"))
        .args(["serve", "--config"])
        .arg(&path)
        .stderr(std::process::Stdio::null())
        .spawn()
        .unwrap();
    (server, data)
}

/// Sends the vehicle's data until the recording has grown to `bytes`.
fn drive_until(file: &Path, bytes: u64, data: SocketAddr) {
    let socket = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    let payloads = readings(10).into_iter().filter_map(|reading| match reading.body {
        Body::Datagram(payload) if payload.len() == 1206 => Some(payload),
        _ => None,
    });
    let payloads: Vec<_> = payloads.collect();
    for payload in payloads.iter().cycle() {
        // A server that has not started yet refuses; it receives the next revolution.
        let _ = socket.send_to(payload, data);
        if file.metadata().is_ok_and(|metadata| metadata.len() > bytes) {
            return;
        }
        std::thread::sleep(std::time::Duration::from_millis(2));
    }
}

#[test]
fn a_signal_that_ends_programs_leaves_a_whole_recording_and_sigkill_a_readable_one() {
    let folder = tempfile::tempdir().unwrap();
    for (signal, cut) in [("-TERM", false), ("-USR1", false), ("-KILL", true)] {
        let file = folder.path().join(format!("live{signal}.mcap"));
        let (mut server, data) = serving(folder.path(), &file);
        drive_until(&file.with_extension("unfinished.mcap"), 1_000_000, data);
        let killed = std::process::Command::new("kill").args([signal, &server.id().to_string()]).status().unwrap();
        assert!(killed.success());
        let ended = server.wait().unwrap();
        assert_eq!(ended.success(), !cut, "{signal}: {ended}");
        let left = if cut { file.with_extension("unfinished.mcap") } else { file };
        let report = verify(&left).unwrap();
        assert!(report.is_good() && report.events > 0 && report.cut == cut, "{signal}: {report:?}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn an_address_in_use_is_refused_and_the_old_recording_is_kept() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("earlier.mcap");
    std::fs::write(&file, b"what was recorded before").unwrap();
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let in_use = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    let (tcp, udp) = (taken.local_addr().unwrap(), in_use.local_addr().unwrap());
    // No other test uses this address, so its port stays free until this test uses it.
    let free = std::net::TcpListener::bind("127.0.0.77:0").unwrap().local_addr().unwrap();
    type Take = fn(&mut Config, SocketAddr);
    let wrong: [(&str, SocketAddr, Take); 5] = [
        ("grpc.listen", tcp, |config, at| config.grpc.listen = at),
        ("page.listen", tcp, |config, at| (config.page.enabled, config.page.listen) = (true, at)),
        ("vehicle car", udp, |config, at| config.vehicles[0].udp.as_mut().unwrap().data = at),
        ("foxglove.listen", tcp, |config, at| config.foxglove.listen = at),
        ("zenoh", tcp, |config, at| {
            (config.zenoh.enabled, config.zenoh.listen) = (true, vec![format!("tcp/{at}")]);
        }),
    ];
    for (key, at, take) in wrong {
        let mut config = config();
        (config.foxglove.enabled, config.foxglove.listen) = (true, free);
        config.recorder.file.clone_from(&file);
        take(&mut config, at);
        let setup = Setup { config, from_files: true, ..Setup::default() };
        let error = within("a refusal", Server::start(setup)).await.err().expect(key).to_string();
        assert!(error.contains(key) && error.contains(&at.port().to_string()), "{key}: {error}");
        assert_eq!(std::fs::read(&file).unwrap(), b"what was recorded before", "{key}");
        // Foxglove's task releases the port shortly after it stops.
        until("nothing left running", || std::net::TcpListener::bind(free).is_ok()).await;
    }
}

#[test]
fn a_full_disk_ends_the_recording_and_maps_continue() {
    let _ports = clearway_tests::serial::DEFAULT_PORTS.enter();
    let folder = tempfile::tempdir().unwrap();
    // No file of this process may grow beyond 1.5 MiB, a few chunks; the write fails instead of the process.
    let limited = "trap '' XFSZ; ulimit -f 3072; exec \"$0\" demo --seconds 4 --record \"$1/full.mcap\"";
    maps_continue_on_a_full_disk(std::process::Command::new("sh").args(["-c", limited]), folder.path(), "too large");
}

#[test]
#[cfg_attr(not(clearway_deploy), ignore = "needs the tools that .ci/run installs")]
fn a_full_file_system_ends_the_recording_and_maps_continue() {
    let folder = tempfile::tempdir().unwrap();
    // A file system in memory of 1.5 MiB, which is gone with the process; so the recording is copied from it. The
    // network is another network too, because every demo has the same ports. The demo's picture cannot be written
    // either: a folder has its name.
    let mounted = "mkdir \"$1/small\" && mount -t tmpfs -o size=1536k none \"$1/small\" && ip link set lo up || exit 9
        mkdir \"$1/small/full.png.part\"
        \"$0\" demo --seconds 4 --record \"$1/small/full.mcap\"
        code=$?
        df --output=avail \"$1/small\" >&2
        cp \"$1\"/small/*.mcap \"$1\"
        exit $code";
    let mut command = std::process::Command::new("unshare");
    command.args(["--mount", "--net", "sh", "-c", mounted]);
    let complained = maps_continue_on_a_full_disk(&mut command, folder.path(), "No space left");
    assert!(complained.contains("full.png: Is a directory"), "{complained}");
}

/// Runs the demo by `command`, which gets the program and a folder, and records to a disk that becomes full; returns
/// what it said on the standard error.
fn maps_continue_on_a_full_disk(command: &mut std::process::Command, folder: &Path, reason: &str) -> String {
    let file = folder.join("full.mcap");
    let output = command.arg(clearway_tests::binaries().join("clearway")).arg(folder).output().unwrap();
    let (said, complained) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(!output.status.success(), "an incomplete recording is no success");
    assert!(complained.contains("the recording is incomplete") && complained.contains(reason), "{complained}");
    let revolutions = |line: &str| line.split_once(" revolutions")?.0.split_whitespace().last()?.parse::<u64>().ok();
    let mapped: Vec<u64> = said.lines().filter_map(revolutions).collect();
    assert!(mapped.len() > 1 && mapped.last() > mapped.first(), "maps are made after the disk has failed: {said}");
    let report = verify(&file.with_extension("unfinished.mcap")).unwrap();
    assert!(report.is_good() && report.cut, "what was recorded before is good: {report:?}");
    complained.into_owned()
}

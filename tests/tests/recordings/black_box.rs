//! The recorder when something goes wrong: the last seconds are saved by a rule and on request, and a disk that fails
//! costs what it must and no more.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Write;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime};

use clearway_daemon::config::{Recorder, SaveRule, Sender};
use clearway_daemon::ingest::queue::Reading;
use clearway_daemon::record::verify;
use clearway_daemon::record::writer::{Files, RecordingWriter};
use clearway_daemon::run::{Running, Server, Setup};
use clearway_daemon::store::index::Entry;
use clearway_daemon::traces::Traces;
use clearway_journal::encode::EncodedMap;
use clearway_journal::mcap_file::{Disk, RecordingHeader as Header};
use clearway_journal::mcap_reader::McapReader;
use clearway_journal::reader::{RecordedMessage, RecordingReader};
use clearway_lidar::model::Model;
use clearway_mapping::config::SensorConfig;
use clearway_mapping::event::{Body, Event};
use clearway_mapping::pipeline::{Pipeline, layer_names};
use clearway_proto::v1;
use clearway_proto::v1::recording_service_client::RecordingServiceClient;
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::flat;
use clearway_sim::vehicle::SimulatedVehicle;
use tonic::transport::Channel;

use crate::fixture::{Driving, config, readings, until, with_short_warm_up, within};

async fn service(running: &Running) -> RecordingServiceClient<Channel> {
    let address = format!("http://{}", running.grpc.expect("gRPC is served"));
    RecordingServiceClient::connect(address).await.expect("gRPC answers")
}

/// The sequences of the events of a recording.
fn events(file: &Path) -> BTreeSet<u64> {
    let messages = RecordingReader::open(file).unwrap().filter_map(|message| match message.unwrap() {
        RecordedMessage::Event { event, .. } => Some(event.sequence),
        _ => None,
    });
    messages.collect()
}

/// The names of the saves beside a recording.
fn saves(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder.join("saved")).into_iter().flatten();
    entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect()
}

/// Milliseconds since the Unix epoch.
fn now_ms() -> u128 {
    SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap().as_millis()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn the_last_seconds_are_saved_when_the_maps_become_stale_and_on_request() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = with_short_warm_up(config());
    config.recorder.file = folder.path().join("car.mcap");
    config.recorder.save_on = vec![SaveRule::MapStale];
    // So that a busy test machine makes no map stale while the vehicle drives.
    config.vehicles[0].maps.valid_ms = 5000;
    let running = Server::start(Setup { config, ..Setup::default() }).await.expect("the server starts");
    let driving = Driving::to(&running);
    let status = running.vehicles.0[0].status.clone();
    until("ten maps", || status.snapshot().maps >= 10).await;
    let asked_ms = now_ms();
    let save = v1::SaveRecordingRequest { seconds: 5, reason: "button".into() };
    let saved = service(&running).await.save(save).await.unwrap().into_inner().files;
    println!("a request is answered, with its files on the disk, after {} ms", now_ms() - asked_ms);
    assert!(saves(folder.path()).len() == 1 && saved[0].contains("button"), "{saved:?}");
    driving.halt();
    let is_stale = |name: &String| name.ends_with("map-stale");
    until("the rule saves", || saves(folder.path()).iter().any(is_stale)).await;
    let stale_ms = status.snapshot().newest_capture_end_ns as u128 / 1_000_000 + 5000;
    let save = saves(folder.path()).into_iter().find(is_stale).expect("it was just there");
    let saved_ms: u128 = save.split('-').next().unwrap().parse().unwrap();
    println!("saved {} ms after the newest map had become stale", saved_ms - stale_ms);
    within("shutdown", running.shutdown()).await.unwrap();
    for file in std::fs::read_dir(folder.path().join("saved").join(save)).unwrap() {
        let report = verify(&file.unwrap().path()).unwrap();
        assert!(report.is_good() && report.is_closed, "{report:?}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn the_last_seconds_are_saved_when_one_of_two_sensors_is_lost() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = with_short_warm_up(config());
    config.recorder.file = folder.path().join("car.mcap");
    config.recorder.save_on = vec![SaveRule::SensorLost];
    let vehicle = &mut config.vehicles[0];
    let rear = SensorConfig { name: "rear".into(), ..vehicle.sensors[0].clone() };
    vehicle.sensors.push(rear);
    let senders: [SocketAddr; 2] = ["127.0.0.2:0", "127.0.0.3:0"].map(|at| at.parse().unwrap());
    let names = vehicle.sensors.iter().map(|sensor| sensor.name.clone());
    vehicle.udp.as_mut().unwrap().from =
        names.zip(senders).map(|(name, at)| (name, Sender::Address(at.ip()))).collect();
    let running = Server::start(Setup { config, ..Setup::default() }).await.expect("the server starts");
    let vlp16 = || {
        let config = ScannerConfig { model: Model::Vlp16, ..ScannerConfig::default() };
        SimulatedVehicle::new(flat(), config)
    };
    let [top, rear] = senders.map(|sender| Driving::with(vlp16(), sender, &running));
    let status = running.vehicles.0[0].status.clone();
    let are_in_maps = || {
        let sensors = status.to_proto().sensors;
        sensors.len() == 2 && sensors.iter().all(|sensor| sensor.state == "ok")
    };
    until("maps of both sensors", are_in_maps).await;
    // The rule looks twice a second, and must have seen both: that is longer than ten revolutions take.
    let maps = status.snapshot().maps;
    until("the rule has seen them", || status.snapshot().maps >= maps + 15).await;
    assert_eq!(saves(folder.path()), [""; 0], "nothing is lost yet");
    rear.halt();
    until("the rule saves", || !saves(folder.path()).is_empty()).await;
    top.halt();
    within("shutdown", running.shutdown()).await.unwrap();
    let [save] = &saves(folder.path())[..] else { panic!("{:?}", saves(folder.path())) };
    assert!(save.ends_with("rear-lost"), "{save}");
    for file in std::fs::read_dir(folder.path().join("saved").join(save)).unwrap() {
        let report = verify(&file.unwrap().path()).unwrap();
        assert!(report.is_good() && report.is_closed, "{report:?}");
    }
}

/// A disk in memory that creates files, and returns an error to every other call while it is `failing`. Its files are
/// whole as they are.
#[derive(Clone, Default)]
struct FailingDisk {
    failing: Arc<AtomicBool>,
    files: Arc<Mutex<BTreeMap<u64, Vec<u8>>>>,
}

impl FailingDisk {
    fn check(&self) -> std::io::Result<()> {
        let fails = self.failing.load(Ordering::Relaxed);
        if fails { Err(std::io::Error::other("the disk fails")) } else { Ok(()) }
    }
}

/// One of its files.
struct FailingFile(FailingDisk, u64);

impl Files for FailingDisk {
    type File = FailingFile;

    fn create(&mut self, part: u64) -> std::io::Result<FailingFile> {
        self.files.lock().unwrap().insert(part, Vec::new());
        Ok(FailingFile(self.clone(), part))
    }

    fn discard(&mut self, part: u64) -> std::io::Result<()> {
        self.files.lock().unwrap().remove(&part).map(drop).ok_or(std::io::ErrorKind::NotFound.into())
    }

    fn complete(&mut self, _: u64) -> std::io::Result<()> {
        self.check()
    }

    fn path(&self, part: u64) -> PathBuf {
        format!("part-{part}").into()
    }
}

impl Write for FailingFile {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.check()?;
        self.0.files.lock().unwrap().get_mut(&self.1).unwrap().extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

impl Disk for FailingFile {
    fn sync(&mut self) -> std::io::Result<()> {
        self.0.check()
    }
}

#[test]
fn a_disk_that_fails_for_a_minute_costs_that_minute_and_a_warm_up_and_each_loss_is_counted() {
    let (config, disk) = (with_short_warm_up(config()), FailingDisk::default());
    let core = config.vehicles[0].core();
    let options = Recorder { warm_up_ms: 2000, ..Recorder::default() };
    let header = Header { vehicles: vec![("car".into(), vec![])], config: config.to_toml(), ..Header::default() };
    let began = Instant::now();
    let (mut writer, mut handles) = RecordingWriter::new(disk.clone(), &options, &header, false, began).unwrap();
    let (counts, mut pipeline) = (writer.counts(), Pipeline::new(&core, vec![None]).unwrap());
    let handle = &mut handles[0];
    handle.set_config(core, vec![None]);
    let mut durable = 0;
    // Ten events a second for two minutes; the disk fails from the 30th second to the 90th.
    for sequence in 0..1200 {
        let now = Duration::from_millis(100 * sequence);
        disk.failing.store((300..900).contains(&sequence), Ordering::Relaxed);
        if sequence == 300 {
            durable = counts.durable_events("car");
        }
        if sequence == 600 {
            // Many attempts to begin a part have failed meanwhile.
            assert!(counts.problem().unwrap().contains("the disk fails"), "{:?}", counts.problem());
        }
        let arrival_ns = 1_700_000_000_000_000_000 + now.as_nanos() as i64;
        let event = Event { sequence, arrival_ns, source: 0, body: Body::Datagram(vec![7; 100].into()) };
        handle.record_event(&event);
        let _ = pipeline.step(&event);
        handle.keep_up(&event, &mut pipeline);
        while writer.write_next(began + now) {}
    }
    drop(handles);
    writer.finish();
    let status = counts.to_proto();
    let journal = &status.topics[0];
    assert_eq!((journal.offered, journal.written + journal.dropped), (1200, 1200), "{journal:?}");
    // A second before the failure that was not synced, the minute, a second until the next attempt, and what was
    // recorded for the warm-up alone is there twice.
    assert!((600..=640).contains(&journal.dropped), "{journal:?}");
    assert!(durable >= 285, "{durable} of 300");
    let folder = tempfile::tempdir().unwrap();
    let mut recorded = BTreeSet::new();
    for (part, bytes) in &*disk.files.lock().unwrap() {
        let file = folder.path().join(format!("{part}.mcap"));
        std::fs::write(&file, bytes).unwrap();
        if bytes.len() > 100 {
            recorded.extend(events(&file));
        }
    }
    assert_eq!(disk.files.lock().unwrap().len(), 2, "an attempt that fails leaves no file");
    let missing = (0..1200).filter(|sequence| !recorded.contains(sequence)).collect::<Vec<u64>>();
    assert!((0..durable).all(|sequence| recorded.contains(&sequence)), "no durable event is lost: {missing:?}");
    let (first, last) = (missing[0], missing[missing.len() - 1]);
    assert!(first >= durable && (890..915).contains(&last), "missing from {first} to {last}");
    println!("lost {} of 1200 events: {first} to {last}; the disk failed from 300 to 899", missing.len());
}

#[test]
fn each_message_also_of_a_silent_van_has_a_time_of_the_drive_and_a_chunk_half_a_second_of_it() {
    let (config, disk) = (with_short_warm_up(config()), FailingDisk::default());
    let core = config.vehicles[0].core();
    let options = Recorder { part_s: 2, warm_up_ms: 0, flush_ms: 60_000, ..Recorder::default() };
    let vehicles = ["car", "van"].map(|name| (name.into(), vec![])).into();
    let header = Header { vehicles, config: config.to_toml(), ..Header::default() };
    let began = Instant::now();
    let (mut writer, mut handles) = RecordingWriter::new(disk.clone(), &options, &header, false, began).unwrap();
    let mut pipelines = [(); 2].map(|()| Pipeline::new(&core, vec![None]).unwrap());
    handles.iter_mut().for_each(|handle| handle.set_config(core.clone(), vec![None]));
    let start_ns = 1_700_000_000_000_000_000;
    for sequence in 0..100 {
        let now = Duration::from_millis(100 * sequence);
        let arrival_ns = start_ns + now.as_nanos() as i64;
        let event = Event { sequence, arrival_ns, source: 0, body: Body::Datagram(vec![7; 100].into()) };
        handles[0].record_event(&event);
        handles[0].keep_up(&event, &mut pipelines[0]);
        handles[1].idle(&mut pipelines[1]);
        while writer.write_next(began + now) {}
    }
    drop(handles);
    writer.finish();
    let drive = start_ns as u64..=start_ns as u64 + 10_000_000_000;
    let (files, mut keyframes, mut chunks) = (disk.files.lock().unwrap(), 0, 0);
    for bytes in files.values() {
        for message in mcap::MessageStream::new(bytes).unwrap() {
            let message = message.unwrap();
            assert!(drive.contains(&message.log_time), "{} of {}", message.log_time, message.channel.topic);
            keyframes += u64::from(message.channel.topic == "/van/keyframe");
        }
        let of_file = mcap::Summary::read(bytes).unwrap().expect("a closed file").chunk_indexes;
        assert!(of_file.iter().all(|of| of.message_end_time - of.message_start_time <= 500_000_000), "{of_file:?}");
        chunks += of_file.len();
    }
    assert!(files.len() >= 4 && keyframes >= 2 && chunks >= 20, "{} parts, {keyframes}, {chunks}", files.len());
}

#[test]
fn each_event_is_durable_within_flush_ms_if_a_sync_takes_no_more_than_half_of_it() {
    let (config, disk) = (with_short_warm_up(config()), FailingDisk::default());
    let options = Recorder { flush_ms: 1000, ..Recorder::default() };
    let header = Header { vehicles: vec![("car".into(), vec![])], config: config.to_toml(), ..Header::default() };
    let began = Instant::now();
    let (mut writer, mut handles) = RecordingWriter::new(disk, &options, &header, false, began).unwrap();
    let counts = writer.counts();
    // An event comes each 20 ms, then none for three seconds, then as before. A sync takes 480 ms: the recorder works
    // again after that time, and takes what came meanwhile from its queue.
    let sync_ms = 480;
    let comes_ms: Vec<u64> = (0..5_000).chain(8_000..13_000).step_by(20).collect();
    let (mut came, mut durable, mut works_ms, mut oldest_ms) = (0, 0, 0, 0);
    for ms in 0..14_000 {
        while came < comes_ms.len() && comes_ms[came] <= ms {
            let arrival_ns = 1_700_000_000_000_000_000 + 1_000_000 * comes_ms[came] as i64;
            let event = Event { sequence: came as u64, arrival_ns, source: 0, body: Body::Datagram(vec![7; 9].into()) };
            handles[0].record_event(&event);
            came += 1;
        }
        if ms < works_ms {
            continue;
        }
        // Item after item, until a sync takes the recorder's time.
        while writer.write_next(began + Duration::from_millis(ms)) && counts.durable_events("car") == durable {}
        for event in durable..counts.durable_events("car") {
            works_ms = ms + sync_ms;
            oldest_ms = oldest_ms.max(works_ms - comes_ms[event as usize]);
        }
        durable = counts.durable_events("car");
    }
    assert_eq!((came, durable), (comes_ms.len(), came as u64), "all are on the disk");
    assert!(oldest_ms <= options.flush_ms, "an event was on the disk after {oldest_ms} ms");
    drop(handles);
    writer.finish();
}

#[test]
fn of_what_a_slow_disk_does_not_take_each_topic_counts_the_same_live_and_in_the_file() {
    let (config, disk) = (with_short_warm_up(config()), FailingDisk::default());
    let core = config.vehicles[0].core();
    let options = Recorder { warm_up_ms: 500, queue: 100, ..Recorder::default() };
    let mut pipeline = Pipeline::new(&core, vec![None]).unwrap();
    let vehicles = vec![("car".into(), layer_names(&core.maps))];
    let header = Header { vehicles, config: config.to_toml(), ..Header::default() };
    let began = Instant::now();
    let (mut writer, mut handles) = RecordingWriter::new(disk.clone(), &options, &header, false, began).unwrap();
    let (counts, handle) = (writer.counts(), &mut handles[0]);
    handle.set_config(core, vec![None]);
    let (all, traces) = (readings(30), Traces::default());
    let start_ns = all[0].arrival_ns;
    for (sequence, Reading { arrival_ns, source, body }) in (0..).zip(all) {
        let now = Duration::from_nanos((arrival_ns - start_ns) as u64);
        let event = Event { sequence, arrival_ns, source, body };
        handle.record_event(&event);
        if let Ok(Some(map)) = pipeline.step(&event) {
            let map = Arc::new(EncodedMap::new(map, "car".into(), 0, 300));
            handle.record_map(&map, traces.hop(&map, "record", None));
        }
        handle.keep_up(&event, &mut pipeline);
        // In the second second the disk takes one message of four.
        let is_slow = (1000..2000).contains(&now.as_millis());
        if !is_slow || sequence % 4 == 0 {
            while writer.write_next(began + now) && !is_slow {}
        }
    }
    drop(handles);
    writer.finish();
    let live = counts.topic_counts();
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("slow.mcap");
    std::fs::write(&file, &disk.files.lock().unwrap()[&1]).unwrap();
    let (mut messages, mut last) = (BTreeMap::<String, u64>::new(), None);
    for message in McapReader::open(&file).unwrap() {
        *messages.entry(message.unwrap().channel.topic.clone()).or_default() += 1;
    }
    for message in RecordingReader::open(&file).unwrap() {
        if let RecordedMessage::Counts(counts) = message.unwrap() {
            last = Some(counts);
        }
    }
    let in_file = last.expect("the file ends with its counts");
    assert!(in_file.closed && in_file.reason.contains("queue was full"), "{in_file:?}");
    assert!(live.iter().all(|topic| topic.dropped > 0), "events and maps are lost: {live:?}");
    assert_eq!(live.len(), in_file.topics.len());
    for (live, in_file) in live.iter().zip(&in_file.topics) {
        assert_eq!(live, in_file);
        assert_eq!(live.offered, live.written + live.dropped, "{live:?}");
        assert_eq!(messages[&live.topic], live.written, "{live:?}");
    }
    live.iter().for_each(|topic| println!("{topic:?}"));
    let entries = Entry::of_part(&file, 0, 0).unwrap();
    assert!(entries[0].faults.iter().any(|fault| fault.contains("dropped: the recorder's queue was full")));
    let report = verify(&file).unwrap();
    assert!(report.equal > 0 && report.dropped > 0 && !report.is_good(), "{report:?}");
}

#[test]
fn a_part_without_a_message_gets_no_successor() {
    let disk = FailingDisk::default();
    let options = Recorder { part_s: 1, ..Recorder::default() };
    let header = Header { vehicles: vec![("car".into(), vec![])], config: config().to_toml(), ..Header::default() };
    let began = Instant::now();
    let (mut writer, mut handles) = RecordingWriter::new(disk.clone(), &options, &header, false, began).unwrap();
    let parts = || disk.files.lock().unwrap().len();
    for second in 0..3600 {
        writer.write_next(began + Duration::from_secs(second));
    }
    assert_eq!(parts(), 1, "an hour without data is one file");
    handles[0].record_event(&Event { sequence: 0, arrival_ns: 1, source: 0, body: Body::End });
    for second in 3600..3602 {
        writer.write_next(began + Duration::from_secs(second));
    }
    assert_eq!(parts(), 2, "the time counts from the first message");
    writer.finish();
    assert_eq!(parts(), 1, "a part that no vehicle has begun holds nothing that the part before it lacks");
}

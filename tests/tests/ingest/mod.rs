//! Scans, poses, roads and tunnelled packets over the network: the maps are the same as from files, and every refused
//! observation has a reason.

mod many;
mod plans;
mod refused;
mod ros;
mod silent_peer;
mod two_senders;
mod udp;
mod zenoh_flood;

use std::collections::BTreeMap;
use std::path::Path;

use bytes::Bytes;
use clearway_client::observation::{RoadFrame, RoadPurpose, Sensor, by_reason};
use clearway_client::{Client, ClientError, Ingester, Observation, Refusal, ZenohClient, now_ns};
use clearway_daemon::config::Config;
use clearway_daemon::ingest::queue::Reading;
use clearway_daemon::record::verify;
use clearway_daemon::run::{Running, Server, Setup};
use clearway_lidar::model::Model;
use clearway_mapping::event::Body;
use clearway_proto::packed::{pack, unpack};
use clearway_proto::v1::{self, ingest_service_client::IngestServiceClient};
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::town;
use clearway_sim::vehicle::SimulatedVehicle;
use prost::Message;

use crate::fixture::{self, config, feed, readings, recorded, until, within};

/// A server with a boot id that two runs have in common, recording to `file`.
async fn start(mut config: Config, file: &Path) -> Running {
    config.recorder.file = file.to_owned();
    let setup = Setup { config, from_files: true, boot_id: Some(7), ..Setup::default() };
    Server::start(setup).await.expect("the server starts")
}

async fn client(running: &Running) -> Client {
    Client::connect(&running.grpc.expect("gRPC is served").to_string()).await.expect("gRPC answers")
}

async fn ingester(running: &Running) -> Ingester {
    within("a stream", client(running).await.ingest("car")).await.expect("the car is known")
}

/// Sends all observations from a task of their own, as a program with several sensors does; returns the refusals.
async fn send_all_from_a_task(mut ingester: Ingester, observations: Vec<Observation>) -> (Ingester, Vec<Refusal>) {
    let sent = tokio::spawn(async move {
        let refusals = send_all(&mut ingester, observations).await;
        (ingester, refusals)
    });
    sent.await.expect("no panic")
}

/// Sends all observations; returns the refusals.
async fn send_all(ingester: &mut Ingester, observations: Vec<Observation>) -> Vec<Refusal> {
    for observation in observations {
        within("capacity", ingester.send(observation)).await.expect("the stream is open");
    }
    within("outcomes", ingester.settled()).await.expect("the stream is open")
}

/// A scan of a plain.
fn plain(stamp_ns: i64) -> v1::Scan {
    let rays = 0..7200_u32;
    let place = |ray: u32| (f64::from(ray) * 0.05_f64.to_radians(), 3.0 + f64::from(ray % 20) * 1.5);
    let list = |of: &dyn Fn(f64, f64) -> f64| -> Vec<f32> {
        rays.clone().map(place).map(|(angle, range_m)| of(angle, range_m) as f32).collect()
    };
    let (x, y) = (list(&|angle, range_m| angle.cos() * range_m), list(&|angle, range_m| angle.sin() * range_m));
    v1::Scan { stamp_ns, x: pack(&x), y: pack(&y), z: pack(&list(&|_, _| -1.9)), ..Default::default() }
}

fn scan(number: u64, scan: v1::Scan) -> v1::Observation {
    let body = Some(v1::observation::Body::Scan(scan));
    v1::Observation { number, captured_ns: 1_000_000_000, body, ..Default::default() }
}

/// Sends raw observations in one stream; returns every report and the stream's final status.
async fn reports(running: &Running, sent: Vec<v1::Observation>) -> (Vec<v1::IngestReport>, Option<tonic::Status>) {
    let channel = tonic::transport::Channel::from_shared(format!("http://{}", running.grpc.unwrap())).unwrap();
    let mut client = IngestServiceClient::new(channel.connect().await.unwrap());
    let mut streamed = match within("an answer", client.stream(futures::stream::iter(sent))).await {
        Ok(streamed) => streamed.into_inner(),
        Err(status) => return (Vec::new(), Some(status)),
    };
    let mut reports = Vec::new();
    loop {
        match within("a report", streamed.message()).await {
            Ok(Some(report)) => reports.push(report),
            Ok(None) => return (reports, None),
            Err(status) => return (reports, Some(status)),
        }
    }
}

/// Datagrams as observations of `count` each.
fn tunnelled(readings: &[Reading], count: usize) -> Vec<Observation> {
    let packet = |reading: &Reading| match &reading.body {
        Body::Datagram(payload) => (reading.arrival_ns, payload.clone()),
        other => panic!("no datagram: {other:?}"),
    };
    let packets = |chunk: &[Reading]| Observation::packets("top", &chunk.iter().map(packet).collect::<Vec<_>>());
    readings.chunks(count).map(packets).collect()
}

/// Asserts that a drive makes the same maps from tunnelled packets as from a file; returns the number of maps.
async fn assert_tunnelled_makes_the_maps_of_the_file(config: Config, readings: Vec<Reading>) -> usize {
    let folder = tempfile::tempdir().unwrap();
    let (by_file, by_grpc) = (folder.path().join("file.mcap"), folder.path().join("grpc.mcap"));
    let end_ns = readings.last().expect("a drive").arrival_ns;
    let end = Reading { arrival_ns: end_ns, source: 0, body: Body::End };

    let running = start(config.clone(), &by_file).await;
    feed(&running, readings.clone()).await;
    let queue = running.inputs[0].queue.clone();
    tokio::task::spawn_blocking(move || queue.push_captured(end)).await.unwrap().unwrap();
    within("shutdown", running.shutdown()).await.unwrap();

    let running = start(config, &by_grpc).await;
    let mut ingester = ingester(&running).await;
    let mut observations = tunnelled(&readings, 97);
    observations.push(Observation::end("").captured_at(end_ns));
    assert_eq!(send_all(&mut ingester, observations).await, []);
    within("shutdown", running.shutdown()).await.unwrap();

    let maps = recorded(&by_file);
    assert!(recorded(&by_grpc) == maps, "the same bytes");
    let report = verify(&by_grpc).unwrap();
    assert!(report.is_good(), "{:?}", report.differences);
    maps.len()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_drive_tunnelled_over_grpc_makes_the_maps_of_the_file() {
    let maps = assert_tunnelled_makes_the_maps_of_the_file(config(), readings(5)).await;
    assert!(maps as u64 >= 5 * fixture::LAYERS, "{maps}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
async fn a_recorded_drive_tunnelled_over_grpc_makes_the_maps_of_the_file() {
    let file = Path::new(env!("CLEARWAY_DRIVES")).join("pcap/rust-lidar-utils/hdl32_example.pcap");
    let drive = clearway_replay::files::capture::Source::open(&file).unwrap();
    let readings: Vec<Reading> = drive.map(Result::unwrap).collect();
    assert_eq!(readings.len(), 976);
    let maps = assert_tunnelled_makes_the_maps_of_the_file(config(), readings).await;
    assert_eq!(maps as u64, 6 * fixture::LAYERS);
}

/// Configuration of a car in the town that sends each revolution as a scan; the speed map is on.
fn scanned_config() -> Config {
    let mut config = config();
    config.vehicles[0].udp = None;
    config.vehicles[0].maps.speed.enabled = true;
    config.vehicles[0].sensors[0].model = Some(Model::Hdl32e);
    config
}

/// Observations of `revolutions` revolutions: poses at 100 Hz, the road ahead, and each revolution as a scan with the
/// time of each point, or of each column.
fn scanned(revolutions: i64, by_column: bool) -> Vec<Observation> {
    let scanner = ScannerConfig { model: Model::Hdl32e, ..ScannerConfig::default() };
    let car = SimulatedVehicle::new(town(), scanner);
    let mut observations = Vec::new();
    for number in 1..=revolutions {
        let revolution = car.revolution(number);
        let end_ns = revolution.end_ns;
        let first_ns = end_ns - 100_000_000 + 10_000_000;
        for stamp_ns in (first_ns..=end_ns).step_by(10_000_000) {
            let pose = car.pose_at(stamp_ns);
            let (at, turned) = (pose.translation.vector, pose.rotation.coords);
            let turned = [turned.x, turned.y, turned.z, turned.w];
            let pose = Observation::pose(stamp_ns, at.into(), turned, car.speed_at(stamp_ns));
            observations.push(pose.captured_at(stamp_ns));
        }
        let points: Vec<[f64; 3]> = (0..12).map(|i| [f64::from(i) * 3.0, 0.0, 6.0]).collect();
        let road = Observation::road(end_ns, RoadPurpose::Paint, RoadFrame::Ego, &points);
        observations.push(road.captured_at(end_ns));

        let (mut x, mut y, mut z, mut intensity) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        let (mut rings, mut offsets_ns, mut columns) = (Vec::new(), Vec::new(), (Vec::new(), Vec::new()));
        let echo = &revolution.echoes[0];
        for (firing, when) in revolution.firings.iter().enumerate() {
            let offset_ns = i32::try_from(revolution.start_ns + i64::from(when.offset_ns) - end_ns).unwrap();
            let before = x.len();
            for slot in
                (firing * revolution.lasers..(firing + 1) * revolution.lasers).filter(|slot| echo.range_m[*slot] > 0.0)
            {
                x.push(echo.x[slot]);
                y.push(echo.y[slot]);
                z.push(echo.z[slot]);
                intensity.push(f32::from(echo.intensity[slot]) / 255.0);
                rings.push(u16::try_from(slot % revolution.lasers).unwrap());
                offsets_ns.push(offset_ns);
            }
            columns.0.push(offset_ns);
            columns.1.push(u16::try_from(x.len() - before).unwrap());
        }
        let scan = Observation::scan("top", end_ns, &x, &y, &z).intensity(&intensity).rings(&rings);
        let scan = if by_column { scan.columns(&columns.0, &columns.1) } else { scan.offsets_ns(&offsets_ns) };
        observations.push(scan.captured_at(end_ns));
    }
    observations
}

/// Maps of one layer in a recording, in order.
fn layer(maps: &BTreeMap<(u64, String), Bytes>, layer: &str) -> Vec<v1::Map> {
    let of = maps.iter().filter(|((_, name), _)| name == layer);
    of.map(|(_, bytes)| v1::Map::decode(bytes.clone()).unwrap()).collect()
}

/// Cells of class `road` on the vehicle's own lane.
fn road_cells(map: &v1::Map) -> u32 {
    let bytes = map.encode_to_vec();
    let view = clearway_client::MapView::decode(bytes.into()).unwrap();
    let speed = view.layer("speed").unwrap();
    (10..60).map(|half_m| u32::from(speed.class_at(f64::from(half_m) * 0.5, 0.0).1 == "road")).sum()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn scans_poses_and_roads_over_grpc_make_compensated_maps_with_the_road() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let revolutions = 4;
    for (file, by_column) in [("points.mcap", false), ("columns.mcap", true)] {
        let running = start(scanned_config(), &at(file)).await;
        let mut ingester = ingester(&running).await;
        assert_eq!(send_all(&mut ingester, scanned(revolutions, by_column)).await, []);
        let ledger = running.vehicles.0[0].status.snapshot().ledger;
        let taken = (ledger.decoded, ledger.poses, ledger.roads, ledger.received, ledger.lost);
        assert_eq!(taken, (4, 40, 4, 4, 0), "every acknowledged observation is counted: {ledger:?}");
        within("shutdown", running.shutdown()).await.unwrap();
        let report = verify(&at(file)).unwrap();
        assert!(report.is_good() && report.maps == 4 && report.events == 48, "{report:?}");
    }
    let maps = recorded(&at("points.mcap"));
    assert!(recorded(&at("columns.mcap")) == maps, "times by column give the same maps as times by point");
    let speed = layer(&maps, "speed");
    assert_eq!(speed.len(), 4);
    for map in &speed {
        let header = map.header.as_ref().unwrap();
        assert_eq!(header.compensation, "poses");
        assert!(header.map_from_ego.is_some() && header.speed_mps.unwrap() > 1.0, "{header:?}");
        assert!(road_cells(map) > 10, "{} cells of road ahead", road_cells(map));
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_sensor_declared_in_the_stream_is_mapped_and_recorded() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("r.mcap");
    let running = start(scanned_config(), &file).await;
    let sensor = Sensor { name: "left".into(), x_m: 1.0, y_m: 0.8, z_m: 1.9, yaw_deg: 90.0, ..Sensor::default() };
    let rays = |sensor: &str, stamp_ns: i64| {
        let v1::Scan { x, y, z, .. } = plain(stamp_ns);
        let [x, y, z] = [x, y, z].map(|list| unpack::<f32>(&list).unwrap());
        Observation::scan(sensor, stamp_ns, &x, &y, &z).captured_at(stamp_ns)
    };
    let declared = || Observation::declare(sensor.clone()).captured_at(1_000_000_000);
    let mut first = ingester(&running).await;
    let observations = vec![declared(), rays("left", 1_000_000_000), rays("top", 1_010_000_000)];
    assert_eq!(send_all(&mut first, observations).await, []);

    let mut second = ingester(&running).await;
    let moved = Observation::declare(Sensor { y_m: -0.8, ..sensor.clone() });
    let nowhere = Observation::declare(Sensor { name: "right".into(), z_m: f64::NAN, ..sensor.clone() });
    let strange = Observation::declare(Sensor { name: "up".into(), model: Some("ouster".into()), ..sensor.clone() });
    let refusals = send_all(&mut second, vec![declared(), moved, nowhere, strange, rays("left", 1_100_000_000)]).await;
    assert_eq!(by_reason(&refusals), [("missing", 1), ("sensor", 2)].into());
    assert!(refusals[0].message.contains("each sensor its own"), "{refusals:?}");
    assert!(refusals[1].message.contains("z_m"), "{refusals:?}");
    let snapshot = running.vehicles.0[0].status.snapshot();
    let names: Vec<_> = snapshot.sensors.iter().map(|sensor| sensor.name.as_str()).collect();
    assert_eq!(names, ["top", "left"]);
    assert_eq!((snapshot.ledger.decoded, snapshot.maps), (3, 1), "the scan of the reference sensor makes the map");
    within("shutdown", running.shutdown()).await.unwrap();
    let report = verify(&file).unwrap();
    assert!(report.is_good() && report.maps == 1, "{report:?}");
    let header = layer(&recorded(&file), "drivability")[0].header.clone().unwrap();
    assert_eq!(header.sensors.iter().map(|sensor| sensor.returns).collect::<Vec<_>>(), [7200, 7200]);
}

/// Names of the first vehicle's sensors.
fn sensors(running: &Running) -> Vec<String> {
    running.vehicles.0[0].status.snapshot().sensors.into_iter().map(|sensor| sensor.name).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn sensors_end_with_the_last_stream_that_declared_them_and_the_recording_replays() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("r.mcap");
    let running = start(scanned_config(), &file).await;
    let left = Sensor { name: "left".into(), x_m: 1.0, y_m: 0.8, z_m: 1.9, ..Sensor::default() };
    let declared = |sensor: &Sensor| Observation::declare(sensor.clone()).captured_at(1_000_000_000);
    let seen = |sensor: &str, stamp_ns: i64| {
        let v1::Scan { x, y, z, .. } = plain(stamp_ns);
        let [x, y, z] = [x, y, z].map(|list| unpack::<f32>(&list).unwrap());
        Observation::scan(sensor, stamp_ns, &x, &y, &z).captured_at(stamp_ns)
    };
    let (mut first, mut second) = (ingester(&running).await, ingester(&running).await);
    assert_eq!(send_all(&mut first, vec![declared(&left), seen("left", 1_000_000_000)]).await, []);
    assert_eq!(send_all(&mut second, vec![declared(&left), seen("top", 1_010_000_000)]).await, []);
    // More names than a vehicle has, one stream after the other.
    for number in 0..40 {
        let mut other = ingester(&running).await;
        let name = format!("other-{number}");
        let sensor = Sensor { name: name.clone(), ..left.clone() };
        assert_eq!(send_all(&mut other, vec![declared(&sensor)]).await, [], "{name}");
        assert_eq!(sensors(&running), ["top", "left", &name]);
        drop(other);
        until("the end of the sensor", || sensors(&running) == ["top", "left"]).await;
    }
    drop(first);
    // The second stream keeps the sensor.
    assert_eq!(send_all(&mut second, vec![seen("left", 1_100_000_000), seen("top", 1_110_000_000)]).await, []);
    drop(second);
    until("the end of the sensor", || sensors(&running) == ["top"]).await;
    let mut third = ingester(&running).await;
    let moved = Sensor { y_m: -0.8, ..left };
    let last = vec![declared(&moved), seen("left", 1_200_000_000), seen("top", 1_210_000_000)];
    assert_eq!(send_all(&mut third, last).await, []);
    let mut undeclared = ingester(&running).await;
    drop(third);
    until("the end of the sensor", || sensors(&running) == ["top"]).await;
    let unknown = send_all(&mut undeclared, vec![seen("left", 1_300_000_000)]).await;
    assert_eq!(by_reason(&unknown), [("source", 1)].into(), "{unknown:?}");
    within("shutdown", running.shutdown()).await.unwrap();
    let report = verify(&file).unwrap();
    assert!(report.is_good() && report.maps == 3, "{report:?}");
    let headers = layer(&recorded(&file), "drivability");
    let last = headers[2].header.clone().unwrap();
    assert_eq!(last.sensors.iter().map(|sensor| &*sensor.name).collect::<Vec<_>>(), ["top", "left"]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn points_in_a_blind_sector_are_counted_in_the_ledger_and_the_status() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("r.mcap");
    let mut config = scanned_config();
    // Azimuths count clockwise, so this is the sector from 80 to 100 degrees to the left of the vehicle.
    config.vehicles[0].sensors[0].blind_deg = vec![[260.0, 280.0]];
    let running = start(config, &file).await;
    assert!(reports(&running, vec![scan(1, plain(1_000_000_000))]).await.1.is_none());
    let status = &running.vehicles.0[0].status;
    let (snapshot, said) = (status.snapshot(), status.to_json());
    assert!((399..=401).contains(&snapshot.ledger.blind), "20 of 360 degrees of 7200 rays: {}", snapshot.ledger.blind);
    assert_eq!(snapshot.sensors[0].ledger.blind, snapshot.ledger.blind);
    assert!(said.to_string().contains(&format!("\"blind\":{}", snapshot.ledger.blind)), "{said}");
    within("shutdown", running.shutdown()).await.unwrap();
    assert!(verify(&file).unwrap().is_good());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_session_over_zenoh_makes_the_same_maps_and_refusals_as_over_grpc() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let running = start(scanned_config(), &at("grpc.mcap")).await;
    let grpc = ingester(&running).await;
    assert_eq!(send_all_from_a_task(grpc, scanned(2, false)).await.1, []);
    within("shutdown", running.shutdown()).await.unwrap();

    let mut config = scanned_config();
    config.zenoh.enabled = true;
    let running = start(config, &at("zenoh.mcap")).await;
    let endpoint = running.zenoh.iter().find(|e| e.starts_with("tcp/127.0.0.1")).expect("zenoh listens");
    let client = within("zenoh", ZenohClient::connect(endpoint)).await.unwrap();
    let unknown = within("an answer", client.ingest("truck")).await.err().unwrap().to_string();
    assert!(unknown.contains("truck") && unknown.contains("car"), "{unknown}");
    let zenoh = within("an ingester", client.ingest("car")).await.unwrap();
    let (mut zenoh, refusals) = send_all_from_a_task(zenoh, scanned(2, false)).await;
    assert_eq!(refusals, []);

    let stale = Observation::pose(5, [0.0; 3], [0.0, 0.0, 0.0, 1.0], 0.0).captured_at(1_000_000_000);
    let strange = Observation::scan("bottom", 5, &[1.0], &[1.0], &[1.0]);
    let crooked = Observation::scan("top", now_ns(), &[1.0], &[1.0, 2.0], &[1.0]);
    let refusals = send_all(&mut zenoh, vec![stale, strange, crooked]).await;
    assert_eq!(by_reason(&refusals), [("stamp", 1), ("source", 1), ("scan_lengths", 1)].into());
    assert!(refusals[1].message.contains("top"), "{refusals:?}");
    within("shutdown", running.shutdown()).await.unwrap();

    assert!(recorded(&at("zenoh.mcap")) == recorded(&at("grpc.mcap")), "the same bytes");
    assert!(verify(&at("zenoh.mcap")).unwrap().is_good());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn clearway_ingest_sends_scans_poses_and_a_road_and_counts_refusals() {
    let folder = tempfile::tempdir().unwrap();
    let point = |x: f32, y: f32| [x, y, -1.9, 0.5].map(f32::to_le_bytes).concat();
    let plain: Vec<u8> = (0..400_u16).map(f32::from).flat_map(|i| point(3.0 + i % 20.0, i / 20.0 - 10.0)).collect();
    let write = |name: &str, bytes: &[u8]| std::fs::write(folder.path().join(name), bytes).unwrap();
    write("0.bin", &plain);
    write("1.bin", &plain);
    write("way.tum", b"100.0 0 0 0 0 0 0 1\n100.1 1 0 0 0 0 0 1\n100.1 1 0 0 0 0 0 1\n");
    write("route.rddf", b"1,30.0,-97.0,10,20\n2,30.001,-97.0,10,20\n");
    let running = start(scanned_config(), &folder.path().join("r.mcap")).await;
    let server = running.grpc.unwrap().to_string();
    let at = folder.path().to_owned();
    let output = tokio::task::spawn_blocking(move || {
        let files = ["ingest", "0.bin", "1.bin", "way.tum", "route.rddf", "--fast", "--json", "--server", &server];
        let again = ["ingest", "way.tum", "--fast", "--server", &server];
        [&files[..], &again].map(|arguments| clearway_tests::run(&at, "clearway", arguments))
    });
    let [output, again] = output.await.unwrap();
    let error = String::from_utf8_lossy(&again.stderr);
    assert!(again.status.code() == Some(2) && error.contains("nothing was accepted"), "{error}");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let said: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(said["sent"], serde_json::json!({ "poses": 3, "roads": 1, "scans": 2 }));
    assert_eq!(said["refused"], serde_json::json!({ "stamp": 1 }), "the pose that came twice");
    let ledger = running.vehicles.0[0].status.snapshot().ledger;
    assert_eq!((ledger.decoded, ledger.poses, ledger.poses_refused, ledger.roads), (2, 2, 4, 1));
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_server_that_stops_has_reported_every_outcome() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("r.mcap");
    let running = start(config(), &file).await;
    let mut ingester = ingester(&running).await;
    assert_eq!(send_all(&mut ingester, tunnelled(&readings(1), 50)).await, []);
    within("shutdown", running.shutdown()).await.unwrap();
    let mut later = Vec::new();
    let error = within("the end", async {
        loop {
            match ingester.send(Observation::end("")).await {
                Ok(number) => later.push(number),
                Err(error) => break error,
            }
        }
    })
    .await;
    assert!(matches!(error, ClientError::Refused { .. } | ClientError::Unreachable { .. }), "{error}");
    assert!(verify(&file).unwrap().is_good());
}

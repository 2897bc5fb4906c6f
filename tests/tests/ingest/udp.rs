//! Datagrams over real sockets: every lost datagram is counted, and maps are the same from a socket and from a file.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufReader;
use std::net::{SocketAddr, UdpSocket};
use std::path::{Path, PathBuf};

use clearway_daemon::config::{Config, Sender, Udp};
use clearway_daemon::ingest::queue::{Arrival, LiveReading, event_queue};
use clearway_daemon::record::{run_config, verify};
use clearway_daemon::run::Running;
use clearway_daemon::status::prometheus;
use clearway_journal::reader::{RecordedMessage, RecordingReader};
use clearway_lidar::capture::Capture;
use clearway_mapping::event::{Body, Cause};
use clearway_mapping::ledger::Ledger;
use clearway_mapping::pipeline::Pipeline;
use clearway_proto::v1;
use clearway_replay::{ReplayOptions, replay};
use proptest::prelude::Rng;
use proptest::test_runner::{RngAlgorithm, TestRng};
use prost::Message;

use crate::fixture::{self, config, recorded, start, until, within};

const HDL32: &str = "pcap/rust-lidar-utils/hdl32_example.pcap";
const VLP16: &str = "pcap/opendlv/proxy-velodyne16/sampleShort.pcap";

fn adds_up(ledger: &Ledger) -> bool {
    ledger.received == ledger.decoded + ledger.telemetry + ledger.refused.values().sum::<u64>()
}

fn ledger(running: &Running, vehicle: usize) -> Ledger {
    running.vehicles.0[vehicle].status.snapshot().ledger
}

fn socket(from: &str) -> UdpSocket {
    UdpSocket::bind((from, 0)).expect("a free port")
}

/// A port at this address that no other test uses.
fn port_at(address: &str) -> SocketAddr {
    socket(address).local_addr().expect("bound")
}

/// Data packets of the simulated vehicle, and one telemetry datagram.
fn datagrams() -> (Vec<Vec<u8>>, Vec<u8>) {
    let all: Vec<Vec<u8>> = fixture::vehicle().take(1500).map(|datagram| datagram.payload).collect();
    let telemetry = all.iter().find(|payload| payload.len() == 512).expect("one a revolution").clone();
    (all.into_iter().filter(|payload| payload.len() == 1206).collect(), telemetry)
}

/// The ledger of a recording's events.
fn replayed(record: &Path, vehicle: &str) -> Ledger {
    let mut recording = RecordingReader::open(record).unwrap();
    let (config, tables) = run_config(&recording).unwrap();
    let index = config.vehicles.iter().position(|v| v.name == vehicle).unwrap();
    let mut pipeline = Pipeline::new(&config.vehicles[index].core(), tables[index].clone()).unwrap();
    for entry in &mut recording {
        if let RecordedMessage::Event { vehicle: of, event } = entry.unwrap()
            && of == vehicle
        {
            let _ = pipeline.step(&event);
        }
    }
    pipeline.ledger().clone()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn every_datagram_is_counted_in_the_ledger_and_in_the_recording() {
    let folder = tempfile::tempdir().unwrap();
    let record = folder.path().join("d.mcap");
    let mut config = config();
    config.recorder.file = record.clone();
    let vehicle = &mut config.vehicles[0];
    // The telemetry socket receives IPv4 and IPv6.
    let (data, telemetry) = ("127.0.0.1:0".parse().unwrap(), "[::]:0".parse().unwrap());
    let mut side = vehicle.sensors[0].clone();
    side.name = "side".into();
    vehicle.sensors.push(side);
    let sender = |name: &str, address: &str| (name.to_owned(), Sender::Address(address.parse().unwrap()));
    let from = BTreeMap::from([sender("top", "127.0.0.2"), sender("side", "127.0.0.4")]);
    vehicle.udp = Some(Udp { data, telemetry, from, ..Udp::default() });
    let running = start(config).await;
    let (data, telemetry) = running.inputs[0].udp.unwrap();
    let telemetry = SocketAddr::new("127.0.0.1".parse().unwrap(), telemetry.port());

    let (packets, position) = datagrams();
    let (sensor, unknown_sender, side) = (socket("127.0.0.2"), socket("127.0.0.3"), socket("127.0.0.4"));
    let mut broken = packets[0].clone();
    broken[0] = 0;
    // At most 50 packets are in flight, so that the kernel's buffer does not overflow on a slow machine.
    let mut sent = 0;
    for packet in &packets {
        sensor.send_to(packet, data).unwrap();
        sent += 1;
        until("each is taken", || ledger(&running, 0).received + 50 > sent).await;
    }
    sensor.send_to(&position, telemetry).unwrap();
    for _ in 0..3 {
        sensor.send_to(&[], data).unwrap();
        sensor.send_to(&packets[0][..1205], data).unwrap();
        sensor.send_to(&broken, data).unwrap();
        sensor.send_to(&[0xff; 1536], data).unwrap();
        sensor.send_to(&[0xff; 1537], data).unwrap();
        sensor.send_to(&[0xff; 65_507], data).unwrap();
        side.send_to(&packets[0], data).unwrap();
        side.send_to(&[0xff; 65_507], data).unwrap();
        unknown_sender.send_to(&packets[0], data).unwrap();
        unknown_sender.send_to(&position, telemetry).unwrap();
        let unknown_sender = UdpSocket::bind("[::1]:0").unwrap();
        unknown_sender.send_to(&position, SocketAddr::new("::1".parse().unwrap(), telemetry.port())).unwrap();
    }
    sent += 1 + 3 * 11;
    until("all are counted", || ledger(&running, 0).received == sent).await;

    let counted = ledger(&running, 0);
    assert!(adds_up(&counted), "{counted:?}");
    // The side sensor's packet came three times: two are copies.
    assert_eq!((counted.decoded, counted.telemetry), (packets.len() as u64 + 1, 1));
    assert_eq!(counted.refused, [("block_flag", 3), ("duplicate", 2), ("length", 18), ("source", 9)].into());
    assert_eq!((counted.lost, counted.kernel_drops), (0, 0));
    let status = running.vehicles.0[0].status.clone();
    let sensors = status.snapshot().sensors;
    assert!(sensors.iter().all(|sensor| adds_up(&sensor.ledger)), "{sensors:?}");
    assert_eq!((sensors[0].ledger.decoded, sensors[0].ledger.telemetry), (packets.len() as u64, 1));
    assert_eq!(sensors[0].ledger.refused, [("block_flag", 3), ("length", 15)].into());
    assert_eq!((sensors[1].ledger.received, sensors[1].ledger.decoded, sensors[1].ledger.refused["length"]), (6, 1, 3));
    let metrics = prometheus(std::slice::from_ref(&status), &[], &Default::default());
    let line = "clearway_sensor_refused_total{vehicle=\"car\",sensor=\"side\",reason=\"length\"} 3\n";
    assert!(metrics.contains(line), "{metrics}");
    let unknown_senders = status.to_proto().unknown_senders;
    let known = unknown_senders.iter().find(|s| s.address == unknown_sender.local_addr().unwrap().to_string());
    assert_eq!(known.expect("the unknown sender is listed").datagrams, 6);
    assert_eq!(unknown_senders.len(), 4, "{unknown_senders:?}");

    within("shutdown", running.shutdown()).await.unwrap();
    assert_eq!(status.snapshot().ledger, counted);
    assert_eq!(replayed(&record, "car"), counted, "the recording has the dropped datagrams too");
    assert!(verify(&record).unwrap().is_good());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn what_the_kernel_drops_in_a_flood_is_counted_for_the_vehicle_and_for_the_sensor_of_the_socket() {
    let mut config = config();
    // The smallest buffer that is allowed, and a queue that has space for all that comes through it.
    config.vehicles[0].udp.as_mut().unwrap().receive_buffer_bytes = 65_536;
    config.vehicles[0].queue = 65_536;
    let running = start(config).await;
    let (data, telemetry) = running.inputs[0].udp.unwrap();
    let (packets, position) = datagrams();
    let sender = socket("127.0.0.1");
    let status = running.vehicles.0[0].status.clone();
    let of_sensor = || status.snapshot().sensors[0].ledger.clone();
    let mut sent = 0;
    for (at, payload) in [(data, &packets[0]), (telemetry, &position)] {
        let dropped = ledger(&running, 0).kernel_drops;
        for round in 0.. {
            assert!(round < 10_000, "the kernel dropped none of {sent} datagrams");
            (0..500).for_each(|_| _ = sender.send_to(payload, at).unwrap());
            sent += 500;
            if ledger(&running, 0).kernel_drops > dropped {
                break;
            }
        }
    }
    // No datagram follows.
    let all = |ledger: &Ledger| ledger.received + ledger.lost + ledger.kernel_drops;
    until("each datagram is counted", || all(&ledger(&running, 0)) == sent).await;
    assert_eq!(all(&of_sensor()), sent, "{:?}", of_sensor());
    assert!(of_sensor().kernel_drops > 0);
    within("shutdown", running.shutdown()).await.unwrap();
    assert_eq!(all(&of_sensor()), sent, "{:?}", of_sensor());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_multicast_group_is_received_on_its_interface() {
    let mut config = config();
    let groups = vec!["239.255.77.1".parse().unwrap()];
    let any = "0.0.0.0:0".parse().unwrap();
    config.vehicles[0].udp = Some(Udp { data: any, telemetry: any, groups, interface: "lo".into(), ..Udp::default() });
    let running = start(config).await;
    let (data, _) = running.inputs[0].udp.unwrap();
    let sender = socket2::Socket::from(socket("127.0.0.1"));
    sender.set_multicast_if_v4(&"127.0.0.1".parse().unwrap()).unwrap();
    let sender = UdpSocket::from(sender);
    sender.send_to(&datagrams().0[0], ("239.255.77.1", data.port())).unwrap();
    until("the datagram to the group is taken", || ledger(&running, 0).decoded == 1).await;
    within("shutdown", running.shutdown()).await.unwrap();
}

#[test]
fn a_million_datagrams_add_up_exactly() {
    let seed = 7;
    println!("seed {seed}");
    let mut seed_bytes = [0; 32];
    seed_bytes[0] = seed;
    let mut random = TestRng::from_seed(RngAlgorithm::ChaCha, &seed_bytes);
    let mut config = config();
    config.vehicles[0].sensors[0].model = Some(clearway_sim::scanner::ScannerConfig::default().model);
    let maps = &mut config.vehicles[0].maps;
    (maps.drivability.enabled, maps.height_difference.enabled, maps.terrain.enabled) = (false, false, false);
    let mut pipeline = Pipeline::new(&config.vehicles[0].core(), vec![None]).unwrap();
    let (queue, events) = event_queue(256);

    let (packets, position) = datagrams();
    let mut broken = packets[0].clone();
    broken[0] = 0;
    let kinds = [position, broken, Vec::new(), vec![0; 1205], vec![0; 1536]].map(bytes::Bytes::from);
    let packets: Vec<_> = packets.into_iter().map(bytes::Bytes::from).collect();
    let reading = |packet: &bytes::Bytes| LiveReading::new(Arrival::Now, 0, Body::Datagram(packet.clone()));
    let total = 1_000_000;
    let (mut sent, mut dropped, mut next) = (0_u64, [0_u64; 3], 0);
    while sent < total {
        let size = u64::from(random.next_u32() % 64).min(total - sent);
        sent += size;
        let mut readings = Vec::new();
        for _ in 0..size {
            match random.next_u32() % 16 {
                0 => {
                    queue.refuse_unknown_sender(([10, 0, 0, (random.next_u32() % 16) as u8], 2368).into());
                    dropped[0] += 1;
                }
                1 => {
                    queue.record_drop(0, Cause::Length, 1);
                    dropped[1] += 1;
                }
                2 => {
                    queue.record_drop(0, Cause::Kernel, 1);
                    dropped[2] += 1;
                }
                kind @ 3..8 => readings.push(reading(&kinds[kind as usize - 3])),
                _ => {
                    readings.push(reading(&packets[next % packets.len()]));
                    next += 1;
                }
            }
        }
        queue.push(readings).unwrap();
        // The engine stalls now and then.
        if random.next_u32().is_multiple_of(8) {
            events.try_iter().for_each(|queued| drop(pipeline.step(&queued.event)));
        }
    }
    events.try_iter().for_each(|queued| drop(pipeline.step(&queued.event)));
    queue.report_drops(None).unwrap();
    events.try_iter().for_each(|queued| drop(pipeline.step(&queued.event)));

    let ledger = pipeline.ledger();
    assert!(adds_up(ledger), "{ledger:?}");
    assert_eq!(ledger.received + ledger.lost + ledger.kernel_drops, total);
    assert_eq!((ledger.refused["source"], ledger.kernel_drops), (dropped[0], dropped[2]));
    assert!(ledger.refused["length"] > dropped[1] && ledger.refused["block_flag"] > 0 && ledger.telemetry > 0);
    assert!(ledger.decoded > total / 4 && ledger.lost > total / 100, "{ledger:?}");
}

fn drive(path: &str) -> PathBuf {
    Path::new(env!("CLEARWAY_DRIVES")).join(path)
}

/// The vehicle `name` with a level sensor 1.9 m above the ground that receives at `at` from the sender `from`.
fn receiving_at(name: &str, at: SocketAddr, from: &str) -> clearway_daemon::config::Vehicle {
    let mut vehicle = Config::of_one_vehicle(name, "top").vehicles.remove(0);
    vehicle.sensors[0].extrinsics.z_m = 1.9;
    // These captures are years old; the server accepts their time all the same.
    vehicle.sensors[0].gps_late_days_max = 36_525.0;
    let from = [("top".to_owned(), Sender::Address(from.parse().unwrap()))].into();
    vehicle.udp = Some(Udp { data: at, telemetry: at, from, ..Udp::default() });
    vehicle
}

/// A copy of a capture that begins with its first telemetry datagram. These captures are years old, and stamps never go
/// back: the server must have the sensor's clock before it stamps the first revolution.
fn with_its_clock_first(capture: &Path, copy: PathBuf) -> PathBuf {
    const FILE_HEADER: usize = 24;
    const RECORD_HEADER: usize = 16;
    const TELEMETRY_FRAME: usize = 14 + 20 + 8 + 512;
    let bytes = std::fs::read(capture).unwrap();
    let (mut records, mut rest) = (Vec::new(), &bytes[FILE_HEADER..]);
    while let Some(length) = rest.get(8..12) {
        let length = RECORD_HEADER + u32::from_le_bytes(length.try_into().unwrap()) as usize;
        // One of the captures is truncated in its last datagram.
        let Some((record, after)) = rest.split_at_checked(length) else { break };
        records.push(record);
        rest = after;
    }
    let telemetry = records.iter().position(|record| record.len() == RECORD_HEADER + TELEMETRY_FRAME).unwrap();
    records[..=telemetry].rotate_right(1);
    std::fs::write(&copy, [&bytes[..FILE_HEADER], &records.concat()].concat()).unwrap();
    copy
}

/// Sends a capture's datagrams at full speed; returns their number.
fn send(capture: &Path, from: &str, to: SocketAddr) -> u64 {
    let socket = socket(from);
    let capture = Capture::new(BufReader::new(File::open(capture).unwrap())).unwrap();
    let mut sent = 0;
    for datagram in capture {
        socket.send_to(&datagram.unwrap().payload, to).unwrap();
        sent += 1;
    }
    sent
}

/// A map without the fields that depend on the arrival times, on the vehicle's name and on the server's run. The stamps
/// of the capture come from the sensor, and stay.
fn without_arrival(map: &[u8]) -> v1::Map {
    let mut map = v1::Map::decode(map).unwrap();
    let header = map.header.as_mut().unwrap();
    (header.vehicle, header.boot_id, header.completed_ns) = (String::new(), 0, 0);
    header.sensors.iter_mut().for_each(|sensor| sensor.clock_offset_ms = 0);
    map
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
async fn two_captures_sent_to_one_port_make_the_maps_of_their_files() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let captures = [("car", HDL32, "127.0.0.2"), ("van", VLP16, "127.0.0.3")]
        .map(|(vehicle, capture, from)| (vehicle, with_its_clock_first(&drive(capture), at(vehicle)), from));
    let one_port = port_at("127.9.9.9");
    let mut config = config();
    config.vehicles = captures.iter().map(|(vehicle, _, from)| receiving_at(vehicle, one_port, from)).collect();
    config.recorder.file = at("live.mcap");
    let extrinsics = config.vehicles[0].sensors[0].extrinsics;
    let running = start(config).await;
    let senders = captures.clone().map(|(_, capture, from)| std::thread::spawn(move || send(&capture, from, one_port)));
    let sent = senders.map(|sender| sender.join().unwrap());
    assert_eq!(sent, [976, 347]);
    until("all are taken", || [0, 1].map(|vehicle| ledger(&running, vehicle).received) == sent).await;
    within("shutdown", running.shutdown()).await.unwrap();
    let live = fixture::recorded_of_all(&at("live.mcap"));

    for (vehicle, capture, _) in captures {
        let record = at(&format!("{vehicle}.mcap"));
        let options = ReplayOptions {
            files: vec![capture],
            record: Some(record.clone()),
            extrinsics: Some(extrinsics),
            ..ReplayOptions::default()
        };
        within("replay", replay(options)).await.unwrap();
        let mut file: Vec<_> = recorded(&record).into_iter().collect();
        // The end of the file completes the last revolution; a socket has no end.
        let last = file.last().unwrap().0.0;
        file.retain(|((sequence, _), _)| *sequence < last);
        assert!(file.len() >= 3 * fixture::LAYERS as usize, "{} maps", file.len());
        let live: Vec<_> = live.iter().filter(|((of, ..), _)| of == vehicle).collect();
        assert_eq!(live.len(), file.len(), "{vehicle}");
        for (((_, sequence, layer), live), (key, file)) in live.into_iter().zip(file) {
            assert_eq!((*sequence, layer), (key.0, &key.1));
            let (live, file) = (without_arrival(live), without_arrival(&file));
            assert_eq!(live.header, file.header, "{vehicle}, map {sequence}, layer {layer}");
            assert!(live.layers == file.layers, "{vehicle}, map {sequence}, layer {layer}");
        }
    }
}

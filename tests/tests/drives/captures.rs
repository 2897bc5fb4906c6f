//! Captures: several sensors in one, link types, and device values that cannot be right.

use std::net::Ipv4Addr;
use std::path::PathBuf;

use clearway_lidar::model::Model;
use clearway_replay::{ReplayOptions, ReplaySummary};
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::flat;
use clearway_sim::vehicle::{Datagram, Kind, SimulatedVehicle};
use nalgebra::Isometry3;

use super::scene::{LEVEL_MOUNT, replayed};

const ETHERNET: u32 = 1;
const RAW_IP: u32 = 101;

/// The datagrams of 0.25 s of a VLP-16 at this height.
fn vlp16(height_m: f64) -> Vec<Datagram> {
    let ego_from_sensor = Isometry3::translation(0.0, 0.0, height_m);
    let config = ScannerConfig { model: Model::Vlp16, ego_from_sensor, ..ScannerConfig::default() };
    SimulatedVehicle::new(flat(), config).take(200).collect()
}

/// An IPv4 packet with a UDP datagram.
fn packet(datagram: &Datagram, source: [u8; 4], data_port: u16) -> Vec<u8> {
    let port = if datagram.kind == Kind::Data { data_port } else { data_port + 5940 };
    let udp_length = 8 + datagram.payload.len() as u16;
    let mut bytes = vec![0x45, 0];
    bytes.extend((20 + udp_length).to_be_bytes());
    bytes.extend([0, 0, 0x40, 0, 64, 17, 0, 0]);
    bytes.extend(source);
    bytes.extend(Ipv4Addr::BROADCAST.octets());
    [443, port, udp_length, 0].iter().for_each(|value| bytes.extend(value.to_be_bytes()));
    bytes.extend(&datagram.payload);
    bytes
}

/// A capture with the packets at their stamps.
fn capture(link: u32, head: &[u8], mut packets: Vec<(i64, Vec<u8>)>) -> (tempfile::TempDir, PathBuf) {
    packets.sort_by_key(|(stamp_ns, _)| *stamp_ns);
    let mut bytes = Vec::new();
    [0xA1B2_3C4D, 0x0004_0002, 0, 0, 65_535, link].iter().for_each(|v: &u32| bytes.extend(v.to_le_bytes()));
    for (stamp_ns, packet) in packets {
        let length = (head.len() + packet.len()) as u32;
        let (seconds, ns) = ((stamp_ns / 1_000_000_000) as u32, (stamp_ns % 1_000_000_000) as u32);
        [seconds, ns, length, length].iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        bytes.extend(head);
        bytes.extend(packet);
    }
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("a.pcap");
    std::fs::write(&file, bytes).unwrap();
    (folder, file)
}

const FIRST: [u8; 4] = [192, 168, 1, 201];

fn stamped(datagrams: &[Datagram], source: [u8; 4], port: u16) -> Vec<(i64, Vec<u8>)> {
    datagrams.iter().map(|datagram| (datagram.stamp_ns, packet(datagram, source, port))).collect()
}

async fn replay_of(file: &std::path::Path) -> ReplaySummary {
    let options =
        ReplayOptions { files: vec![file.to_owned()], extrinsics: Some(LEVEL_MOUNT), ..ReplayOptions::default() };
    replayed(options).await.unwrap().0
}

fn rpm(summary: &ReplaySummary) -> f32 {
    summary.snapshot.sensors[0].status.rpm.unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn of_several_sensors_every_command_uses_the_first_and_names_the_others() {
    let (top, other) = (vlp16(1.8), vlp16(0.9));
    let own = top.iter().filter(|datagram| datagram.kind == Kind::Data).count() as u64;
    for (source, port, name) in [(FIRST, 2369, "192.168.1.201:2369"), ([192, 168, 1, 202], 2368, "192.168.1.202")] {
        let mut packets = stamped(&top, FIRST, 2368);
        // The sort is stable, so the first sensor stays the first.
        packets.extend(stamped(&other, source, port));
        let (folder, file) = capture(RAW_IP, &[], packets);
        let summary = replay_of(&file).await;
        let ledger = &summary.snapshot.ledger;
        assert_eq!((ledger.received - ledger.telemetry, ledger.decoded), (own, own), "{name}");
        assert!((rpm(&summary) - 600.0).abs() < 5.0 && summary.snapshot.maps > 1, "{name}: {}", rpm(&summary));
        let note = format!("datagrams of another sensor, {name}, ignored");
        assert!(summary.notes.iter().any(|line| line.contains(&note)), "{:?}", summary.notes);

        let arguments = ["send", "a.pcap", "--to", "udp://127.0.0.1:9", "--speed", "max"];
        let output = clearway_tests::run(folder.path(), "clearway", &arguments);
        let said = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(said.contains(&format!("sent {own} data packets")) && said.contains(&note), "{said}");

        let output = clearway_tests::run(folder.path(), "clearway", &["info", "a.pcap"]);
        let said = String::from_utf8_lossy(&output.stdout).into_owned();
        assert_eq!(said.matches("rpm: 599.9").count(), 2, "{said}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_capture_of_the_loopback_is_read_and_an_unknown_link_type_is_named() {
    let top = vlp16(1.8);
    let mut ethernet = vec![0xFF; 12];
    ethernet.extend([8, 0]);
    let links: [(u32, &[u8]); 4] = [(ETHERNET, &ethernet), (RAW_IP, &[]), (0, &[2, 0, 0, 0]), (108, &[0, 0, 0, 2])];
    for (link, head) in links {
        let (_folder, file) = capture(link, head, stamped(&top, FIRST, 2368));
        assert_eq!(replay_of(&file).await.snapshot.ledger.received, top.len() as u64, "link type {link}");
    }
    let (_folder, file) = capture(147, &[], stamped(&top, FIRST, 2368));
    let summary = replay_of(&file).await;
    assert!(summary.notes.iter().any(|note| note.contains("of link type 147")), "{:?}", summary.notes);
    assert_eq!(summary.maps(), 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_device_time_that_stands_still_is_no_time() {
    let mut top = vlp16(1.8);
    for datagram in top.iter_mut().filter(|datagram| datagram.kind == Kind::Data) {
        datagram.payload[1200..1204].fill(0);
    }
    top.retain(|datagram| datagram.kind == Kind::Data);
    let (_folder, file) = capture(RAW_IP, &[], stamped(&top, FIRST, 2368));
    let summary = replay_of(&file).await;
    assert!((rpm(&summary) - 600.0).abs() < 10.0, "{} rpm", rpm(&summary));
    assert!(summary.to_text().contains("its device time stands still"), "{}", summary.to_text());
}

#[tokio::test(flavor = "multi_thread")]
async fn gps_time_that_is_a_day_ahead_is_not_used() {
    const DAY_NS: i64 = 86_400_000_000_000;
    let top = vlp16(1.8);
    // The receiver is right in the first and the third capture.
    for (behind_ns, is_used) in [(0, true), (DAY_NS, false), (-DAY_NS / 2, true), (365 * DAY_NS, false)] {
        let packets = stamped(&top, FIRST, 2368).into_iter().map(|(ns, packet)| (ns - behind_ns, packet)).collect();
        let (_folder, file) = capture(RAW_IP, &[], packets);
        let summary = replay_of(&file).await;
        let status = &summary.snapshot.sensors[0].status;
        let has_remark = summary.to_text().contains("ahead of its arrival and not used");
        let follows_gps = status.clock.is_some_and(|clock| clock.as_str().starts_with("gps"));
        assert_eq!((follows_gps, has_remark), (is_used, !is_used), "{behind_ns}: {:?}", status.clock);
        let late_ms = status.clock_offset_ms.abs();
        assert!(is_used || late_ms < 1000, "{late_ms} ms");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_given_model_stands_for_an_unknown_model_byte_but_not_for_another_model() {
    for (byte, model, is_read) in
        [(0x23, None, false), (0x23, Some(Model::Vlp16), true), (0x28, Some(Model::Vlp16), false)]
    {
        let mut top = vlp16(1.8);
        top.iter_mut().filter(|of| of.kind == Kind::Data).for_each(|datagram| datagram.payload[1205] = byte);
        let (_folder, file) = capture(RAW_IP, &[], stamped(&top, FIRST, 2368));
        let options = ReplayOptions { files: vec![file], model, extrinsics: Some(LEVEL_MOUNT), ..Default::default() };
        let (summary, _) = replayed(options).await.unwrap();
        assert_eq!(summary.maps() > 1, is_read, "{byte:#x} {model:?}: {:?}", summary.snapshot.refusals);
    }
}

#[test]
fn init_gives_sensors_with_one_address_ports_of_their_own() {
    for with_telemetry in [false, true] {
        let mut packets = Vec::new();
        for (height_m, port) in [(1.8, 2368), (0.9, 2369)] {
            let mut datagrams = vlp16(height_m);
            datagrams.retain(|datagram| with_telemetry || datagram.kind == Kind::Data);
            packets.extend(stamped(&datagrams, FIRST, port));
        }
        let (folder, _) = capture(RAW_IP, &[], packets);
        let output = clearway_tests::run(folder.path(), "clearway", &["init", "--from", "a.pcap", "--out", "car.toml"]);
        let said = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(said.contains("next: clearway serve --config car.toml"), "{said}");
        let written = std::fs::read_to_string(folder.path().join("car.toml")).unwrap();
        for ports in ["lidar_1 = { data = 2368, telemetry = 8308 }", "lidar_2 = { data = 2369, telemetry = 8309 }"] {
            assert!(written.contains(ports), "{written}");
        }
    }
}

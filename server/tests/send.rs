//! `clearway send` sends a capture that the test writes to sockets of the test.

use std::net::UdpSocket;
use std::process::{Command, Stdio};
use std::time::Duration;

use serde_json::Value;

use crate::common::{clearway, text};

/// A pcap file of Ethernet frames with one UDP datagram each.
fn pcap(payloads: &[Vec<u8>]) -> Vec<u8> {
    let mut file = vec![0xd4, 0xc3, 0xb2, 0xa1, 2, 0, 4, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xff, 0xff, 0, 0, 1, 0, 0, 0];
    for (index, payload) in payloads.iter().enumerate() {
        let mut frame = vec![0xff; 12];
        frame.extend([0x08, 0x00, 0x45, 0]);
        frame.extend((28 + payload.len() as u16).to_be_bytes());
        frame.extend([0, 0, 0, 0, 64, 17, 0, 0, 192, 168, 1, 201, 255, 255, 255, 255]);
        frame.extend([2368_u16, 2368, 8 + payload.len() as u16, 0].iter().flat_map(|v| v.to_be_bytes()));
        frame.extend(payload);
        let length = (frame.len() as u32).to_le_bytes();
        file.extend(1_700_000_000_u32.to_le_bytes());
        file.extend((1000 * index as u32).to_le_bytes());
        file.extend(length);
        file.extend(length);
        file.extend(frame);
    }
    file
}

fn received(socket: &UdpSocket) -> Vec<Vec<u8>> {
    let mut buffer = [0; 2048];
    let mut datagrams = Vec::new();
    // Everything was sent before this: loopback delivers at once.
    socket.set_read_timeout(Some(Duration::from_millis(200))).unwrap();
    while let Ok(length) = socket.recv(&mut buffer) {
        datagrams.push(buffer[..length].to_vec());
    }
    datagrams
}

#[test]
fn data_and_telemetry_are_sent_unchanged_and_other_datagrams_are_counted() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("drive.pcap");
    let payloads = [vec![1; 1206], vec![2; 512], vec![3; 100], vec![4; 1206]];
    let mut bytes = pcap(&payloads);
    bytes.truncate(bytes.len() - 1);
    std::fs::write(&file, &bytes).unwrap();
    let (data, telemetry) = (UdpSocket::bind("127.0.0.1:0").unwrap(), UdpSocket::bind("127.0.0.1:0").unwrap());
    let target = |socket: &UdpSocket| format!("udp://{}", socket.local_addr().unwrap());
    let (to, telemetry_to) = (target(&data), target(&telemetry));
    let path = file.to_str().unwrap();
    let done = clearway(&[
        "send",
        path,
        "--to",
        &to,
        "--telemetry-to",
        &telemetry_to,
        "--speed",
        "max",
        "--bind",
        "127.0.0.2",
        "--json",
    ]);
    assert_eq!(done.status.code(), Some(2), "the capture is not whole: {}", text(&done.stderr));
    let (_, sender) = data.peek_from(&mut []).unwrap();
    assert_eq!(sender.ip().to_string(), "127.0.0.2");
    assert_eq!(received(&data), [vec![1; 1206]]);
    assert_eq!(received(&telemetry), [vec![2; 512]]);
    let document: Value = serde_json::from_slice(&done.stdout).unwrap();
    assert_eq!((&document["packets"], &document["telemetry"]), (&1.into(), &1.into()));
    assert_eq!(document["skipped"]["100 bytes; 1206 and 512 are sent"], 1);
    assert!(document["cut"].as_str().unwrap().contains("cut off"), "the last packet lacks a byte: {document}");
}

#[test]
fn a_capture_in_a_loop_begins_again_at_its_end() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("drive.pcap");
    std::fs::write(&file, pcap(&[vec![1; 1206], vec![2; 1206]])).unwrap();
    let data = UdpSocket::bind("127.0.0.1:0").unwrap();
    let to = format!("udp://{}", data.local_addr().unwrap());
    let mut command = Command::new(env!("CARGO_BIN_EXE_clearway"));
    let sender =
        command.args(["send", file.to_str().unwrap(), "--to", &to, "--loop"]).stdout(Stdio::piped()).spawn().unwrap();
    let mut buffer = [0; 1206];
    let first_bytes = [(); 6].map(|()| (data.recv(&mut buffer).unwrap(), buffer[0]).1);
    Command::new("kill").args(["-INT", &sender.id().to_string()]).status().unwrap();
    let said = sender.wait_with_output().unwrap();
    assert_eq!(first_bytes, [1, 2, 1, 2, 1, 2]);
    assert!(said.status.success() && text(&said.stdout).starts_with("sent "), "{said:?}");
}

#[test]
fn datagrams_to_a_closed_port_are_counted_and_the_command_fails() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("drive.pcap");
    std::fs::write(&file, pcap(&vec![vec![1; 1206]; 20])).unwrap();
    let closed = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let done = clearway(&["send", file.to_str().unwrap(), "--to", &format!("udp://{closed}")]);
    assert_eq!(done.status.code(), Some(2));
    assert!(text(&done.stderr).contains(&format!("no socket is open at {closed}")), "{}", text(&done.stderr));
}

#[test]
fn a_wrong_target_is_refused_with_the_allowed_form() {
    let done = clearway(&["send", "/nowhere", "--to", "tcp://127.0.0.1:1"]);
    assert_eq!(done.status.code(), Some(2));
    assert!(text(&done.stderr).contains("udp://HOST:PORT is allowed"), "{}", text(&done.stderr));
    assert_eq!(clearway(&["send", "/nowhere", "--to", "udp://127.0.0.1:1", "--speed", "0"]).status.code(), Some(3));
}

#[test]
fn a_bad_network_does_what_it_reports_and_repeats_it_with_the_same_seed() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("drive.pcap");
    let payloads: Vec<Vec<u8>> = (0..60_u8).map(|number| vec![number; 1206]).collect();
    std::fs::write(&file, pcap(&payloads)).unwrap();
    let send = |seed: &str| {
        let data = UdpSocket::bind("127.0.0.1:0").unwrap();
        let to = format!("udp://{}", data.local_addr().unwrap());
        let path = file.to_str().unwrap();
        let network = ["--network", &format!("loss=10,duplicate=20,reorder=8,truncate=5,seed={seed}")];
        let done = clearway(&[&["send", path, "--to", &to, "--speed", "max", "--json"][..], &network].concat());
        assert!(done.status.success(), "{}", text(&done.stderr));
        let document: Value = serde_json::from_slice(&done.stdout).unwrap();
        (received(&data), document["network"].clone())
    };
    let (arrived, counts) = send("7");
    let count = |name: &str| counts[name].as_u64().unwrap();
    assert_eq!((count("taken"), count("arrived")), (60, arrived.len() as u64));
    assert_eq!(arrived.len() as u64, 60 - count("packets_lost") + count("duplicated"));
    assert_eq!(arrived.iter().filter(|payload| payload.len() < 1206).count() as u64, count("truncated"));
    let (first_bytes, in_order) =
        (arrived.iter().filter_map(|payload| payload.first()), |pair: &[u8]| pair[0] <= pair[1]);
    assert!(!first_bytes.copied().collect::<Vec<_>>().windows(2).all(in_order));
    assert!(["packets_lost", "gaps", "duplicated", "reordered", "truncated"].iter().all(|name| count(name) > 0));
    assert_eq!(send("7"), (arrived.clone(), counts.clone()));
    assert_ne!(send("8").0, arrived);

    let done = clearway(&["send", "/nowhere", "--to", "udp://127.0.0.1:1", "--network", "loss=101"]);
    assert!(text(&done.stderr).contains("0 to 100 percent is allowed"), "{}", text(&done.stderr));
}

//! Captures of all formats: complete, truncated and damaged.

use clearway_lidar::capture::{Capture, CaptureError, Datagram, Skipped};

/// An IPv4 UDP packet from 192.168.1.201:443 to port 2368. `fragment`: the field of flags and offset.
pub fn ip_packet(payload: &[u8], fragment: u16) -> Vec<u8> {
    let udp = 8 + payload.len();
    let mut bytes = vec![0x45, 0];
    bytes.extend((20 + udp as u16).to_be_bytes());
    bytes.extend([0, 0]);
    bytes.extend(fragment.to_be_bytes());
    bytes.extend([64, 17, 0, 0, 192, 168, 1, 201, 255, 255, 255, 255]);
    bytes.extend(443_u16.to_be_bytes());
    bytes.extend(2368_u16.to_be_bytes());
    bytes.extend((udp as u16).to_be_bytes());
    bytes.extend([0, 0]);
    bytes.extend(payload);
    bytes
}

pub fn ethernet(packet: &[u8], vlan: bool) -> Vec<u8> {
    let mut bytes = vec![0xFF; 12];
    if vlan {
        bytes.extend([0x81, 0x00, 0x00, 0x05]);
    }
    bytes.extend([0x08, 0x00]);
    bytes.extend(packet);
    bytes
}

/// A pcap file with one packet per millisecond, from 100 s on.
pub fn pcap(link: u32, frames: &[Vec<u8>], big_endian: bool, nanoseconds: bool) -> Vec<u8> {
    let u32_of = |value: u32| if big_endian { value.to_be_bytes() } else { value.to_le_bytes() };
    let mut bytes = Vec::new();
    bytes.extend(u32_of(if nanoseconds { 0xA1B2_3C4D } else { 0xA1B2_C3D4 }));
    bytes.extend(if big_endian { [0, 2, 0, 4] } else { [2, 0, 4, 0] });
    [0, 0, 65_535, link].iter().for_each(|value| bytes.extend(u32_of(*value)));
    for (index, frame) in frames.iter().enumerate() {
        let fraction = 1_000 * index as u32 * if nanoseconds { 1_000 } else { 1 };
        let length = frame.len() as u32;
        [100, fraction, length, length].iter().for_each(|value| bytes.extend(u32_of(*value)));
        bytes.extend(frame);
    }
    bytes
}

/// A pcapng file with one Ethernet interface of that resolution.
pub fn pcapng(frames: &[Vec<u8>], if_tsresol: u8, ticks: u64) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut block = |kind: u32, body: &[u8]| {
        let length = (12 + body.len() as u32).to_le_bytes();
        bytes.extend(kind.to_le_bytes());
        bytes.extend(length);
        bytes.extend(body);
        bytes.extend(length);
    };
    let mut section = 0x1A2B_3C4D_u32.to_le_bytes().to_vec();
    section.extend([1, 0, 0, 0]);
    section.extend([0xFF; 8]);
    block(0x0A0D_0D0A, &section);
    block(1, &[1, 0, 0, 0, 0xFF, 0xFF, 0, 0, 9, 0, 1, 0, if_tsresol, 0, 0, 0, 0, 0, 0, 0]);
    for frame in frames {
        let mut body = 0_u32.to_le_bytes().to_vec();
        body.extend(((ticks >> 32) as u32).to_le_bytes());
        body.extend((ticks as u32).to_le_bytes());
        body.extend([frame.len() as u32, frame.len() as u32].iter().flat_map(|length| length.to_le_bytes()));
        body.extend(frame);
        body.resize(body.len().next_multiple_of(4), 0);
        block(6, &body);
    }
    bytes
}

fn read(bytes: &[u8]) -> (Vec<Datagram>, Option<CaptureError>, Skipped) {
    let mut capture = Capture::new(bytes).unwrap();
    let (mut datagrams, mut error) = (Vec::new(), None);
    let mut offset = capture.offset();
    while let Some(item) = capture.next() {
        assert!(offset <= capture.offset() && capture.offset() <= bytes.len() as u64, "it rises within the file");
        offset = capture.offset();
        match item {
            Ok(datagram) => datagrams.push(datagram),
            Err(found) => error = Some(found),
        }
    }
    (datagrams, error, capture.skipped())
}

#[test]
fn every_kind_of_capture_gives_the_same_datagrams() {
    let packet = ip_packet(&[7; 1206], 0);
    let mut cooked = vec![0; 14];
    cooked.extend([0x08, 0x00]);
    cooked.extend(&packet);
    for big_endian in [false, true] {
        for nanoseconds in [false, true] {
            for (link, frame) in [
                (1, ethernet(&packet, false)),
                (1, ethernet(&packet, true)),
                (113, cooked.clone()),
                (101, packet.clone()),
            ] {
                let bytes = pcap(link, &vec![frame; 300], big_endian, nanoseconds);
                let (datagrams, error, skipped) = read(&bytes);
                assert_eq!((datagrams.len(), error, skipped), (300, None, Skipped::default()), "link {link}");
                let mut capture = Capture::new(&bytes[..]).unwrap();
                assert_eq!((capture.by_ref().count(), capture.offset()), (300, bytes.len() as u64));
                assert_eq!(datagrams[299].stamp_ns, 100_299_000_000);
                assert_eq!(datagrams[299].source, "192.168.1.201:443".parse().unwrap());
                assert_eq!((datagrams[0].destination_port, datagrams[0].payload.len()), (2368, 1206));
            }
        }
    }
}

#[test]
fn pcapng_stamps_follow_the_interfaces_resolution() {
    let frames = [ethernet(&ip_packet(&[1; 512], 0), false)];
    for (if_tsresol, ticks, stamp_ns) in [
        (6, 1_500_000, 1_500_000_000),
        (9, 1_500_000_001, 1_500_000_001),
        (3, 1_500, 1_500_000_000),
        (0x8A, 1_536, 1_500_000_000),
    ] {
        let (datagrams, error, _) = read(&pcapng(&frames, if_tsresol, ticks));
        assert_eq!(error, None);
        assert_eq!(datagrams[0].stamp_ns, stamp_ns, "if_tsresol {if_tsresol:#x}");
    }
}

#[test]
fn a_truncated_capture_gives_its_datagrams_then_an_error() {
    let frames = vec![ethernet(&ip_packet(&[7; 1206], 0), false); 4];
    let whole = pcap(1, &frames, false, false);
    let record = 16 + frames[0].len();
    for end in [24 + 2 * record + 1, 24 + 2 * record + 15, 24 + 2 * record + 16, 24 + 3 * record - 1] {
        let (datagrams, error, _) = read(&whole[..end]);
        assert_eq!(datagrams.len(), 2, "{end}");
        assert_eq!(error, Some(CaptureError::Truncated { offset: (24 + 2 * record) as u64 }), "{end}");
    }
    let (datagrams, error, _) = read(&whole[..24 + 2 * record]);
    assert_eq!((datagrams.len(), error), (2, None));
    assert_eq!(read(&whole[..24]).0.len(), 0);

    let ng = pcapng(&frames, 6, 0);
    let (datagrams, error, _) = read(&ng[..ng.len() - 3]);
    assert_eq!(datagrams.len(), 3);
    assert!(matches!(error, Some(CaptureError::Truncated { .. })), "{error:?}");
}

#[test]
fn a_process_information_block_shorter_than_its_head_is_damage() {
    let frames = vec![ethernet(&ip_packet(&[7; 1206], 0), false); 2];
    let whole = pcapng(&frames, 6, 0);
    for length in [0_u32, 4, 8, 11] {
        let bytes = [&whole[..], &0x8000_0001_u32.to_le_bytes(), &length.to_le_bytes(), &[0; 32]].concat();
        let (datagrams, error, _) = read(&bytes);
        assert_eq!(datagrams.len(), 2, "{length}");
        let what = "a block shorter than its head".into();
        assert_eq!(error, Some(CaptureError::Damaged { offset: whole.len() as u64, what }), "{length}");
    }
    // A packet of a pcap file may begin with the same bytes, which are then its stamp.
    let mut classic = pcap(1, &frames, false, false);
    classic[24..28].copy_from_slice(&0x8000_0001_u32.to_le_bytes());
    let (datagrams, error, _) = read(&classic);
    assert_eq!((datagrams.len(), error), (2, None));
}

#[test]
fn packets_without_a_complete_datagram_are_counted() {
    let mut tcp = ip_packet(&[0; 40], 0);
    tcp[9] = 6;
    let mut arp = ethernet(&[0; 46], false);
    arp[12..14].copy_from_slice(&[0x08, 0x06]);
    let mut short = ethernet(&ip_packet(&[7; 1206], 0), false);
    short.truncate(200);
    let frames = [
        ethernet(&tcp, false),
        arp,
        ethernet(&ip_packet(&[7; 1206], 0x2000), false),
        ethernet(&ip_packet(&[7; 600], 0x0096), false),
        short,
        vec![1, 2, 3],
        ethernet(&ip_packet(&[7; 1206], 0), false),
    ];
    let (datagrams, error, skipped) = read(&pcap(1, &frames, false, false));
    assert_eq!((datagrams.len(), error), (1, None));
    assert_eq!(skipped, Skipped { not_udp: 2, fragmented: 2, unreadable: 2, ..Skipped::default() });
}

#[test]
fn other_files_are_refused() {
    for bytes in [&b""[..], b"MZ", b"\x89MCAP0\r\n and so on, and on, and on", &[0; 100]] {
        assert!(matches!(Capture::new(bytes).err(), Some(CaptureError::Format { .. })), "{bytes:?}");
    }
    let mut greedy = pcap(1, &[vec![0; 60]], false, false);
    greedy[32..36].copy_from_slice(&u32::MAX.to_le_bytes());
    let (datagrams, error, _) = read(&greedy);
    assert!(datagrams.is_empty() && error.is_some(), "{error:?}");
}

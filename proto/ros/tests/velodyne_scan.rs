//! `VelodyneScan` messages.

use clearway_ros::MessageError;
use clearway_ros::velodyne_scan::VelodyneScan;

pub fn message(frame_id: &str, packets: &[(i32, u32, Vec<u8>)]) -> Vec<u8> {
    let mut bytes = vec![0, 1, 0, 0];
    let align = |bytes: &mut Vec<u8>| bytes.resize(bytes.len().next_multiple_of(4), 0);
    bytes.extend(12_i32.to_le_bytes());
    bytes.extend(34_u32.to_le_bytes());
    bytes.extend((frame_id.len() as u32 + 1).to_le_bytes());
    bytes.extend(frame_id.as_bytes());
    bytes.push(0);
    align(&mut bytes);
    bytes.extend((packets.len() as u32).to_le_bytes());
    for (seconds, nanoseconds, data) in packets {
        align(&mut bytes);
        bytes.extend(seconds.to_le_bytes());
        bytes.extend(nanoseconds.to_le_bytes());
        bytes.extend(data);
    }
    bytes
}

#[test]
fn packets_decode_to_themselves() {
    for frame_id in ["", "v", "velodyne", "velodyne_top"] {
        let sent: Vec<_> = (0..3).map(|i| (100 + i, 7 * i as u32, vec![i as u8; 1206])).collect();
        let bytes = message(frame_id, &sent);
        let scan = VelodyneScan::new(&bytes).unwrap();
        assert_eq!((scan.frame_id, scan.count), (frame_id, 3));
        let read: Vec<_> = scan.packets().map(Result::unwrap).collect();
        for ((stamp_ns, data), (seconds, nanoseconds, expected)) in read.iter().zip(&sent) {
            assert_eq!(*stamp_ns, i64::from(*seconds) * 1_000_000_000 + i64::from(*nanoseconds));
            assert_eq!(data.as_slice(), expected.as_slice());
        }
    }
}

#[test]
fn a_claimed_length_beyond_the_message_is_refused() {
    let bytes = message("velodyne", &[(1, 2, vec![3; 1206])]);
    for end in 0..bytes.len() {
        let shown = VelodyneScan::new(&bytes[..end]).unwrap_err();
        assert!(matches!(shown, MessageError::Truncated { .. }), "{end}: {shown}");
    }
    let mut greedy = bytes.clone();
    greedy[28..32].copy_from_slice(&u32::MAX.to_le_bytes());
    assert!(matches!(VelodyneScan::new(&greedy), Err(MessageError::Truncated { what: "packets", .. })));
    let mut other = bytes;
    other[1] = 9;
    assert_eq!(VelodyneScan::new(&other).unwrap_err(), MessageError::Encapsulation { found: [0, 9] });
}

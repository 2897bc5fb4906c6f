//! Comparison of decoded recorded drives with the points of VeloView and velodyne-decoder.
//!
//! The recordings belong to others and are not in the repository; without them these tests are reported as ignored.

mod archive;
mod hdl32e;
mod hdl64e_s1;
mod vlp16;
mod vls128;

use std::path::PathBuf;

use clearway_lidar::capture::{Capture, Datagram};
use clearway_lidar::{Point, Revolution, Sensor, SensorConfig};
use clearway_ros::velodyne_scan::VelodyneScan;

/// Path of a file of the recorded drives.
pub fn data(path: &str) -> PathBuf {
    PathBuf::from(env!("CLEARWAY_DRIVES")).join(path)
}

/// All complete datagrams of a capture.
pub fn datagrams(path: &str) -> Vec<Datagram> {
    let file = std::fs::File::open(data(path)).unwrap();
    Capture::new(file).unwrap().map_while(Result::ok).collect()
}

/// Decodes a stream, and returns all revolutions and the sensor.
pub fn decode<'a>(
    config: SensorConfig,
    stream: impl IntoIterator<Item = (&'a [u8], i64)>,
) -> (Vec<Revolution>, Sensor) {
    let mut sensor = Sensor::new(config);
    let mut revolutions = Vec::new();
    for (payload, stamp_ns) in stream {
        revolutions.extend(sensor.push(payload, stamp_ns).unwrap().cloned());
    }
    revolutions.extend(sensor.finish().cloned());
    (revolutions, sensor)
}

/// Decodes a capture, and returns all revolutions and the sensor.
pub fn decode_capture(config: SensorConfig, path: &str) -> (Vec<Revolution>, Sensor) {
    let datagrams = datagrams(path);
    decode(config, datagrams.iter().map(|datagram| (datagram.payload.as_slice(), datagram.stamp_ns)))
}

/// All points of the revolutions, in order.
pub fn points(revolutions: &[Revolution]) -> Vec<Point> {
    revolutions.iter().flat_map(Revolution::points).collect()
}

/// Distance between two points, in m.
pub fn distance_m(a: [f32; 3], b: [f32; 3]) -> f32 {
    (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f32>().sqrt()
}

/// Median and greatest of the errors, in m; both are printed (`--nocapture`).
pub fn spread(name: &str, mut errors: Vec<f32>) -> (f32, f32) {
    errors.sort_by(f32::total_cmp);
    let (median, greatest) = (errors[errors.len() / 2], *errors.last().unwrap());
    println!("{name}: {} points, median {:.4} mm, greatest {:.4} mm", errors.len(), median * 1e3, greatest * 1e3);
    (median, greatest)
}

/// Compares our points with the points of a reference, which must be a run of our points without a gap, with the same
/// rings, intensities and return types. Returns the distances between points, in m, and the index at which the run
/// begins.
pub fn against(points: &[Point], expected: &[archive::Reference]) -> (Vec<f32>, usize) {
    let same = |point: &Point, expected: &archive::Reference| {
        (point.ring, f32::from(point.intensity), point.return_type)
            == (expected.ring, expected.intensity, expected.return_type)
    };
    let agree =
        |from: usize, n: usize| points[from..].iter().zip(expected).take(n).all(|(ours, theirs)| same(ours, theirs));
    let first = (0..=points.len().saturating_sub(expected.len())).find(|from| agree(*from, 40)).expect("no common run");
    let run = &points[first..first + expected.len()];
    let differing = run.iter().zip(expected).position(|(ours, theirs)| !same(ours, theirs));
    assert_eq!(differing, None, "{:?}", differing.map(|i| (run[i], expected[i])));
    (run.iter().zip(expected).map(|(ours, theirs)| distance_m([ours.x, ours.y, ours.z], theirs.xyz)).collect(), first)
}

/// All packets of the `VelodyneScan` messages of an MCAP recording, with their stamps.
pub fn mcap_packets(path: &str) -> Vec<(i64, Vec<u8>)> {
    let file = std::fs::read(data(path)).unwrap();
    let messages = mcap::MessageStream::new(&file).unwrap().map(Result::unwrap);
    let scans = messages.filter(|message| message.channel.topic == "/velodyne_packets");
    let packets = scans.flat_map(|message| {
        let scan = VelodyneScan::new(&message.data).unwrap();
        scan.packets()
            .map(|packet| packet.map(|(stamp_ns, bytes)| (stamp_ns, bytes.to_vec())).unwrap())
            .collect::<Vec<_>>()
    });
    packets.collect()
}

//! Three VLP-16s compared with VeloView and velodyne-decoder: on a car, indoors, and in dual-return mode.

use clearway_lidar::{Clock, Model, Point, ReturnMode, Revolution, SensorConfig};

use crate::world::{against, archive, data, decode, decode_capture, distance_m, mcap_packets, points, spread};

const ON_A_CAR: &str = "pcap/opendlv/proxy-velodyne16/sampleShort.pcap";
/// Index of the return of the capture at which the frame of VeloView begins.
const FIRST_ECHO_OF_FRAME: usize = 7_924;

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn a_vlp16_decodes_as_in_veloview_up_to_azimuth_rounding() {
    let (revolutions, sensor) = decode_capture(SensorConfig::default(), ON_A_CAR);
    assert_eq!(sensor.status().model, Some(Model::Vlp16));
    let zip = archive::unzip("pcap/opendlv/proxy-velodyne16/sampleVeloViewFrame1.zip");
    let expected = archive::veloview(std::str::from_utf8(&zip["sampleVeloViewFrame1.csv"]).unwrap());
    let points = points(&revolutions);
    let frame = &points[FIRST_ECHO_OF_FRAME..][..expected.len()];

    let mut errors = Vec::new();
    let mut rounded_otherwise = 0;
    for (point, (xyz, intensity)) in frame.iter().zip(&expected) {
        assert_eq!(point.intensity, *intensity);
        let error = distance_m([point.x, point.y, point.z], *xyz);
        // VeloView rounds the azimuth of each return to a hundredth of a degree, and halves to either side.
        assert!(error < 1.01 * point.range_m * 0.01_f32.to_radians() + 1e-4, "{error} m at {} m", point.range_m);
        rounded_otherwise += usize::from(error > 1e-4);
        errors.push(error);
    }
    let (median, _) = spread("VLP-16 against VeloView", errors);
    println!("rounded to the other side: {rounded_otherwise}");
    assert!(median < 1e-5);
    assert!(rounded_otherwise * 100 < 7 * frame.len(), "{rounded_otherwise}");
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn a_vlp16_decodes_as_in_velodyne_decoder_echo_by_echo() {
    for (capture, reference, greatest_m) in [
        (ON_A_CAR, "ref/opendlv__proxy-velodyne16__sampleShort.npz", 0.06),
        ("pcap/rust-lidar-utils/velodyne_example.pcap", "ref/rust-lidar-utils__velodyne_example.npz", 0.03),
    ] {
        let (revolutions, _) = decode_capture(SensorConfig::default(), capture);
        let (points, expected) = (points(&revolutions), archive::reference(reference));
        assert_eq!(points.len(), expected.len());
        let (errors, _) = against(&points, &expected);
        let (median, greatest) = spread(capture, errors);
        // velodyne-decoder adds the heights of the lasers (at most 11.2 mm) and does not use the median step of a
        // packet.
        assert!(median < 0.008 && greatest < greatest_m, "{median} m, {greatest} m");
    }
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn an_echo_that_is_both_strongest_and_last_is_counted_once() {
    let packets = mcap_packets("mcap/nebula_vlp16_zstd.mcap");
    assert_eq!(packets.len(), 603);
    let (revolutions, sensor) =
        decode(SensorConfig::default(), packets.iter().map(|(stamp_ns, bytes)| (bytes.as_slice(), *stamp_ns)));
    assert_eq!(sensor.status().return_mode, Some(ReturnMode::Dual));
    let expected = archive::reference("ref/nebula_vlp16.npz");
    let (errors, first) = against(&last_before_strongest(&revolutions), &expected);
    assert_eq!(first, 0);
    let (median, greatest) = spread("VLP-16 dual against velodyne-decoder", errors);
    assert!(median < 0.008 && greatest < 0.06, "{median} m, {greatest} m");
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn revolutions_between_the_first_and_the_last_are_complete() {
    let (revolutions, sensor) = decode_capture(SensorConfig::default(), ON_A_CAR);
    let partial: Vec<_> = revolutions.iter().map(|revolution| revolution.partial).collect();
    let inner = &revolutions[1..revolutions.len() - 1];
    assert!(inner.iter().all(|revolution| revolution.partial.is_none()), "{partial:?}");
    for revolution in inner {
        assert!((revolution.rpm - 599.0).abs() < 2.0, "{}", revolution.rpm);
        assert!(revolution.firings.len().abs_diff(revolution.firings_expected as usize) <= 2);
        assert!(first_azimuth_deg(revolution) >= 180.0 && first_azimuth_deg(revolution) < 180.25);
    }
    assert!(revolutions.windows(2).all(|pair| pair[0].end_ns < pair[1].start_ns));
    // The GPRMC states 21:41:06 on 23 July 2015.
    assert_eq!(sensor.status().gprmc.unwrap().utc_ns, Some(1_437_687_666_000_000_000));
    // The device time of the first packet is 2,467,108,343 µs past 21 h. The pulse is locked, and the clock of the
    // recording host was 1.4 s behind.
    assert_eq!(revolutions[0].start_ns, 1_437_685_200_000_000_000 + 2_467_108_343_000);
    assert!(revolutions.iter().all(|revolution| revolution.clock == Clock::Gps));
    let offsets: Vec<_> = revolutions.iter().map(|revolution| revolution.clock_offset_ms).collect();
    assert!(offsets.iter().all(|offset| (-1_410..=-1_400).contains(offset)), "{offsets:?}");
    assert_eq!(data(ON_A_CAR).metadata().unwrap().len(), 400_000);
}

/// Points in the order of velodyne-decoder: the last echo of a laser precedes its strongest.
fn last_before_strongest(revolutions: &[Revolution]) -> Vec<Point> {
    let mut firings = 0;
    let mut points = Vec::new();
    for revolution in revolutions {
        points.extend(revolution.points().map(|point| (firings + point.firing, point)));
        firings += revolution.firings.len() as u32;
    }
    points.sort_by_key(|(firing, point)| (*firing, point.laser, point.return_type == 1));
    points.into_iter().map(|(_, point)| point).collect()
}

fn first_azimuth_deg(revolution: &Revolution) -> f32 {
    revolution.firings[0].azimuth_rad.to_degrees()
}

//! An HDL-64E S1 in front of a wall, with its own db.xml, compared with a CSV file of VeloView.

use std::io::Read;

use clearway_lidar::{Calibration, Model, ReturnMode, SensorConfig};

use crate::world::{archive, data, decode_capture, distance_m, points, spread};

const CAPTURE: &str = "pcap/opendlv/proxy-velodyne64/cut_for_developers/atwall_first174packets.pcap";
/// Index of the return of the capture at which the frame of VeloView begins.
const FIRST_ECHO_OF_FRAME: usize = 15_434;

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn an_s1_decodes_as_in_veloview_within_fifty_micrometres() {
    let xml = std::fs::read_to_string(data("pcap/opendlv/proxy-velodyne64/db.xml")).unwrap();
    let calibration = Some(Calibration::load_str(&xml).unwrap());
    let (revolutions, sensor) = decode_capture(SensorConfig { calibration, ..SensorConfig::default() }, CAPTURE);
    assert_eq!(sensor.status().model, Some(Model::Hdl64eS1));
    assert_eq!(sensor.status().return_mode, Some(ReturnMode::Strongest));
    assert_eq!(sensor.status().packets, 174);

    let csv = data("pcap/opendlv/proxy-velodyne64/cut_for_developers/atwallFrame1New_first_rows.csv.gz");
    let mut text = String::new();
    flate2::read::GzDecoder::new(std::fs::File::open(csv).unwrap()).read_to_string(&mut text).unwrap();
    let expected = archive::veloview(&text);
    let points = points(&revolutions);
    assert_eq!(points.len(), 60_480, "all raw distances that are not zero; this part has no filler");
    let points = &points[FIRST_ECHO_OF_FRAME..];
    assert_eq!(points.len(), expected.len());
    let errors = points.iter().zip(&expected).map(|(point, (xyz, intensity))| {
        assert_eq!(point.intensity, *intensity);
        distance_m([point.x, point.y, point.z], *xyz)
    });
    let (_, greatest) = spread("HDL-64E S1 against VeloView", errors.collect());
    assert!(greatest < 5e-5, "{greatest} m");
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn the_rate_of_an_s1_follows_from_arrivals() {
    let (revolutions, sensor) = decode_capture(SensorConfig::default(), CAPTURE);
    assert!((sensor.status().rpm.unwrap() - 592.0).abs() < 6.0, "{:?}", sensor.status().rpm);
    let firings: usize = revolutions.iter().map(|revolution| revolution.firings.len()).sum();
    assert_eq!(firings, 174 * 12, "each block of an S1 is a firing of its own");
    for revolution in &revolutions {
        let unfired = revolution.echoes[0].range_m.iter().filter(|range| range.is_nan()).count();
        assert_eq!(unfired * 2, revolution.echoes[0].range_m.len(), "half of the slots belong to the other block");
    }
}

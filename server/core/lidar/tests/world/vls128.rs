//! A VLS-128 on a car compared with velodyne-decoder.

use clearway_lidar::{Model, ReturnMode, SensorConfig};

use crate::world::{against, archive, decode, mcap_packets, points, spread};

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn a_vls128_decodes_as_in_velodyne_decoder_echo_by_echo() {
    let packets = mcap_packets("mcap/nebula_vls128_none.mcap");
    assert_eq!(packets.len(), 2_193);
    let (revolutions, sensor) =
        decode(SensorConfig::default(), packets.iter().map(|(stamp_ns, bytes)| (bytes.as_slice(), *stamp_ns)));
    assert_eq!(sensor.status().model, Some(Model::Vls128));
    assert_eq!(sensor.status().return_mode, Some(ReturnMode::Strongest));
    let firings: Vec<_> = revolutions.iter().map(|revolution| (revolution.firings.len(), revolution.partial)).collect();
    assert_eq!(firings[1..4], [(1_809, None), (1_810, None), (1_809, None)], "{firings:?}");
    let (errors, first) = against(&points(&revolutions), &archive::reference("ref/nebula_vls128.npz"));
    assert_eq!(first, 0);
    // velodyne-decoder does not correct the azimuths of the first packet, because there is no packet before it.
    let first_packet =
        points(&revolutions).iter().filter(|point| point.firing < 3).take_while(|p| p.firing < 3).count();
    let errors = errors[first_packet..].to_vec();
    let (median, greatest) = spread("VLS-128 against velodyne-decoder", errors);
    assert!(median < 0.005 && greatest < 0.1, "{median} m, {greatest} m");
}

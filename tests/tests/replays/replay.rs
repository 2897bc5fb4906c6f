//! Recorded drives through the whole system: the counts are exact, and errors name the file and what is wrong with it.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use clearway_daemon::record::verify;
use clearway_replay::{Mount, ReplayError, ReplayOptions, ReplaySummary, describe, replay};

use crate::fixture;

async fn replayed(options: ReplayOptions) -> Result<ReplaySummary, ReplayError> {
    fixture::within("replay", replay(options)).await
}

fn drive(path: &str) -> PathBuf {
    Path::new(env!("CLEARWAY_DRIVES")).join(path)
}

const HDL32: &str = "pcap/rust-lidar-utils/hdl32_example.pcap";

#[tokio::test(flavor = "multi_thread")]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
async fn every_packet_of_an_hdl32e_drive_is_decoded_and_its_recording_is_good() {
    let folder = tempfile::tempdir().unwrap();
    let record = folder.path().join("d.mcap");
    let options = ReplayOptions { files: vec![drive(HDL32)], record: Some(record.clone()), ..ReplayOptions::default() };
    let summary = replayed(options).await.unwrap();
    let snapshot = &summary.snapshot;
    assert_eq!((snapshot.ledger.received, snapshot.ledger.decoded, snapshot.ledger.telemetry), (976, 876, 100));
    assert_eq!((snapshot.refused(), snapshot.ledger.lost), (0, 0));
    // 5.7 revolutions: the first and the last are not whole.
    assert_eq!((snapshot.revolutions(), snapshot.maps), (6, 6));
    let sensor = &snapshot.sensors[0].status;
    assert_eq!(sensor.model, Some(clearway_lidar::model::Model::Hdl32e));
    assert!((sensor.rpm.unwrap() - 703.0).abs() < 3.0, "{:?}", sensor.rpm);
    assert!(matches!(summary.mount, Mount::Estimated(_)));
    assert!((1.5..2.5).contains(&summary.extrinsics.z_m), "{:?}", summary.extrinsics);
    assert!(summary.truncated.is_empty());

    let report = verify(&record).unwrap();
    assert!(report.is_good(), "{:?}", report.differences);
    assert_eq!((report.events, report.maps, report.equal), (977, 6, 6 * fixture::LAYERS));
}

#[tokio::test(flavor = "multi_thread")]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
async fn a_capture_and_its_recording_make_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let options = |file: PathBuf, record: &str| ReplayOptions {
        files: vec![file],
        record: Some(at(record)),
        ..ReplayOptions::default()
    };
    replayed(options(drive(HDL32), "a.mcap")).await.unwrap();
    replayed(options(drive(HDL32), "b.mcap")).await.unwrap();
    replayed(options(at("a.mcap"), "c.mcap")).await.unwrap();
    let maps = fixture::recorded(&at("a.mcap"));
    assert_eq!(maps.len(), 6 * fixture::LAYERS as usize);
    assert_eq!(fixture::recorded(&at("b.mcap")), maps);
    assert_eq!(fixture::recorded(&at("c.mcap")), maps);
}

#[tokio::test(flavor = "multi_thread")]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
async fn a_truncated_capture_is_read_to_its_end_and_reported() {
    let folder = tempfile::tempdir().unwrap();
    let cut = folder.path().join("cut.pcap");
    let whole = std::fs::read(drive(HDL32)).unwrap();
    std::fs::write(&cut, &whole[..whole.len() / 2 + 7]).unwrap();
    let summary = replayed(ReplayOptions { files: vec![cut.clone()], ..ReplayOptions::default() }).await.unwrap();
    let ledger = &summary.snapshot.ledger;
    assert_eq!(ledger.received, ledger.decoded + ledger.telemetry);
    assert!((400..976 / 2 + 10).contains(&ledger.received), "{ledger:?}");
    assert_eq!(summary.truncated.len(), 1);
    assert_eq!(summary.truncated[0].file, cut);
    assert!(summary.to_json()["truncated"][0]["reason"].as_str().unwrap().contains("cut off"));
}

#[tokio::test(flavor = "multi_thread")]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
async fn each_scan_of_a_folder_makes_a_map() {
    let options = ReplayOptions { files: vec![drive("kitti/patchwork-plusplus")], ..ReplayOptions::default() };
    let summary = replayed(options).await.unwrap();
    assert_eq!((summary.snapshot.maps, summary.snapshot.ledger.decoded), (3, 3));
    // 1.73 m in KITTI's own calibration.
    assert!((1.6..1.9).contains(&summary.extrinsics.z_m), "{:?}", summary.extrinsics);
}

#[tokio::test(flavor = "multi_thread")]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
async fn a_nuscenes_scan_faces_forward_and_its_own_rings_make_the_rows() {
    let summary =
        replayed(ReplayOptions { files: vec![drive("nuscenes/mmdet3d")], ..ReplayOptions::default() }).await.unwrap();
    assert_eq!((summary.snapshot.maps, summary.snapshot.sensors[0].status.returns), (1, 34_688));
    // nuScenes' own calibration: 1.84 m over the ground, and the y axis of the sensor points forward.
    assert!((summary.extrinsics.z_m - 1.84).abs() < 0.05, "{:?}", summary.extrinsics);
    assert!((summary.extrinsics.yaw_deg + 90.0).abs() < 0.5, "{:?}", summary.extrinsics);
    assert_eq!(summary.to_json()["sensors"][0]["elevations"], "rings");
    assert!(summary.to_json()["mount"]["roll_std_deg"].as_f64().unwrap() < 1.0, "{}", summary.to_json()["mount"]);
    let options = ReplayOptions {
        files: vec![drive("nuscenes/mmdet3d")],
        model: Some("hdl32e".parse().unwrap()),
        ..ReplayOptions::default()
    };
    let modelled = replayed(options).await.unwrap();
    assert_eq!(modelled.to_json()["sensors"][0]["elevations"], "model");
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn scans_of_another_model_than_the_given_one_are_no_success_and_the_model_is_named() {
    let folder = drive("kitti/patchwork-plusplus");
    let arguments = ["replay", ".", "--model", "vlp16", "--extrinsics", "0,0,1.73,0,0,0"];
    let output = clearway_tests::run(&folder, "clearway", &arguments);
    let said = String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
    assert!(output.status.code() == Some(2) && said.contains("the configured model vlp16"), "{said}");
    assert!(said.contains("3 for scan_model") && said.contains("has 16 lasers"), "{said}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_bin_file_that_is_no_scan_is_refused_with_the_reason() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("0.bin");
    // x y z without an intensity.
    let floats = (0..1600).flat_map(|i| [-5.0f32, (i % 50) as f32 * 0.1 - 2.5, -1.7]);
    std::fs::write(&file, floats.flat_map(f32::to_le_bytes).collect::<Vec<u8>>()).unwrap();
    let error =
        replayed(ReplayOptions { files: vec![file], ..ReplayOptions::default() }).await.unwrap_err().to_string();
    assert!(error.contains("0.bin: neither a KITTI scan") && error.contains("intensity = -"), "{error}");
}

#[tokio::test(flavor = "multi_thread")]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
async fn the_packets_of_velodyne_scan_messages_make_maps() {
    let options = ReplayOptions { files: vec![drive("mcap/nebula_vls128_none.mcap")], ..ReplayOptions::default() };
    let summary = replayed(options).await.unwrap();
    assert_eq!((summary.snapshot.ledger.received, summary.snapshot.ledger.decoded), (2193, 2193));
    assert!(summary.snapshot.maps > 0 && summary.snapshot.sensors[0].status.returns > 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_file_of_an_unknown_format_is_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("drive.pcap");
    std::fs::write(&file, b"this is no capture at all").unwrap();
    let error =
        replayed(ReplayOptions { files: vec![file], ..ReplayOptions::default() }).await.unwrap_err().to_string();
    assert!(error.contains("drive.pcap") && error.contains("pcap or pcapng is allowed"), "{error}");
    let missing = ReplayOptions { files: vec![PathBuf::from("/no/such.pcap")], ..ReplayOptions::default() };
    assert!(replayed(missing).await.unwrap_err().to_string().contains("/no/such.pcap"));
}

#[tokio::test(flavor = "multi_thread")]
async fn without_ground_no_map_is_made_and_the_extrinsics_are_requested() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("wall.bin");
    let points = (0..2000).map(|i| [5.0f32, (i % 50) as f32 * 0.1 - 2.5, (i / 50) as f32 * 0.1, 0.5]);
    let bytes: Vec<u8> = points.flatten().flat_map(|value| value.to_le_bytes()).collect();
    std::fs::write(&file, bytes).unwrap();
    let summary = replayed(ReplayOptions { files: vec![file], ..ReplayOptions::default() }).await.unwrap();
    assert_eq!((summary.snapshot.ledger.decoded, summary.snapshot.maps), (1, 0));
    assert!(matches!(summary.mount, Mount::Unknown(_)), "{:?}", summary.mount);
    let said = describe(&summary.mount).unwrap();
    assert!(said.contains("--extrinsics x,y,z,roll,pitch,yaw"), "{said}");
}

/// WIRE.md: a map with every default layer travels in one zenoh frame and one DDS-sized burst.
#[tokio::test(flavor = "multi_thread")]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
async fn a_map_of_all_default_layers_is_at_most_64_kib_except_of_a_vls128() {
    // A map of a VLS-128 is a fifth larger than 64 KiB; it must not grow.
    for (file, allowed) in [(HDL32, 64), ("kitti/udacity_data_2", 64), ("mcap/nebula_vls128_none.mcap", 80)] {
        let folder = tempfile::tempdir().unwrap();
        let record = folder.path().join("sizes.mcap");
        let options =
            ReplayOptions { files: vec![drive(file)], record: Some(record.clone()), ..ReplayOptions::default() };
        replayed(options).await.unwrap();
        let (mut whole, mut most) = (BTreeMap::<u64, usize>::new(), BTreeMap::<String, usize>::new());
        for ((sequence, layer), bytes) in fixture::recorded(&record) {
            // Each layer is recorded with the header, which a whole map has once.
            *whole.entry(sequence).or_default() += bytes.len();
            let most = most.entry(layer).or_default();
            *most = bytes.len().max(*most);
        }
        let largest = whole.values().max().unwrap();
        println!("{file}: {largest} bytes at most in {} maps; by layer {most:?}", whole.len());
        assert!(*largest <= allowed << 10, "{file}: {largest}");
        assert!(most["safe_path"] <= 9_000, "{file}: {most:?}");
    }
}

#[test]
fn a_replay_replaces_neither_its_input_nor_an_existing_file() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let replay = |arguments: &[&str]| {
        let output = clearway_tests::run(folder.path(), "clearway", &[&["replay"], arguments].concat());
        (output.status.success(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    let simulated = clearway_tests::run(
        folder.path(),
        "clearway",
        &["simulate", "town", "--sensor", "vlp16", "--seconds", "1", "--out", "drive.pcap"],
    );
    assert!(simulated.status.success(), "{}", String::from_utf8_lossy(&simulated.stderr));
    let (recorded, error) = replay(&["drive.pcap", "--record", "a.mcap"]);
    assert!(recorded, "{error}");
    let bytes = std::fs::read(at("a.mcap")).unwrap();
    std::fs::hard_link(at("a.mcap"), at("hard.mcap")).unwrap();
    std::os::unix::fs::symlink("a.mcap", at("soft.mcap")).unwrap();
    std::fs::write(at("old.mcap"), "old").unwrap();
    std::os::unix::fs::symlink("old.mcap", at("other.mcap")).unwrap();
    std::fs::write(at("later.part-0002.mcap"), "old").unwrap();
    std::fs::write(at("busy.unfinished.mcap"), "all that a crash has left").unwrap();
    for (output, expected) in [
        ("a.mcap", "the file exists and is not overwritten; name another file, or delete it"),
        ("hard.mcap", "exists"),
        ("soft.mcap", "exists"),
        ("./new/../a.mcap", "exists"),
        ("drive.pcap", "exists"),
        ("folder/", "name a file"),
        ("other.mcap", "exists"),
        ("later.mcap", "parts of an earlier recording of this name are beside it"),
        ("busy.mcap", "parts of an earlier recording of this name are beside it"),
        ("busy.unfinished.mcap", "a recording that is being written"),
    ] {
        let (success, error) = replay(&["a.mcap", "--record", output]);
        assert!(!success && error.contains(expected), "{output}: {error}");
        assert_eq!(std::fs::read(at("a.mcap")).unwrap(), bytes, "{output}: the input is unchanged");
    }
    assert_eq!(std::fs::read(at("old.mcap")).unwrap(), b"old");
    for file in ["drive.pcap", "soft.mcap"] {
        let served = ["--serve", "--any-port", "--exit-at-end", "--ready-file", file];
        let (success, error) = replay(&[&["drive.pcap"][..], &served].concat());
        assert!(!success && error.contains("--ready-file ") && error.contains("is not overwritten"), "{error}");
    }
    let left = std::fs::read(at("busy.unfinished.mcap")).unwrap();
    assert_eq!(left, b"all that a crash has left");
    std::fs::remove_file(at("busy.unfinished.mcap")).unwrap();
    // A capture with bytes that are no packet is replayed up to these.
    let capture = std::fs::read(at("drive.pcap")).unwrap();
    let middle = capture.len() / 2;
    std::fs::write(at("junk.pcap"), [&capture[..middle], &[0xee; 500], &capture[middle..]].concat()).unwrap();
    let junk = clearway_tests::run(folder.path(), "clearway", &["replay", "junk.pcap", "--json"]);
    let [said, error] = [junk.stdout, junk.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
    let summary: serde_json::Value = serde_json::from_str(&said).unwrap_or_else(|_| panic!("{said}{error}"));
    assert!(junk.status.code() == Some(2) && summary["maps"].as_u64() > Some(0), "{said}");
    assert!(error.contains("the capture is damaged at byte") && error.contains("the rest was used"), "{error}");
    // The options set the recorder of a replay.
    let (success, error) = replay(&["a.mcap", "--record", "digests.mcap", "--set", "recorder.maps=digest"]);
    assert!(success, "{error}");
    assert_eq!(verify(&at("digests.mcap")).unwrap().recorded, clearway_journal::RecordedMaps::Digest);
    let verify = clearway_tests::run(folder.path(), "clearway", &["verify", "a.mcap", "--junit", "a.mcap"]);
    assert!(String::from_utf8_lossy(&verify.stderr).contains("is not an earlier report"), "{verify:?}");
    assert_eq!(std::fs::read(at("a.mcap")).unwrap(), bytes, "the recording is unchanged");
    let (success, error) = replay(&[".", "--record", "b.mcap"]);
    assert!(!success && error.contains("the folder . is replayed"), "{error}");
}

#[test]
fn every_command_knows_a_capture_by_its_first_bytes_and_says_if_it_is_empty() {
    let folder = tempfile::tempdir().unwrap();
    // The header of a pcap with Ethernet frames, and nothing behind it.
    let header = [&[0xd4, 0xc3, 0xb2, 0xa1, 2, 0, 4, 0][..], &[0; 8], &[0xff, 0xff, 0, 0, 1, 0, 0, 0]].concat();
    std::fs::write(folder.path().join("drive.mcap"), header).unwrap();
    for (command, more, code, expected) in [
        ("info", &[][..], 0, "kind: capture"),
        ("replay", &[], 2, "the files hold no packet, scan or message that is read"),
        ("send", &["--to", "udp://127.0.0.1:9"], 2, "has no Velodyne datagram"),
    ] {
        let output = clearway_tests::run(folder.path(), "clearway", &[&[command, "drive.mcap"], more].concat());
        let said = String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
        assert!(output.status.code() == Some(code) && said.contains(expected), "{command}: {said}");
    }
}

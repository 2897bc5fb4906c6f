//! Files of a folder: formats that must be converted, a drive in two formats, bags of a crash, scans without returns.

use std::path::{Path, PathBuf};

use clearway_replay::ReplayOptions;
use rusqlite::Connection;

use super::scene::*;

async fn error_of(file: &Path) -> String {
    let options = ReplayOptions { files: vec![file.to_owned()], ..ReplayOptions::default() };
    replayed(options).await.unwrap_err().to_string()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_file_that_must_be_converted_is_named_with_the_command() {
    let folder = tempfile::tempdir().unwrap();
    let cases: [(&str, &[u8], &str); 4] = [
        ("bag_0.db3.zstd", &[0x28, 0xb5, 0x2f, 0xfd, 0], "`zstd -d"),
        ("bag_0.mcap.zstd", &[0x28, 0xb5, 0x2f, 0xfd, 1], "`zstd -d"),
        ("drive.pcap.gz", &[0x1f, 0x8b, 8, 0], "`gunzip -k"),
        ("drive.bag", b"#ROSBAG V2.0\n", "`rosbags-convert"),
    ];
    for (name, bytes, command) in cases {
        let own = folder.path().join(name.replace('.', "_"));
        std::fs::create_dir(&own).unwrap();
        std::fs::write(own.join(name), bytes).unwrap();
        std::fs::write(own.join("metadata.yaml"), "rosbag2_bagfile_information:\n").unwrap();
        for named in [own.join(name), own] {
            let said = error_of(&named).await;
            assert!(said.contains(command) && said.contains(name), "{}: {said}", named.display());
        }
    }
}

/// Writes the messages as rosbag2 does, with a log of its own that no checkpoint has emptied if `is_crashed`.
fn write_sqlite(file: &Path, messages: &[Message], is_crashed: bool) {
    let bag = Connection::open(file).unwrap();
    let wal = if is_crashed { "PRAGMA journal_mode=WAL; PRAGMA wal_autocheckpoint=0;" } else { "" };
    let tables = "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);
        CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);";
    bag.execute_batch(&format!("{wal}{tables}BEGIN;")).unwrap();
    let mut topics: Vec<&str> = Vec::new();
    for (topic, kind, log_ns, bytes) in messages {
        let known = topics.iter().position(|of| of == topic);
        let id = known.unwrap_or(topics.len()) as i64;
        if known.is_none() {
            topics.push(topic);
            bag.execute("INSERT INTO topics VALUES (?1, ?2, ?3, 'cdr')", (id, topic, kind)).unwrap();
        }
        bag.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (?1, ?2, ?3)", (id, log_ns, bytes))
            .unwrap();
    }
    bag.execute_batch("COMMIT;").unwrap();
    if is_crashed {
        // A closed bag has no log: the copy is the bag of a recorder that was killed.
        let copy = |ending: &str| {
            let beside = |name: &str| PathBuf::from(format!("{}{name}", file.display()));
            std::fs::copy(beside(ending), beside(&format!(".copy{ending}"))).unwrap();
        };
        ["", "-wal"].into_iter().for_each(copy);
    }
}

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[tokio::test(flavor = "multi_thread")]
async fn the_bag_of_a_crash_is_read_and_nothing_is_left_beside_it() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::create_dir(at("bag")).unwrap();
    write_sqlite(&at("a.db3"), &drive_of(3, |ns| velodyne("velodyne", ns)), true);
    std::fs::rename(at("a.db3.copy"), at("bag/a.db3")).unwrap();
    std::fs::rename(at("a.db3.copy-wal"), at("bag/a.db3-wal")).unwrap();
    let options = ReplayOptions { files: vec![at("bag")], ..ReplayOptions::default() };
    let (_, headers) = replayed(options).await.unwrap();
    assert_eq!((headers.len(), names(&at("bag"))), (3, vec!["a.db3".to_owned(), "a.db3-wal".to_owned()]));
}

#[tokio::test(flavor = "multi_thread")]
async fn one_drive_in_two_formats_is_refused_and_a_split_bag_is_not() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let messages = drive_of(4, |ns| velodyne("velodyne", ns));
    write_sqlite(&at("drive.db3"), &messages, false);
    write_bag(&at("drive.mcap"), messages.clone(), "cdr");
    let said = error_of(folder.path()).await;
    assert!(said.contains("drive.mcap: it begins") && said.contains("each drive in one format"), "{said}");

    let split = tempfile::tempdir().unwrap();
    let half_ns = START_NS + 2 * SCAN_NS;
    // The second file begins 50 ms before the end of the first.
    let (first, second): (Vec<_>, Vec<_>) = messages
        .into_iter()
        .partition(|(topic, _, log_ns, _)| *log_ns <= half_ns || (*topic == "/tf" && *log_ns <= half_ns + 50_000_000));
    let late = |(topic, kind, log_ns, bytes): Message| (topic, kind, log_ns - 50_000_000, bytes);
    write_bag(&split.path().join("bag_0.mcap"), first, "cdr");
    write_bag(&split.path().join("bag_1.mcap"), second.into_iter().map(late).collect(), "cdr");
    let metadata = "rosbag2_bagfile_information:\n  relative_file_paths:\n    - bag_0.mcap\n    - bag_1.mcap\n";
    let (file, options) = (split.path().join("metadata.yaml"), || ReplayOptions {
        files: vec![split.path().to_owned()],
        ..ReplayOptions::default()
    });
    std::fs::write(&file, format!("{metadata}  duration:\n")).unwrap();
    // What a macOS computer adds to a copied file.
    std::fs::write(split.path().join("._bag_0.mcap"), "no bag").unwrap();
    let (summary, headers) = replayed(options()).await.unwrap();
    assert_eq!((headers.len(), summary.truncated.len()), (4, 0));
    // A part that metadata.yaml names and the folder does not have.
    std::fs::write(&file, format!("{metadata}    - bag_2.mcap\n  duration:\n")).unwrap();
    let (summary, headers) = replayed(options()).await.unwrap();
    let missing: Vec<_> = summary.truncated.iter().map(|of| of.file.file_name().unwrap()).collect();
    assert_eq!((headers.len(), missing), (4, vec!["bag_2.mcap".as_ref()]));
}

/// A drive of the sensor `velodyne`, in which the poses and the sensor `rear` begin this time after the start.
fn drive_that_grows(late_ns: i64) -> Vec<Message> {
    let mut messages = vec![mount("velodyne", LEVEL), mount("rear", LEVEL)];
    let is_late = |(_, _, log_ns, _): &Message| *log_ns >= START_NS + late_ns;
    messages.extend(tf_poses(late_ns + 4 * SCAN_NS, |_| 0).into_iter().filter(is_late));
    for at_ns in [0, 1, 2].into_iter().flat_map(|scan| [scan * SCAN_NS, late_ns + scan * SCAN_NS]) {
        let (stamp_ns, end_ns) = (START_NS + at_ns, START_NS + at_ns + SCAN_NS);
        messages.push(("/points", CLOUD, end_ns, velodyne("velodyne", stamp_ns).to_cdr()));
        if at_ns >= late_ns {
            messages.push(("/rear/points", CLOUD, end_ns - 1, velodyne("rear", stamp_ns).to_cdr()));
        }
    }
    messages
}

#[tokio::test(flavor = "multi_thread")]
async fn a_topic_that_begins_late_is_used_also_if_it_begins_in_a_later_file() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let late = drive_that_grows(12_000_000_000);
    let mut sorted = late.clone();
    sorted.sort_by_key(|(_, _, log_ns, _)| *log_ns);
    write_bag(&at("late.mcap"), late, "cdr");
    write_sqlite(&at("late.db3"), &sorted, false);
    // A bag whose first file has one sensor and no poses, and a bag whose first file has no sensor.
    let halves = |name: &str, is_first: fn(&Message) -> bool| {
        std::fs::create_dir(at(name)).unwrap();
        let (first, second) = drive_that_grows(5 * SCAN_NS).into_iter().partition::<Vec<_>, _>(is_first);
        write_bag(&at(name).join("bag_0.mcap"), first, "cdr");
        write_bag(&at(name).join("bag_1.mcap"), second, "cdr");
    };
    halves("grows", |(_, _, log_ns, _)| *log_ns < START_NS + 5 * SCAN_NS);
    halves("begins", |(topic, _, log_ns, _)| *topic == "/tf_static" && *log_ns == START_NS);
    for name in ["late.mcap", "late.db3", "grows", "begins"] {
        let files = vec![at(name)];
        let (summary, headers) = replayed(ReplayOptions { files, ..ReplayOptions::default() }).await.unwrap();
        let newest = headers.last().unwrap_or_else(|| panic!("{name} has no map: {:?}", summary.notes));
        let rear = newest.sensors.iter().find(|sensor| sensor.name == "rear").map(|sensor| sensor.returns);
        assert!(rear.is_some_and(|returns| returns > 0), "{name}: {rear:?} returns of rear, {:?}", summary.notes);
        assert_eq!(newest.compensation, "poses", "{name}: {:?}", summary.notes);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn empty_lines_lost_returns_and_a_wrong_ring_cost_no_scan() {
    let folder = tempfile::tempdir().unwrap();
    let returns: Vec<[f32; 3]> = rays(16).iter().filter_map(|ray| ray.at).collect();
    let head = format!("FIELDS x y z ring\nSIZE 4 4 4 4\nTYPE F F F F\nPOINTS {}\nDATA ascii\n\n", returns.len());
    let lines = returns.iter().enumerate().map(|(index, [x, y, z])| {
        let ring = if index == 7 { "0.5" } else { "3" };
        format!("{x} {y} {z} {ring}\n{}", if index == 20 { "\n" } else { "" })
    });
    std::fs::write(folder.path().join("a.pcd"), head + &lines.collect::<String>()).unwrap();
    let kitti = rays(16).into_iter().flat_map(|ray| match ray.at {
        Some([x, y, z]) => [x, y, z, 0.5],
        None => [f32::NAN, f32::NAN, f32::NAN, 0.0],
    });
    std::fs::write(folder.path().join("a.bin"), kitti.flat_map(f32::to_le_bytes).collect::<Vec<u8>>()).unwrap();
    for (name, wrong) in [("a.pcd", 1), ("a.bin", 0)] {
        let files = vec![folder.path().join(name)];
        let options = ReplayOptions { files, extrinsics: Some(LEVEL_MOUNT), ..ReplayOptions::default() };
        let (summary, headers) = replayed(options).await.unwrap();
        let expected = (1, returns.len() as u64 - wrong);
        assert_eq!((headers.len(), summary.snapshot.sensors[0].status.returns), expected, "{name}");
    }
}

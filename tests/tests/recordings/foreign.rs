//! Files of other programs: MCAP in each form that the format allows, and ROS 2 bags in sqlite, whole and split.

use std::io::{Cursor, Write};
use std::path::{Path, PathBuf};

use clearway_daemon::ingest::queue::Reading;
use clearway_journal::mcap_reader::McapReader;
use clearway_journal::repair::repair;
use clearway_replay::files::Readings;
use clearway_replay::files::mcap::McapOptions;
use mcap::WriteOptions;
use mcap::records::op;
use rusqlite::Connection;

const DATA: &str = env!("CLEARWAY_DRIVES");
const BAG: &str = "ros2bag/nebula/decoder_ground_truth/vlp16/1673400471837873222/1673400471837873222_0.db3";

/// The same four scans of a VLP-16, as MCAP with zstd and as a bag in sqlite.
fn nebula() -> [PathBuf; 2] {
    ["mcap/nebula_vlp16_zstd.mcap", BAG].map(|file| Path::new(DATA).join(file))
}

fn readings(file: &Path) -> Vec<Reading> {
    let options = McapOptions { sensors_max: 1, ..McapOptions::default() };
    let mut readings = Readings::open(&[file.to_owned()], options).unwrap();
    let all: Vec<_> = readings.by_ref().collect::<Result<_, _>>().unwrap();
    assert_eq!(readings.truncated(), []);
    all
}

/// The messages of an MCAP file, written again with these options.
fn written(file: &Path, options: WriteOptions) -> Vec<u8> {
    let bytes = std::fs::read(file).unwrap();
    let mut writer = options.compression_threads(0).create(Cursor::new(Vec::new())).unwrap();
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        writer.write(&message.unwrap()).unwrap();
    }
    writer.finish().unwrap();
    writer.into_inner().into_inner()
}

/// An MCAP file without compression, with the content of each chunk as an LZ4 frame, up to the end of its data.
fn in_lz4(bytes: &[u8]) -> Vec<u8> {
    let mut file = bytes[..8].to_vec();
    let mut rest = &bytes[8..];
    loop {
        let length = u64::from_le_bytes(rest[1..9].try_into().unwrap()) as usize;
        let (record, next) = rest.split_at(9 + length);
        rest = next;
        match record[0] {
            op::CHUNK => {
                // Two times, the size, the CRC; then the name of the compression, which is empty, and the data.
                let mut frame = lz4_flex::frame::FrameEncoder::new(Vec::new());
                frame.write_all(&record[9 + 40..]).unwrap();
                let data = frame.finish().unwrap();
                let fields =
                    [&record[9..9 + 28], &3_u32.to_le_bytes(), b"lz4", &(data.len() as u64).to_le_bytes(), &data];
                let body = fields.concat();
                file.push(op::CHUNK);
                file.extend((body.len() as u64).to_le_bytes());
                file.extend(body);
            }
            op::DATA_END => break,
            // The indexes have positions in the chunks as they were.
            op::MESSAGE_INDEX => {}
            _ => file.extend(record),
        }
    }
    let footer = [&[op::DATA_END][..], &4_u64.to_le_bytes(), &[0; 4], &[op::FOOTER], &20_u64.to_le_bytes(), &[0; 20]];
    file.extend(footer.concat());
    file.extend(mcap::MAGIC);
    file
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn every_form_of_mcap_is_read_alike() {
    let folder = tempfile::tempdir().unwrap();
    let [original, _] = nebula();
    let expected = readings(&original);
    assert!(expected.len() > 600, "{} packets", expected.len());
    let plain = || WriteOptions::new().compression(None);
    let without_index = || plain().emit_message_indexes(false).emit_summary_records(false).emit_summary_offsets(false);
    let forms = [
        ("lz4", in_lz4(&written(&original, plain().chunk_size(Some(200_000))))),
        ("unchunked", written(&original, plain().use_chunks(false))),
        ("unindexed", written(&original, without_index())),
        ("unchunked_unindexed", written(&original, without_index().use_chunks(false))),
    ];
    for (name, bytes) in forms {
        let file = folder.path().join(name);
        std::fs::write(&file, bytes).unwrap();
        assert!(readings(&file) == expected, "{name}");
    }
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn a_bag_in_sqlite_is_read_like_the_mcap_file_of_its_messages() {
    let [mcap, bag] = nebula();
    let messages = |file: &Path| -> Vec<_> {
        let mut reader = McapReader::open(file).unwrap();
        let messages = reader.by_ref().map(|message| message.unwrap());
        let messages = messages.map(|m| (m.channel.topic.clone(), m.channel.schema.clone(), m.log_ns, m.data));
        let messages = messages.collect();
        assert_eq!(reader.incomplete(), None);
        messages
    };
    assert!(messages(&bag) == messages(&mcap));
    assert!(readings(&bag) == readings(&mcap));
    let folder = tempfile::tempdir().unwrap();
    let unsorted = folder.path().join("unsorted.db3");
    std::fs::copy(&bag, &unsorted).unwrap();
    let sqlite = Connection::open(&unsorted).unwrap();
    sqlite.execute_batch("DROP INDEX timestamp_idx; UPDATE messages SET id = -id").unwrap();
    drop(sqlite);
    assert!(messages(&unsorted) == messages(&mcap), "without an index of the times, in another order");
    // `repair` therefore converts a bag.
    let converted = folder.path().join("converted.mcap");
    assert_eq!(repair(&bag, &converted).unwrap().messages, 4);
    assert!(messages(&converted) == messages(&mcap));
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn a_folder_of_a_split_bag_is_one_drive_in_the_order_of_its_numbers() {
    let folder = tempfile::tempdir().unwrap();
    let [_, bag] = nebula();
    for (number, id) in (8..).zip(1..=4) {
        let part = folder.path().join(format!("drive_{number}.db3"));
        // The data is read-only, and so would be a copy that keeps its mode.
        std::fs::write(&part, std::fs::read(&bag).unwrap()).unwrap();
        Connection::open(part).unwrap().execute("DELETE FROM messages WHERE id <> ?1", [id]).unwrap();
    }
    std::fs::write(folder.path().join("metadata.yaml"), "rosbag2_bagfile_information:\n").unwrap();
    assert!(readings(folder.path()) == readings(&bag));
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn a_damaged_bag_is_named_and_is_read_up_to_the_damage() {
    let folder = tempfile::tempdir().unwrap();
    let [_, bag] = nebula();
    let (damaged, other) = (folder.path().join("damaged.db3"), folder.path().join("other.db3"));
    let bytes = std::fs::read(&bag).unwrap();
    std::fs::write(&damaged, &bytes[..bytes.len() / 2]).unwrap();
    // Whether sqlite opens the file, and finds the first messages, depends on where the cut is.
    match McapReader::open(&damaged) {
        Err(error) => assert!(error.to_string().contains("damaged.db3: not a ROS 2 bag"), "{error}"),
        Ok(mut reader) => {
            let read = reader.by_ref().filter_map(Result::ok).count();
            let incomplete = reader.incomplete().expect("the cut is named");
            assert!(read < 4 && incomplete.contains("cannot be read"), "{read}: {incomplete}");
        }
    }
    Connection::open(&other).unwrap().execute("CREATE TABLE notes (text)", []).unwrap();
    let error = McapReader::open(&other).err().expect("no bag").to_string();
    assert!(error.contains("other.db3") && error.contains("no such table: topics"), "{error}");
}

#[test]
fn of_a_bag_with_a_damaged_page_the_messages_that_cannot_be_read_are_counted() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("bag_0.db3");
    let bag = Connection::open(&file).unwrap();
    let tables = "CREATE TABLE topics (id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);
        CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);
        CREATE INDEX timestamp_idx ON messages (timestamp);
        INSERT INTO topics VALUES (1, '/points', 'sensor_msgs/msg/PointCloud2', 'cdr');";
    bag.execute_batch(tables).unwrap();
    for message in 0..100 {
        let data = [message; 20_000];
        bag.execute("INSERT INTO messages VALUES (?1, 1, ?2, ?3)", (message, i64::from(message) + 1, &data[..]))
            .unwrap();
    }
    drop(bag);
    let mut bytes = std::fs::read(&file).unwrap();
    // The pages of 4096 bytes that follow the first one of a message begin with the number of the next page.
    let page = bytes.chunks(4096).position(|page| page[4..].iter().all(|byte| *byte == 70)).unwrap();
    bytes[page * 4096..(page + 1) * 4096].fill(0);
    std::fs::write(&file, &bytes).unwrap();
    let mut reader = McapReader::open(&file).unwrap();
    let read = reader.by_ref().filter_map(Result::ok).count();
    let incomplete = reader.incomplete().expect("the damage is named");
    assert!(incomplete.contains(&format!("{} messages after the time {read}", 100 - read)), "{read}: {incomplete}");
    assert!(read >= 64, "{read}: a batch before the damage is read");
}

#[test]
fn a_bag_that_computes_what_it_holds_is_refused_by_name() {
    let topics = "CREATE TABLE topics (id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);
        INSERT INTO topics VALUES (1, '/points', 'sensor_msgs/msg/PointCloud2', 'cdr');";
    let table = "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB";
    let endless = "WITH RECURSIVE n (i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i, 1, i, zeroblob(9) FROM n";
    for (messages, named) in [
        (
            format!("CREATE VIEW Messages (id, topic_id, timestamp, data) AS {endless}"),
            "\"Messages\" is no plain table",
        ),
        (
            table.replace(" BLOB", " AS (zeroblob(500000000)))") + "; INSERT INTO messages VALUES (1, 1, 1)",
            "\"messages\" is no plain table",
        ),
        (
            format!("{table}); INSERT INTO messages VALUES (1, 1, 1, zeroblob(65 << 20))"),
            "1 message cannot be read: string or blob too big",
        ),
        (
            format!(
                "{table}); WITH RECURSIVE n (i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n LIMIT 250001)
                INSERT INTO messages SELECT i, 1, i, NULL FROM n"
            ),
            "no index of their times",
        ),
        (format!("{table}); UPDATE topics SET name = hex(zeroblob(600))"), "a name of 1200 bytes, of at most 1024"),
    ] {
        let file = tempfile::NamedTempFile::new().unwrap();
        Connection::open(file.path()).unwrap().execute_batch(&format!("{topics} {messages}")).unwrap();
        let refused = match McapReader::open(file.path()) {
            Err(error) => error.to_string(),
            Ok(mut reader) => {
                assert_eq!(reader.by_ref().count(), 0);
                reader.incomplete().expect("it is named")
            }
        };
        assert!(refused.contains(named), "{refused}");
    }
}

#[test]
fn a_file_that_decompresses_to_far_more_than_it_has_is_read_up_to_there() {
    let folder = tempfile::tempdir().unwrap();
    let zeros = vec![0; 40 << 20];
    let mcap = folder.path().join("bomb.mcap");
    let options = WriteOptions::new().compression(Some(mcap::Compression::Zstd)).compression_threads(0);
    let mut writer = options.create(std::fs::File::create(&mcap).unwrap()).unwrap();
    let channel = writer.add_channel(0, "/points", "", &Default::default()).unwrap();
    let bag = folder.path().join("bomb.db3");
    let tables = "CREATE TABLE topics (id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);
        CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);
        INSERT INTO topics VALUES (1, '/points', '', '');";
    let messages = Connection::open(&bag).unwrap();
    messages.execute_batch(tables).unwrap();
    let frame = zstd::bulk::compress(&zeros, 1).unwrap();
    for time in 1..=3_u32 {
        let header = mcap::records::MessageHeader {
            channel_id: channel,
            sequence: time,
            log_time: time.into(),
            publish_time: time.into(),
        };
        writer.write_to_known_channel(&header, &zeros).unwrap();
        messages.execute("INSERT INTO messages VALUES (?1, 1, ?1, ?2)", (time, &frame)).unwrap();
    }
    writer.finish().unwrap();
    for file in [&mcap, &bag] {
        let mut reader = McapReader::open(file).unwrap();
        assert_eq!(reader.by_ref().count(), 1, "{}", file.display());
        let incomplete = reader.incomplete().expect("the rest is named");
        assert!(incomplete.contains("decompresses to far too much"), "{incomplete}");
    }
}

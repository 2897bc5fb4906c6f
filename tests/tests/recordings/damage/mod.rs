//! A damaged recording: what is wrong is named, the rest is read, and the exit code is never 0.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use clearway_daemon::record::{run_config, verify};
use clearway_journal::mcap_reader::McapReader;
use clearway_journal::reader::{RecordedMessage, RecordingReader};
use clearway_journal::repair::repair;
use clearway_mapping::pipeline::Pipeline;
use clearway_proto::codec::Limits;
use clearway_proto::map::decode_map;
use clearway_tests::damage::{self, Original, rechunk};
use clearway_tests::{run, workspace};
use mcap::records::op;
use proptest::prelude::*;
use proptest::test_runner::TestRunner;

mod changed;

/// Events and maps of the golden recording.
const GOLDEN: (u64, u64) = (172, 3);

fn golden() -> PathBuf {
    workspace().join("tests/golden/drive.mcap")
}

/// The golden recording in many chunks.
fn in_chunks() -> Vec<u8> {
    rechunk(&std::fs::read(golden()).unwrap(), 16 << 10).unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Position of each record of this kind outside of chunks.
fn records(bytes: &[u8], kind: u8) -> Vec<usize> {
    damage::records(bytes).into_iter().filter(|(of, _)| *of == kind).map(|(_, at)| at).collect()
}

/// The recording of the first version of format 1, with maps of that version.
fn oldest() -> PathBuf {
    workspace().join("tests/golden/format_1.mcap")
}

#[test]
fn the_golden_recordings_are_read_by_every_version() {
    read_whole(&golden(), &["freespace"]);
    read_whole(&oldest(), &[]);
    // Maps of another version are differences, and the result says which version made them.
    let folder = tempfile::tempdir().unwrap();
    let verified = run(folder.path(), "clearway", &["verify", oldest().to_str().unwrap()]);
    let said = text(&verified.stdout);
    assert_eq!(verified.status.code(), Some(1), "{said}");
    assert!(said.contains(" recorded the file, "), "{said}");
}

/// Reads all events and maps of a golden recording, whose program had these layers beside the first layers.
fn read_whole(file: &Path, more_layers: &[&str]) {
    let mut recording = RecordingReader::open(file).unwrap();
    let (config, tables) = run_config(&recording).unwrap();
    let mut pipeline = Pipeline::new(&config.vehicles[0].core(), tables[0].clone()).unwrap();
    let (mut events, mut computed, mut layers) = (0, 0, BTreeMap::<String, u64>::new());
    for message in recording.by_ref() {
        match message.unwrap() {
            RecordedMessage::Event { event, .. } => {
                events += 1;
                computed += u64::from(pipeline.step(&event).unwrap().is_some());
            }
            RecordedMessage::Map { layer, bytes, .. } => {
                let map = decode_map(bytes, &Limits::default()).unwrap();
                assert!(map.layers[0].name == layer && !map.layers[0].channels.is_empty());
                *layers.entry(layer).or_default() += 1;
            }
            RecordedMessage::Keyframe { .. } | RecordedMessage::Counts(_) => {}
            RecordedMessage::Digest { .. } => panic!("it has maps"),
            RecordedMessage::Ros { .. } => panic!("a recording of clearway has no ROS message"),
        }
    }
    assert_eq!(recording.incomplete(), None);
    assert_eq!((events, computed), GOLDEN);
    let recorded: Vec<_> = layers.into_iter().collect();
    let names = ["drivability", "height_difference", "occupancy", "safe_path", "speed", "terrain"];
    let mut expected: Vec<_> = names.iter().chain(more_layers).map(|name| ((*name).to_owned(), GOLDEN.1)).collect();
    expected.sort();
    assert_eq!(recorded, expected);
}

#[test]
fn a_cut_at_any_byte_is_named_and_loses_no_whole_chunk() {
    let original = Original::read(in_chunks()).unwrap();
    assert!(original.chunks() > 5, "{} chunks", original.chunks());
    // A sample; `cuts_and_flips` cuts at every byte.
    let (length, near) = (original.length(), original.near_records(1));
    for cut in (0..length).step_by(60_013).chain(near) {
        original.cut(cut).unwrap_or_else(|error| panic!("cut after {cut} bytes: {error}"));
    }
    let folder = tempfile::tempdir().unwrap();
    let mut repaired = 0;
    // As many cuts of a recording of any length.
    for cut in (0..length).step_by(length / 12) {
        let outcome = original.repair_cut(cut, folder.path());
        repaired += u64::from(outcome.unwrap_or_else(|error| panic!("cut after {cut} bytes: {error}")).repaired);
    }
    assert!(repaired > 5, "{repaired} repaired copies verify");
}

#[test]
fn a_changed_bit_is_named_and_costs_at_most_its_chunk() {
    let folder = tempfile::tempdir().unwrap();
    let original = Original::read(in_chunks()).unwrap();
    let copy = original.copy(&folder.path().join("changed.mcap")).unwrap();
    let mut runner = TestRunner::new(ProptestConfig { cases: 24, ..ProptestConfig::default() });
    let change = (0..original.length(), 0..8_u8);
    runner.run(&change, |(at, bit)| copy.flip(&original, at, bit).map(drop).map_err(TestCaseError::fail)).unwrap();
    // The heads of some records have few of all bytes, but all of the framing.
    let bytes = in_chunks();
    // Only the checksum of the whole section covers the name of the metadata, a digit of its boot id, and the kind of
    // the record that ends the data. Bit 0 of a digit makes another digit in every boot id.
    let (metadata, data_end) = (records(&bytes, op::METADATA)[0], records(&bytes, op::DATA_END)[0]);
    let digit = bytes.windows(7).position(|text| text == b"boot_id").unwrap() + 7 + 4;
    for (byte, bit) in [(metadata + 15, 0), (digit, 0), (digit + 3, 0)] {
        let outcome = copy.flip(&original, byte, bit).unwrap();
        assert!(outcome.repaired && outcome.lost == 0, "byte {byte}, bit {bit}: {outcome:?}");
    }
    // The version in the name of a schema: the file is refused as one of a later version.
    let schema = bytes.windows(15).position(|text| text == b"clearway.v1.Map").unwrap();
    assert!(copy.flip(&original, schema + 9, 0).unwrap().refused);
    (0..8).for_each(|bit| _ = copy.flip(&original, data_end, bit).unwrap());
    let (chunks, indexes) = (records(&bytes, op::CHUNK), records(&bytes, op::MESSAGE_INDEX));
    for at in [chunks[0], chunks[chunks.len() / 2], indexes[indexes.len() / 2]] {
        for (byte, bit) in [(at, 0), (at, 7), (at + 1, 3), (at + 4, 1), (at + 8, 6), (at + 9 + 16, 2)] {
            copy.flip(&original, byte, bit).unwrap();
        }
    }
}

#[test]
fn a_damaged_chunk_costs_that_chunk_and_is_reported_by_topic_and_time() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("damaged.mcap");
    let mut bytes = in_chunks();
    let chunks = records(&bytes, op::CHUNK);
    bytes[chunks[chunks.len() / 2] + 100] ^= 0x10;
    std::fs::write(&file, &bytes).unwrap();
    let (all, read) = (McapReader::open(&golden()).unwrap().count(), McapReader::open(&file).unwrap().count());

    let report = verify(&file).unwrap();
    assert!(report.is_good() && report.incomplete.is_some() && report.events > 0, "{report:?}");
    let [damage] = &report.damages[..] else { panic!("one chunk: {report:?}") };
    assert_eq!(damage.messages.values().sum::<u64>(), (all - read) as u64, "each lost message has its topic");
    let (first, last) = damage.log_ns.expect("the index has the times");
    assert!(first <= last && last - first < 1_000_000_000, "{damage}");

    let path = file.to_str().unwrap();
    let info = run(folder.path(), "clearway", &["info", path]);
    let said = text(&info.stdout);
    assert_eq!(info.status.code(), Some(2), "{said}");
    assert!(said.contains("damaged in 1 place") && said.contains("lost: ") && said.contains("/car/journal"), "{said}");
    // With the recorded values, so that only the damage could change a map.
    for command in [
        &["verify", path][..],
        &["verify", path, "--set", "vehicle.maps.valid_ms=301"],
        &["export", path, "--format", "json", "--out", "maps"],
        &["replay", path],
    ] {
        let output = run(folder.path(), "clearway", command);
        assert_eq!(output.status.code(), Some(2), "{command:?}: {}", text(&output.stderr));
    }
}

#[test]
fn of_damage_over_two_chunks_the_file_says_what_is_lost_in_all() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("damaged.mcap");
    let mut bytes = in_chunks();
    let chunks = records(&bytes, op::CHUNK);
    // From within one chunk, over its indexes, into the next one.
    let (from, to) = (chunks[3] + 100, chunks[4] + 100);
    bytes[from..to].fill(0);
    std::fs::write(&file, &bytes).unwrap();
    let mut reader = McapReader::open(&file).unwrap();
    let lost = |topic: &str, read: &BTreeMap<String, u64>| {
        let all = McapReader::open(&golden()).unwrap().filter(|of| of.as_ref().unwrap().channel.topic == topic).count();
        all as u64 - read.get(topic).copied().unwrap_or(0)
    };
    let mut read = BTreeMap::<String, u64>::new();
    reader.by_ref().for_each(|message| *read.entry(message.unwrap().channel.topic.clone()).or_default() += 1);
    let said = reader.incomplete().unwrap();
    let expected = format!("{} messages of /car/journal", lost("/car/journal", &read));
    assert!(said.contains("lost in all, by its own count: ") && said.contains(&expected), "{expected}: {said}");
}

#[test]
fn a_repaired_recording_is_whole_and_has_all_that_can_be_read() {
    let folder = tempfile::tempdir().unwrap();
    let (damaged, repaired) = (folder.path().join("damaged.mcap"), folder.path().join("repaired.mcap"));
    let mut bytes = in_chunks();
    // The first chunk describes the channels, which then come from the summary.
    let chunks = records(&bytes, op::CHUNK);
    bytes[chunks[0] + 100] ^= 0x10;
    bytes[chunks[3] + 1] ^= 0x40;
    std::fs::write(&damaged, &bytes).unwrap();
    let clearway = |arguments: &[&str]| run(folder.path(), "clearway", arguments);
    let output = clearway(&["repair", "damaged.mcap", "repaired.mcap"]);
    let said = text(&output.stdout);
    assert_eq!(output.status.code(), Some(1), "{said}{}", text(&output.stderr));
    assert!(said.matches("lost: ").count() >= 3 && said.contains("/car/journal"), "{said}");
    assert_eq!(clearway(&["info", "repaired.mcap"]).status.code(), Some(0));
    let mut recording = RecordingReader::open(&repaired).unwrap();
    run_config(&recording).unwrap();
    assert!(recording.by_ref().all(|message| message.is_ok()) && recording.incomplete().is_none());
    let all = McapReader::open(&golden()).unwrap().count();
    let kept = McapReader::open(&repaired).unwrap().count();
    assert!(kept < all && kept > all / 2, "{kept} of {all}");
    // The damaged file ends with exit code 2; the new one is whole, and what is lost is said and is no difference.
    let verified = clearway(&["verify", "repaired.mcap"]);
    let said = text(&verified.stdout);
    assert_eq!(verified.status.code(), Some(0), "{said}");
    assert!(said.contains("what was lost in 2 places is no difference, the first: "), "{said}");

    let again = clearway(&["repair", "damaged.mcap", "repaired.mcap"]);
    assert_eq!(again.status.code(), Some(2));
    assert!(text(&again.stderr).contains("exists and is not overwritten"), "{}", text(&again.stderr));
    let whole = repair(&golden(), &folder.path().join("whole.mcap")).unwrap();
    assert!(whole.incomplete.is_none() && whole.messages == all as u64, "{whole:?}");
    assert_eq!(verify(&folder.path().join("whole.mcap")).unwrap(), verify(&golden()).unwrap());
}

/// What `clearway repair --json` says of the golden recording with this damage, and its exit code.
fn repaired(change: impl FnOnce(&mut Vec<u8>)) -> (String, Option<i32>) {
    let folder = tempfile::tempdir().unwrap();
    let mut bytes = in_chunks();
    change(&mut bytes);
    std::fs::write(folder.path().join("damaged.mcap"), &bytes).unwrap();
    let output = run(folder.path(), "clearway", &["repair", "damaged.mcap", "repaired.mcap", "--json"]);
    let read = McapReader::open(&folder.path().join("repaired.mcap")).unwrap().count();
    let said = text(&output.stdout);
    assert!(said.contains(&format!("\"messages\": {read},")), "{said}");
    (said, output.status.code())
}

#[test]
fn a_repair_without_a_loss_ends_with_success() {
    let all = McapReader::open(&golden()).unwrap().count();
    // The offsets of two messages in an index, and the summary, which the new file has of its own.
    let (said, code) = repaired(|bytes| {
        let index = records(bytes, op::MESSAGE_INDEX)[2];
        bytes[index + 23..index + 25].fill(0xff);
    });
    assert!(said.contains("a message index does not agree with its chunk"), "{said}");
    assert!(code == Some(0) && said.contains(&format!("\"messages\": {all},")), "{code:?}: {said}");
    // Some bits of an index, and all of its head.
    let bytes = in_chunks();
    let indexes = records(&bytes, op::MESSAGE_INDEX);
    let lengths = indexes.windows(2).skip(2).map(|pair| (pair[1] - pair[0], pair[0]));
    let (length, index) = lengths.min().unwrap();
    for bit in (0..72).chain((72..length * 8).step_by(37)) {
        let mut bytes = bytes.clone();
        bytes[index + bit / 8] ^= 1 << (bit % 8);
        let mut reader = McapReader::from_source(Path::new("damaged.mcap"), std::io::Cursor::new(bytes)).unwrap();
        assert_eq!(reader.by_ref().count(), all, "bit {bit}");
        let damages = reader.damages();
        assert!(damages.len() == 1 && !damages[0].is_loss, "bit {bit}: {damages:?}");
    }
    let (said, code) = repaired(|bytes| {
        let statistics = records(bytes, op::STATISTICS)[0];
        bytes[statistics + 9] ^= 1;
    });
    assert!(said.contains("the CRC of the summary section") && said.contains("\"lost_messages\": 0"), "{said}");
    assert!(code == Some(0) && said.contains(&format!("\"messages\": {all},")), "{code:?}: {said}");
    // A crash while the summary was written.
    let (said, code) = repaired(|bytes| bytes.truncate(records(bytes, op::STATISTICS)[0] + 5));
    assert!(code == Some(0) && said.contains("cut after"), "{code:?}: {said}");
    assert!(said.contains(&format!("\"messages\": {all},")), "{said}");
    let (said, code) = repaired(|bytes| bytes.truncate(records(bytes, op::DATA_END)[0] + 5));
    assert!(code == Some(1) && said.contains("cut after"), "the data may have gone on: {code:?}: {said}");
}

#[test]
fn a_second_recording_behind_the_end_is_a_loss() {
    let (said, code) = repaired(|bytes| bytes.extend(bytes.clone()));
    assert!(code == Some(1) && said.contains("bytes after the end of the recording"), "{code:?}: {said}");
}

#[test]
fn a_recording_of_which_no_map_can_be_judged_is_not_called_equal() {
    let folder = tempfile::tempdir().unwrap();
    let mut bytes = in_chunks();
    // The number of the part in the metadata: as if the first part were missing.
    let part = bytes.windows(9).position(|text| text == b"part\x01\0\0\x001").unwrap() + 8;
    bytes[part] = b'0';
    std::fs::write(folder.path().join("damaged.mcap"), &bytes).unwrap();
    repair(&folder.path().join("damaged.mcap"), &folder.path().join("repaired.mcap")).unwrap();
    let output = run(folder.path(), "clearway", &["verify", "repaired.mcap"]);
    let said = text(&output.stdout);
    assert!(output.status.code() == Some(2) && said.contains("no map can be judged"), "{said}");
    // The first map needs more events; a drive without a map is no success.
    let golden = golden();
    let replay = &["replay", golden.to_str().unwrap(), "--to", "0.01", "--record", "short.mcap"];
    assert_eq!(run(folder.path(), "clearway", replay).status.code(), Some(2));
    let said = text(&run(folder.path(), "clearway", &["verify", "short.mcap"]).stdout);
    assert!(said.contains("no map follows from them") && said.contains("1 file: no map was compared"), "{said}");
}

#[test]
fn a_recording_without_its_configuration_is_still_called_a_recording() {
    let folder = tempfile::tempdir().unwrap();
    let mut bytes = in_chunks();
    let attachment = records(&bytes, op::ATTACHMENT)[0];
    bytes[attachment + 100] ^= 1;
    std::fs::write(folder.path().join("damaged.mcap"), &bytes).unwrap();
    let repaired = run(folder.path(), "clearway", &["repair", "damaged.mcap", "repaired.mcap"]);
    assert!(text(&repaired.stdout).contains("repaired.mcap has no configuration, so verify cannot"), "{repaired:?}");
    for name in ["damaged.mcap", "repaired.mcap"] {
        let output = run(folder.path(), "clearway", &["verify", name]);
        let said = text(&output.stderr);
        assert!(output.status.code() == Some(2) && said.contains("config.toml: it is lost (bytes"), "{name}: {said}");
    }
}

#[test]
fn messages_that_were_cut_out_of_a_recording_are_no_difference() {
    let folder = tempfile::tempdir().unwrap();
    let bytes = in_chunks();
    let chunks = records(&bytes, op::CHUNK);
    for cut in [2, 5, chunks.len() - 2] {
        let (mut rest, file) = (bytes.clone(), folder.path().join("rest.mcap"));
        rest.drain(chunks[cut]..chunks[cut + 1]);
        std::fs::write(&file, &rest).unwrap();
        let report = verify(&file).unwrap();
        assert!(report.different == 0 && report.differences.is_empty(), "chunk {cut}: {report:?}");
        assert!(report.incomplete.is_some(), "chunk {cut}: {report:?}");
        let output = run(folder.path(), "clearway", &["verify", "rest.mcap"]);
        assert_eq!(output.status.code(), Some(2), "chunk {cut}: {}", text(&output.stdout));
    }
}

#[test]
fn a_record_with_a_wrong_length_costs_that_record() {
    let all = McapReader::open(&golden()).unwrap().count();
    for kind in [op::HEADER, op::METADATA, op::ATTACHMENT] {
        // Its length: the record then ends some bytes, or some chunks, before or after its end.
        for (byte, bit) in [(1, 0), (1, 7), (2, 5)] {
            let (said, code) = repaired(|bytes| {
                let record = records(bytes, kind)[0];
                bytes[record + byte] ^= 1 << bit;
            });
            let has_all = said.contains(&format!("\"messages\": {all},"));
            assert!(code == Some(1) && has_all, "{kind}, byte {byte}, bit {bit}, {code:?}: {said}");
        }
    }
    // One byte too short, and the byte behind it looks like the kind of a long record of another program.
    let (said, code) = repaired(|bytes| {
        let (header, metadata) = (records(bytes, op::HEADER)[0], records(bytes, op::METADATA)[0]);
        bytes[header + 1] -= 1;
        bytes[metadata - 1] = 0x86;
    });
    assert!(code == Some(1) && said.contains(&format!("\"messages\": {all},")), "{code:?}: {said}");
}

#[test]
fn a_repair_names_a_lost_attachment_and_changed_metadata() {
    let (said, code) = repaired(|bytes| {
        let attachment = records(bytes, op::ATTACHMENT)[0];
        bytes[attachment + 100..attachment + 104].fill(b'#');
    });
    assert!(said.contains("the attachment \\\"config.toml\\\"") && said.contains("CRC"), "{said}");
    assert!(code == Some(1) && said.contains("\"lost_messages\": 0"), "{code:?}: {said}");
    assert!(said.contains("\"lacks_config\": true"), "{said}");
    let (said, code) = repaired(|bytes| {
        let key = bytes.windows(7).position(|text| text == b"boot_id").unwrap();
        // The first digit of its value, behind the value's length.
        bytes[key + 7 + 4] ^= 1;
    });
    assert!(code == Some(1) && said.contains("the CRC of the data section"), "{code:?}: {said}");
    let (said, code) = repaired(|bytes| {
        let metadata = records(bytes, op::METADATA)[0];
        bytes[metadata + 60] ^= 1;
    });
    assert!(code == Some(1) && said.contains("metadata: "), "{code:?}: {said}");
}

#[test]
fn a_repair_believes_neither_damaged_counts_nor_times_outside_of_a_chunk() {
    let (said, code) = repaired(|bytes| {
        let chunk = records(bytes, op::CHUNK)[2];
        bytes[chunk + 100] ^= 1;
        // The greatest byte of the first time of the index behind it.
        let index = *records(bytes, op::MESSAGE_INDEX).iter().find(|at| **at > chunk).unwrap();
        bytes[index + 9 + 2 + 4 + 7] = 0xff;
        // The count of the summary becomes what can be read; the recorder's count is in a chunk.
        let statistics = records(bytes, op::STATISTICS)[0];
        bytes[statistics + 9..statistics + 17].fill(0);
    });
    assert!(code == Some(1) && said.contains("\"lost_messages\": 15"), "{code:?}: {said}");
    assert!(said.contains("\"/car/journal\": 15"), "the index names the lost messages: {said}");
    let report: serde_json::Value = serde_json::from_str(&said).unwrap();
    let (from, to) = (&report["damage"][0]["lost_from_ns"], &report["damage"][0]["lost_to_ns"]);
    let seconds = (to.as_u64().unwrap() - from.as_u64().unwrap()) / 1_000_000_000;
    assert_eq!(seconds, 0, "from {from} to {to}");
}

#[test]
fn an_unreadable_file_never_ends_with_success() {
    let folder = tempfile::tempdir().unwrap();
    let bytes = std::fs::read(golden()).unwrap();
    let mut wrong_start = bytes.clone();
    wrong_start[0] ^= 1;
    let no_index = records(&bytes, op::CHUNK)[0];
    let files: [(&str, &[u8]); 5] = [
        ("empty.mcap", b""),
        ("short.mcap", &bytes[..5]),
        ("magic.mcap", &bytes[..8]),
        ("start.mcap", &bytes[..no_index]),
        ("wrong.mcap", &wrong_start),
    ];
    std::fs::write(folder.path().join("text.mcap"), "no recording").unwrap();
    let output = run(folder.path(), "clearway", &["repair", "text.mcap", "out.mcap"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(text(&output.stderr).contains("text.mcap: not an MCAP file"), "{}", text(&output.stderr));
    for (name, bytes) in files {
        std::fs::write(folder.path().join(name), bytes).unwrap();
        for command in [
            &["info", name][..],
            &["verify", name],
            &["replay", name],
            &["export", name, "--format", "json", "--out", "maps"],
        ] {
            let output = run(folder.path(), "clearway", command);
            assert_eq!(output.status.code(), Some(2), "{command:?}: {}", text(&output.stderr));
            assert!(text(&[output.stdout, output.stderr].concat()).contains(name), "{command:?}");
        }
    }
    let output: Output = run(folder.path(), "clearway", &["repair", "start.mcap", "out.mcap"]);
    assert!(output.status.code() == Some(2) && !folder.path().join("out.mcap").exists());
    assert!(text(&output.stderr).contains("no message can be read"), "{}", text(&output.stderr));
}

#[test]
fn a_recording_of_a_later_version_is_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, metadata: &[(&str, &str)], schema: &str| {
        let file = folder.path().join(name);
        let mut writer = mcap::Writer::new(std::io::BufWriter::new(std::fs::File::create(&file).unwrap())).unwrap();
        let metadata = metadata.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned())).collect();
        writer.write_metadata(&mcap::records::Metadata { name: "clearway".into(), metadata }).unwrap();
        writer.add_schema(schema, "protobuf", b"").unwrap();
        writer.finish().unwrap();
        file
    };
    // A digit of the format has changed: this version has never written it.
    let (said, code) = repaired(|bytes| {
        let format = bytes.windows(6).position(|text| text == b"format").unwrap();
        bytes[format + 6 + 4] ^= 2;
    });
    assert!(code == Some(1) && said.contains("which clearway 0.1.0 has never written"), "{code:?}: {said}");
    let refused = |file: &Path| RecordingReader::open(file).err().expect("refused").to_string();
    let later = refused(&write("later.mcap", &[("format", "2"), ("version", "0.7.0")], "clearway.v1.Event"));
    assert!(later.contains("format 2") && later.contains("0.7.0") && later.contains("later.mcap"), "{later}");
    let schema = refused(&write("schema.mcap", &[("version", "3.0.0")], "clearway.v2.Event"));
    assert!(schema.contains("clearway.v2.Event") && schema.contains("3.0.0"), "{schema}");
    RecordingReader::open(&write("earlier.mcap", &[], "clearway.v1.Event")).unwrap();
}

#[test]
fn a_pipe_is_refused_and_not_waited_for() {
    let folder = tempfile::tempdir().unwrap();
    let pipe = folder.path().join("pipe.mcap");
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    for command in ["replay", "verify", "info", "repair", "export", "send"] {
        let arguments: &[&str] = match command {
            "repair" => &["pipe.mcap", "new.mcap"],
            "export" => &["pipe.mcap", "--format", "json", "--out", "maps"],
            "send" => &["pipe.mcap", "--to", "udp://127.0.0.1:9"],
            _ => &["pipe.mcap"],
        };
        let output = run(folder.path(), "clearway", &[&[command], arguments].concat());
        let said = text(&output.stderr);
        assert!(said.contains("a pipe or a device"), "{command}: {said}");
        assert_eq!(output.status.code(), Some(2), "{command}: {said}");
    }
}

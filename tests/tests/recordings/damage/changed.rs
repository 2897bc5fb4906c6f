//! A recording that something has changed after it was written: every command says so, and nothing that is there is
//! called lost or different.

use std::io::Cursor;
use std::path::Path;

use clearway_journal::mcap_reader::McapReader;
use clearway_tests::{damage, run};
use mcap::records::op;

use super::{golden, in_chunks, records, text};

type Change<'a> = &'a dyn Fn(&mut Vec<u8>);

/// `info`, `repair` and `verify` of a changed golden recording, and `verify` of the repaired one: exit codes and texts.
fn commands_on(change: impl FnOnce(&mut Vec<u8>)) -> [(Option<i32>, String); 4] {
    let folder = tempfile::tempdir().unwrap();
    let mut bytes = in_chunks();
    change(&mut bytes);
    std::fs::write(folder.path().join("a.mcap"), &bytes).unwrap();
    let commands =
        [&["info", "a.mcap"][..], &["repair", "a.mcap", "b.mcap"], &["verify", "a.mcap"], &["verify", "b.mcap"]];
    commands.map(|command| {
        let output = run(folder.path(), "clearway", command);
        (output.status.code(), text(&output.stdout) + &text(&output.stderr))
    })
}

#[test]
fn chunks_in_another_order_or_twice_are_no_difference() {
    let bytes = in_chunks();
    let chunks = records(&bytes, op::CHUNK);
    let [first, third] = [chunks[2], chunks[4]];
    for (name, order) in [("swapped", &[3, 2][..]), ("twice", &[2, 2, 3]), ("cut out", &[3])] {
        let [info, repair, verify, verify_repaired] = commands_on(|changed| {
            let middle = order.iter().flat_map(|chunk| &bytes[chunks[*chunk]..chunks[chunk + 1]]);
            *changed = bytes[..first].iter().chain(middle).chain(&bytes[third..]).copied().collect();
        });
        assert_eq!((info.0, repair.0, verify.0), (Some(2), Some(1), Some(2)), "{name}: {} {}", repair.1, verify.1);
        assert_eq!(verify_repaired.0, Some(0), "{name}: {}", verify_repaired.1);
        let is_told = repair.1.contains("and 172 by its own count");
        assert!(name == "swapped" || is_told || repair.1.contains("lost in all"), "{name}: {}", repair.1);
    }
}

#[test]
fn metadata_that_does_not_fit_is_named_by_every_command_whatever_its_checksums() {
    let position = |bytes: &[u8], text: &[u8]| {
        let found = bytes.windows(text.len()).position(|of| of == text);
        found.unwrap_or_else(|| panic!("{}", text.escape_ascii()))
    };
    let name = |bytes: &mut Vec<u8>| {
        let at = position(bytes, b"\x08\0\0\0clearway") + 4;
        bytes[at] = b'C';
    };
    let maps = |bytes: &mut Vec<u8>| {
        let at = position(bytes, b"maps\x04\0\0\0full") + 8;
        bytes[at..at + 4].copy_from_slice(b"none");
    };
    // The length of each value stands before it, and lengths of texts before the texts.
    let id = |bytes: &mut Vec<u8>| {
        let at = position(bytes, b"boot_id") + 7 + 4;
        bytes[at] = b'x';
    };
    let config = |bytes: &mut Vec<u8>| {
        let at = position(bytes, b"[[vehicle]]");
        bytes[at] = b'=';
    };
    let changes: [(&str, Change<'_>); 4] = [
        ("which is none", &id),
        ("has the boot id \"\", which is none", &name),
        ("that no map is recorded, and maps are", &maps),
        ("its config.toml cannot be read", &config),
    ];
    for (expected, change) in changes {
        let [info, repair, verify, verify_repaired] = commands_on(|bytes| {
            change(bytes);
            let attachment = records(bytes, op::ATTACHMENT)[0];
            let end = *damage::records(bytes).iter().map(|(_, at)| at).find(|at| **at > attachment).unwrap();
            let crc = crc32fast::hash(&bytes[attachment + 9..end - 4]);
            bytes[end - 4..end].copy_from_slice(&crc.to_le_bytes());
            let data_end = records(bytes, op::DATA_END)[0];
            let crc = crc32fast::hash(&bytes[..data_end]);
            bytes[data_end + 9..data_end + 13].copy_from_slice(&crc.to_le_bytes());
        });
        assert!(info.0 == Some(2) && info.1.contains(expected), "{expected}: info: {}", info.1);
        assert!(repair.0 == Some(1) && repair.1.contains(expected), "{expected}: repair: {}", repair.1);
        assert_eq!(verify.0, Some(2), "{expected}: verify: {}", verify.1);
        let is_told = verify_repaired.1.contains(expected) || verify_repaired.1.contains("b.mcap/config.toml: TOML");
        assert!(is_told, "{expected}: verify of the repaired: {}", verify_repaired.1);
    }
}

#[test]
fn a_repair_calls_lost_only_what_may_be_missing() {
    let junk = commands_on(|bytes| {
        let chunk = records(bytes, op::CHUNK)[2];
        bytes.splice(chunk..chunk, std::iter::repeat_n(0xee, 100));
    });
    let data_crc = commands_on(|bytes| {
        let data_end = records(bytes, op::DATA_END)[0];
        bytes[data_end + 9] ^= 1;
    });
    let program = commands_on(|bytes| {
        let header = records(bytes, op::HEADER)[0];
        bytes[header + 9 + 4 + 4] ^= 1;
    });
    let chunk_time = commands_on(|bytes| {
        let chunk = records(bytes, op::CHUNK)[2];
        bytes[chunk + 9] ^= 1;
    });
    for [_, repair, _, verify_repaired] in [junk, data_crc, program, chunk_time] {
        assert!(repair.0 == Some(1) && repair.1.contains("\nchanged, and no record is lost: "), "{}", repair.1);
        assert!(!repair.1.contains("\nlost: "), "{}", repair.1);
        assert_eq!(verify_repaired.0, Some(0), "{}", verify_repaired.1);
    }
    let [_, repair, ..] = commands_on(|bytes| bytes.extend([0xee; 10]));
    assert!(repair.0 == Some(1) && repair.1.contains("\nlost: bytes"), "{}", repair.1);
    let [info, repair, ..] = commands_on(|bytes| bytes[0] ^= 1);
    for refused in [info, repair] {
        let is_named = refused.1.contains("a.mcap: not an MCAP file: it does not start with the magic bytes");
        assert!(refused.0 == Some(2) && is_named, "{}", refused.1);
    }
}

#[test]
fn of_a_chunk_without_checksums_only_the_messages_behind_the_damage_are_lost() {
    let options = mcap::WriteOptions::new().chunk_size(Some(16 << 10)).compression(None).compression_threads(0);
    let mut bytes = damage::rewritten(&in_chunks(), options.calculate_chunk_crcs(false)).unwrap();
    // Behind the fields of the chunk, the heads of its records.
    let mut at = records(&bytes, op::CHUNK)[2] + 9 + 40;
    for _ in 0..2 {
        at += 9 + u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap()) as usize;
    }
    // The length of the third record.
    bytes[at + 8] = 0xff;
    let mut reader = McapReader::from_source(Path::new("changed.mcap"), Cursor::new(bytes)).unwrap();
    let read = reader.by_ref().count() as u64;
    assert_eq!(reader.damages().len(), 1, "{:?}", reader.damages());
    let lost: u64 = reader.damages().iter().flat_map(|damage| damage.messages.values()).sum();
    assert_eq!(read + lost, McapReader::open(&golden()).unwrap().count() as u64, "{:?}", reader.damages());
}

/// The golden recording in small chunks as another program would write it again: the changed messages, with right
/// counts and checksums.
fn rewritten(change: impl Fn(&mut Vec<mcap::Message<'_>>)) -> Vec<u8> {
    let bytes = in_chunks();
    let mut messages: Vec<_> = mcap::MessageStream::new(&bytes).unwrap().map(|message| message.unwrap()).collect();
    change(&mut messages);
    let options = mcap::WriteOptions::new().chunk_size(Some(8 << 10)).compression_threads(0);
    damage::with_messages(&bytes, &messages, options).unwrap()
}

#[test]
fn a_rewritten_recording_is_judged_by_the_counts_of_its_recorder_and_the_order_of_its_events() {
    let journal = |message: &mcap::Message<'_>| message.channel.topic == "/car/journal";
    let events = |messages: &[mcap::Message<'_>]| -> Vec<usize> {
        (0..messages.len()).filter(|index| journal(&messages[*index])).collect()
    };
    type Rewrite<'a> = &'a dyn Fn(&mut Vec<mcap::Message<'_>>);
    let rewrites: [(&str, &str, Rewrite<'_>); 6] = [
        ("an event less", "event 41 of /car/journal stands in the place of event 40", &|messages| {
            messages.remove(events(messages)[40]);
        }),
        ("two events in each other's place", "event 41 of /car/journal stands in the place of event 40", &|messages| {
            let (a, b) = (events(messages)[40], events(messages)[41]);
            messages.swap(a, b);
        }),
        ("the last message first", "event 170 of /car/journal stands in the place of event 172", &|messages| {
            messages.reverse()
        }),
        ("the maps first", "a map stands before its events", &|messages| messages.sort_by_key(journal)),
        ("a map twice", "stands behind a later one", &|messages| {
            let map = messages.iter().position(|message| message.channel.topic.contains("/map/")).unwrap();
            messages.insert(map, messages[map].clone());
        }),
        (
            "events in place of others",
            "in 2 places, the first: event 10 of /car/journal stands in the place of event 20",
            &|messages| {
                let events = events(messages);
                for index in 0..5 {
                    messages[events[20 + index]] = messages[events[10 + index]].clone();
                }
            },
        ),
    ];
    for (name, expected, rewrite) in rewrites {
        let [info, repair, verify, verify_repaired] = commands_on(|bytes| *bytes = rewritten(rewrite));
        assert_eq!(verify.0, Some(2), "{name}: {}", verify.1);
        let is_of_maps = expected.contains("before its events");
        assert!(is_of_maps || info.0 == Some(2) && info.1.contains(expected), "{name}: {}", info.1);
        assert!(is_of_maps || repair.0 == Some(1) && repair.1.contains(expected), "{name}: {}", repair.1);
        assert!(verify_repaired.0 != Some(1), "{name}: {}", verify_repaired.1);
    }
    let [info, repair, verify, _] = commands_on(|bytes| *bytes = rewritten(|_| {}));
    assert_eq!((info.0, repair.0, verify.0), (Some(0), Some(0), Some(0)), "{} {} {}", info.1, repair.1, verify.1);
}

#[test]
fn a_cut_chunk_is_found_whatever_else_is_damaged() {
    let bytes = in_chunks();
    let all = McapReader::open(&golden()).unwrap().count();
    let chunks = records(&bytes, op::CHUNK);
    let cut = |bytes: &mut Vec<u8>, chunk: usize| _ = bytes.drain(chunks[chunk]..chunks[chunk + 1]);
    // The chunk before the last maps.
    for chunk in 1..chunks.len() - 1 {
        let [info, repair, verify, verify_repaired] = commands_on(|bytes| cut(bytes, chunk));
        let codes = (info.0, repair.0, verify.0, verify_repaired.0);
        assert!(codes == (Some(2), Some(1), Some(2), Some(0)), "{chunk}: {codes:?} {} {}", verify.1, verify_repaired.1);
    }
    // The chunk that describes the channels, which the summary describes too.
    let [_, repair, ..] = commands_on(|bytes| cut(bytes, 0));
    assert!(repair.0 == Some(1) && !repair.1.contains("b.mcap has 0"), "{}", repair.1);
    assert!(!repair.1.contains("does not describe"), "{}", repair.1);
    // Two recordings: the first lacks its last bytes, the second its first bytes.
    let [_, repair, ..] = commands_on(|bytes| {
        bytes.truncate(bytes.len() - 8);
        bytes.extend(in_chunks()[8..].to_vec());
    });
    assert!(repair.0 == Some(1) && repair.1.contains("lost: bytes"), "{}", repair.1);
    assert!(repair.1.contains(&format!("b.mcap has {all} messages")), "{}", repair.1);
    // One chunk twice, and another damaged: the counts alone would agree.
    let [_, repair, ..] = commands_on(|bytes| {
        let twice = bytes[chunks[2]..chunks[3]].to_vec();
        bytes[chunks[4] + 100] ^= 1;
        bytes.splice(chunks[3]..chunks[3], twice);
    });
    assert!(repair.0 == Some(1) && repair.1.contains("\nlost: "), "{}", repair.1);
    assert!(!repair.1.contains("no record is lost"), "{}", repair.1);
}

#[test]
fn an_index_that_is_there_twice_counts_no_message_twice() {
    let mut bytes = in_chunks();
    let chunk = records(&bytes, op::CHUNK)[2];
    let index = *records(&bytes, op::MESSAGE_INDEX).iter().find(|at| **at > chunk).unwrap();
    let end = *damage::records(&bytes).iter().map(|(_, at)| at).find(|at| **at > index).unwrap();
    bytes[chunk + 100] ^= 1;
    let named = |bytes: Vec<u8>| {
        let mut reader = McapReader::from_source(Path::new("changed.mcap"), Cursor::new(bytes)).unwrap();
        assert!(reader.by_ref().count() > 0);
        reader.damages()[0].messages.clone()
    };
    let once = named(bytes.clone());
    let twice = bytes[index..end].to_vec();
    bytes.splice(index..index, twice);
    assert_eq!(named(bytes), once);
}

#[test]
fn control_characters_of_a_file_do_not_reach_the_terminal() {
    let with_name = |bytes: &mut Vec<u8>| {
        let summary = records(bytes, op::DATA_END)[0];
        *bytes = rewritten(|_| {});
        let topic = b"/car/map/terrain";
        let places: Vec<_> = (0..bytes.len().min(summary)).filter(|at| bytes[*at..].starts_with(topic)).collect();
        places.into_iter().for_each(|at| bytes[at + 5] = 0x1b);
    };
    for (_, said) in commands_on(with_name) {
        assert!(!said.contains('\u{1b}'), "{said:?}");
    }
}

//! A recording that something has changed after it was written: every command says so, and nothing that is there is
//! called lost or different.

use std::io::Cursor;
use std::path::Path;

use clearway::record::mcap_reader::McapReader;
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
        let is_told = repair.1.contains("206 messages, and 191 by its own count");
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
        let at = position(bytes, b"part\x01\0\0\x001");
        bytes.splice(at..at + 9, *b"maps\x04\0\0\0none");
        let metadata = records(bytes, op::METADATA)[0];
        // The length of the record and, behind its name, that of its keys and values.
        for length in [metadata + 1, metadata + 9 + 4 + 8] {
            let new = u32::from_le_bytes(bytes[length..length + 4].try_into().unwrap()) + 3;
            bytes[length..length + 4].copy_from_slice(&new.to_le_bytes());
        }
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
    let junk = |at: usize, length: usize| {
        commands_on(move |bytes| {
            let at = if at == usize::MAX { bytes.len() } else { records(bytes, op::CHUNK)[at] };
            bytes.splice(at..at, std::iter::repeat_n(0xee, length));
        })
    };
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
    for [_, repair, _, verify_repaired] in [junk(2, 100), junk(usize::MAX, 10), data_crc, program, chunk_time] {
        assert!(repair.0 == Some(1) && repair.1.contains("\nchanged, and no record is lost: "), "{}", repair.1);
        assert!(!repair.1.contains("\nlost: "), "{}", repair.1);
        assert_eq!(verify_repaired.0, Some(0), "{}", verify_repaired.1);
    }
    let [info, repair, ..] = commands_on(|bytes| bytes[0] ^= 1);
    assert!(info.0 == Some(2) && info.1.contains("if it was one, `clearway repair` reads the rest"), "{}", info.1);
    assert!(repair.0 == Some(0) && repair.1.contains("damaged, and nothing is lost: bytes 0 to 8"), "{}", repair.1);
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

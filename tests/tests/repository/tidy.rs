//! The rules of the repository that a compiler does not hold: words, line lengths, and the absence of import circles.
//! What may only become less is in `ratchet.rs`.

use std::fs;

use clearway_tests::workspace;

use super::modules::{circles, imports};
use super::{files, shown, sources};

/// Longest line, in characters. Tables and links of Markdown, and lines of code with a string, may be longer.
const LINE_MAX: usize = 120;

/// Words that the glossary of CONTRIBUTING.md replaces, each with what is written instead.
const WORDS: [(&str, &str); 19] = [
    ("anew", "again"),
    ("whoever", "the noun: a reader, a sender"),
    ("whence", "from where"),
    ("nobody", "the noun: no reader, no sender"),
    ("somebody", "the noun: a reader, a sender"),
    ("stranger", "unknown sender"),
    ("strangers", "unknown senders"),
    ("untold", "not reported"),
    ("lobby", "connections over the limit"),
    ("scribe", "writer"),
    ("clearway-server", "clearway"),
    ("util", "the name of what it does"),
    ("utils", "the name of what it does"),
    ("helper", "the name of what it does"),
    ("helpers", "the name of what it does"),
    ("fixme", "the change itself"),
    ("xxx", "the change itself"),
    ("houses", "systems, servers or test beds"),
    ("house", "system, server or test bed"),
];
/// Files and folders in which a word of [`WORDS`] is meant: this file, the glossary, and the houses of simulated towns.
const WORDS_ALLOWED: [&str; 3] = ["tests/tests/repository/tidy.rs", "CONTRIBUTING.md", "client/sim/"];

/// Names of crates that contain a word of [`WORDS`].
const CRATE_NAMES: [&str; 3] = ["http_body_util", "hyper_util", "tokio_util"];

#[test]
fn no_line_is_longer_than_120_characters() {
    let mut wrong = Vec::new();
    for file in files(&workspace(), &["rs", "py", "js", "proto", "md", "toml", "css", "html", "sh"]) {
        let is_markdown = file.extension().is_some_and(|ending| ending == "md");
        for (index, line) in fs::read_to_string(&file).expect("UTF-8").lines().enumerate() {
            let may_be_long = match is_markdown {
                true => line.starts_with('|') || line.contains("]("),
                false => line.contains('"'),
            };
            if line.chars().count() > LINE_MAX && !may_be_long {
                wrong.push(format!("{}:{}", shown(&file), index + 1));
            }
        }
    }
    assert!(wrong.is_empty(), "longer than {LINE_MAX} characters:\n{}", wrong.join("\n"));
}

#[test]
fn words_of_the_glossary_replace_home_made_ones() {
    let mut wrong = Vec::new();
    for file in files(&workspace(), &["rs", "py", "js", "proto", "md", "toml", "html"]) {
        if WORDS_ALLOWED.iter().any(|allowed| shown(&file).starts_with(allowed)) {
            continue;
        }
        for (index, line) in fs::read_to_string(&file).expect("UTF-8").lines().enumerate() {
            let line = CRATE_NAMES.iter().fold(line.to_lowercase(), |line, name| line.replace(name, ""));
            let words = line.split(|c: char| !c.is_ascii_alphabetic() && c != '-');
            for (word, instead) in words.filter_map(|word| WORDS.iter().find(|(home_made, _)| *home_made == word)) {
                wrong.push(format!("{}:{}: \"{word}\": write {instead}", shown(&file), index + 1));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// Files whose functions `reason` name why datagrams, scans and messages are refused. Poses and roads have their own
/// counts.
const REASONS: [&str; 5] = [
    "server/daemon/src/fleet.rs",
    "server/core/lidar/src/datagram/error.rs",
    "server/core/mapping/src/error.rs",
    "server/daemon/src/ingest/observation.rs",
    "server/daemon/src/ingest/ros/decoder.rs",
];

#[test]
fn every_reason_of_a_refusal_has_a_series_before_it_occurs() {
    let text = |file: &str| fs::read_to_string(workspace().join(file)).expect("UTF-8");
    let listed = text("server/daemon/src/status/reasons.rs");
    let mut missing = Vec::new();
    for file in REASONS {
        let source = text(file);
        let (_, function) = source.split_once("pub fn reason(&self) -> &'static str {").expect("the function");
        let (arms, _) = function.split_once("\n    }\n").expect("its end");
        let reasons = arms.split('"').skip(1).step_by(2).filter(|reason| *reason != "pose");
        let of_file: Vec<_> = reasons.collect();
        assert!(!of_file.is_empty(), "{file} names reasons");
        missing
            .extend(of_file.into_iter().filter(|reason| !listed.contains(&format!("\"{reason}\""))).map(str::to_owned));
    }
    assert!(missing.is_empty(), "status/reasons.rs lacks {missing:?}");
}

/// The circles that are left; this list may only shrink.
const CIRCLES: [&str; 1] =
    ["server/core/mapping/src: road <-> road::check <-> road::rddf <-> road::rndf <-> road::store"];

#[test]
fn no_two_files_of_a_crate_import_each_other() {
    let mut wrong = Vec::new();
    for sources in sources() {
        for circle in circles(&imports(&sources)) {
            wrong.push(format!("{}: {}", shown(&sources), circle.join(" <-> ")));
        }
    }
    wrong.sort();
    assert_eq!(wrong, CIRCLES, "files that import each other, and the circles that are left");
}

//! The rules of the repository that a compiler does not hold: words, lengths, and the absence of import circles.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// Longest line, in characters. Tables and links of Markdown, and lines of code with a string, may be longer.
const LINE_MAX: usize = 120;
/// Longest source file, in lines: what a reader holds in mind at once. Most files stay under 400.
const FILE_MAX: usize = 500;

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
const CRATE_NAMES: [&str; 2] = ["hyper_util", "tokio_util"];

/// The folders of all crates' sources.
const CRATES: [&str; 10] = [
    "proto/src",
    "proto/ros/src",
    "server/core/lidar/src",
    "server/core/mapping/src",
    "server/core/journal/src",
    "server/daemon/src",
    "server/src",
    "client/src",
    "client/sim/src",
    "tests/src",
];

fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("tests/ lies in the repository").to_path_buf()
}

/// All files below `folder` with one of the endings, in order; built and third-party folders left out.
fn files(folder: &Path, endings: &[&str]) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut folders = vec![folder.to_path_buf()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).expect("the folder is readable") {
            let path = entry.expect("the entry is readable").path();
            let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default().to_owned();
            let is_ours = !name.starts_with('.') && !["target", "node_modules", "corpus", "build"].contains(&&*name);
            if path.is_dir() && is_ours {
                folders.push(path);
            } else if path.extension().and_then(|ending| ending.to_str()).is_some_and(|e| endings.contains(&e)) {
                found.push(path);
            }
        }
    }
    found.sort();
    found
}

fn shown(path: &Path) -> String {
    path.strip_prefix(repository()).unwrap_or(path).display().to_string()
}

#[test]
fn no_line_is_longer_than_120_characters() {
    let mut wrong = Vec::new();
    for file in files(&repository(), &["rs", "py", "js", "proto", "md", "toml", "css", "html", "sh"]) {
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
fn no_source_file_is_longer_than_500_lines() {
    let long = files(&repository(), &["rs", "py", "js", "proto"]).into_iter().filter_map(|file| {
        let lines = fs::read_to_string(&file).expect("UTF-8").lines().count();
        (lines > FILE_MAX).then(|| format!("{}: {lines} lines", shown(&file)))
    });
    let long: Vec<_> = long.collect();
    assert!(long.is_empty(), "longer than {FILE_MAX} lines:\n{}", long.join("\n"));
}

#[test]
fn words_of_the_glossary_replace_home_made_ones() {
    let mut wrong = Vec::new();
    for file in files(&repository(), &["rs", "py", "js", "proto", "md", "toml", "html"]) {
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

#[test]
fn no_two_files_of_a_crate_import_each_other() {
    let mut wrong = Vec::new();
    for sources in CRATES {
        let imports = imports(&repository().join(sources));
        for circle in circles(&imports) {
            wrong.push(format!("{sources}: {}", circle.join(" <-> ")));
        }
    }
    assert!(wrong.is_empty(), "files that import each other:\n{}", wrong.join("\n"));
}

/// The modules of a crate, as `a::b`, and those each of them names in a path.
fn imports(sources: &Path) -> BTreeMap<String, BTreeSet<String>> {
    let module = |file: &Path| {
        let path = file.strip_prefix(sources).expect("below the sources").with_extension("");
        let names: Vec<_> = path.iter().filter_map(|name| name.to_str()).collect();
        names.into_iter().filter(|name| !["mod", "lib", "main"].contains(name)).collect::<Vec<_>>().join("::")
    };
    let sources: Vec<_> = files(sources, &["rs"]);
    let modules: BTreeSet<String> = sources.iter().map(|file| module(file)).collect();
    let mut imports = BTreeMap::new();
    for file in &sources {
        let own = module(file);
        let text = without_comments(&fs::read_to_string(file).expect("UTF-8"));
        let mut named = BTreeSet::new();
        for path in paths(&text) {
            let Some(path) = absolute(&path, &own, &modules) else { continue };
            // The longest part of the path that is a module: what follows is an item in it.
            let found = (1..=path.len()).rev().map(|length| path[..length].join("::")).find(|m| modules.contains(m));
            named.extend(found.filter(|module| *module != own));
        }
        imports.entry(own).or_insert_with(BTreeSet::new).extend(named);
    }
    imports
}

/// The code of a file, without comments and without its module of tests.
fn without_comments(text: &str) -> String {
    let code = text.split("#[cfg(test)]\nmod ").next().unwrap_or(text);
    code.lines().map(|line| line.split("//").next().unwrap_or(line)).collect::<Vec<_>>().join("\n")
}

/// Every path of the code, `use` trees written out, visibility left out.
fn paths(code: &str) -> Vec<Vec<String>> {
    let mut paths = Vec::new();
    let mut rest = code;
    while let Some(start) = rest.find(|c: char| c.is_ascii_alphabetic() || c == '_') {
        let before = rest[..start].chars().next_back();
        rest = &rest[start..];
        let length = tree_length(rest);
        let is_visibility = before == Some('(') && ["crate", "super", "self"].contains(&rest[..length].trim());
        if !is_visibility {
            expand(&[], &rest[..length], &mut paths);
        }
        rest = &rest[length..];
    }
    paths
}

/// Bytes of the path that the text begins with, and of its `{...}` if it ends in one.
fn tree_length(text: &str) -> usize {
    let mut depth = 0_usize;
    for (at, c) in text.char_indices() {
        match c {
            '{' if depth > 0 || text[..at].ends_with("::") => depth += 1,
            '}' if depth > 0 => {
                depth -= 1;
                if depth == 0 {
                    return at + 1;
                }
            }
            _ if depth > 0 || c.is_ascii_alphanumeric() || c == '_' || c == ':' => {}
            _ => return at,
        }
    }
    text.len()
}

/// Writes out `a::{b, c::d}` as `a::b` and `a::c::d`.
fn expand(before: &[String], tree: &str, paths: &mut Vec<Vec<String>>) {
    let (path, branches) = match tree.split_once('{') {
        Some((path, branches)) => (path, Some(branches.trim_end().trim_end_matches('}'))),
        None => (tree, None),
    };
    let names = path.split("::").map(|name| name.split(" as ").next().unwrap_or(name).trim().to_owned());
    let path: Vec<_> = before.iter().cloned().chain(names.filter(|name| !name.is_empty())).collect();
    let Some(branches) = branches else {
        paths.push(path);
        return;
    };
    let (mut depth, mut from) = (0, 0);
    for (at, c) in branches.char_indices().chain([(branches.len(), ',')]) {
        match c {
            '{' => depth += 1,
            '}' => depth -= 1,
            ',' if depth == 0 => {
                expand(&path, branches[from..at].trim(), paths);
                from = at + 1;
            }
            _ => {}
        }
    }
}

/// The path from the crate's root; `None` where it leads out of the crate.
fn absolute(path: &[String], own: &str, modules: &BTreeSet<String>) -> Option<Vec<String>> {
    let mut place: Vec<String> = own.split("::").filter(|name| !name.is_empty()).map(str::to_owned).collect();
    let mut names = path.iter().peekable();
    match names.peek()?.as_str() {
        "crate" => {
            place.clear();
            names.next();
        }
        "self" | "super" => {
            while let Some(first) = names.next_if(|name| ["self", "super"].contains(&name.as_str())) {
                if first == "super" {
                    place.pop()?;
                }
            }
        }
        child => {
            let child: Vec<_> = place.iter().cloned().chain([child.to_owned()]).collect();
            modules.contains(&child.join("::")).then_some(())?;
        }
    }
    place.extend(names.cloned());
    Some(place)
}

/// Groups of modules that reach each other.
fn circles(imports: &BTreeMap<String, BTreeSet<String>>) -> Vec<Vec<String>> {
    let reached_from = |start: &String| {
        let (mut reached, mut open) = (BTreeSet::new(), vec![start]);
        while let Some(module) = open.pop() {
            for next in imports.get(module).into_iter().flatten() {
                if reached.insert(next.clone()) {
                    open.push(next);
                }
            }
        }
        reached
    };
    let reached: BTreeMap<_, _> = imports.keys().map(|module| (module, reached_from(module))).collect();
    let mut found: Vec<Vec<String>> = Vec::new();
    for module in imports.keys() {
        let circle = imports.keys().filter(|m| reached[module].contains(*m) && reached[*m].contains(module));
        let circle: Vec<_> = circle.cloned().collect();
        if circle.len() > 1 && !found.contains(&circle) {
            found.push(circle);
        }
    }
    found
}

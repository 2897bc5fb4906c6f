//! What may only become less: today's exceptions and counts stand in `ratchet.txt`, each with its name.
//!
//! `CLEARWAY_BLESS=1 cargo test --workspace --test system ratchet` lowers what has become less and adds nothing. A line
//! that must grow is changed by hand, with the reason behind a `#`. `CLEARWAY_RATCHET=1` prints today's lists.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

use clearway_tests::workspace;

use super::modules::{circles, imports, without_comments};
use super::{entries, files, folders, shown, sources};

/// Longest source file without a line in the list: what a reader holds in mind at once.
const LINES_MAX: usize = 400;
/// Most entries of a folder: what a reader takes in at one look.
const ENTRIES_MAX: usize = 12;
/// Most words of a page without a line in the list: what a reader reads at once.
const WORDS_MAX: usize = 700;
/// Most declarations of a type name: a name that greps has one.
const DECLARATIONS_MAX: usize = 2;

/// Values by name, such as lines by file.
type Values = BTreeMap<String, usize>;

fn ratchet_file() -> PathBuf {
    workspace().join("tests/tests/repository/ratchet.txt")
}

/// A line of the file: the name, the greatest value allowed, and the reason if it was raised.
struct Allowed {
    most: usize,
    reason: String,
}

/// The sections of the file, by title.
fn allowed() -> BTreeMap<String, BTreeMap<String, Allowed>> {
    let mut sections = BTreeMap::<String, BTreeMap<_, _>>::new();
    let mut title = String::new();
    for line in fs::read_to_string(ratchet_file()).unwrap_or_default().lines() {
        if let Some(found) = line.strip_prefix('[').and_then(|line| line.strip_suffix(']')) {
            title = found.to_owned();
            sections.entry(title.clone()).or_default();
        } else if let Some((name, value)) = line.rsplit_once(": ") {
            let (most, reason) = value.split_once('#').unwrap_or((value, ""));
            let most = most.trim().parse().unwrap_or_else(|_| panic!("ratchet.txt: `{line}` ends with no number"));
            let allowed = Allowed { most, reason: reason.trim().to_owned() };
            sections.entry(title.clone()).or_default().insert(name.to_owned(), allowed);
        }
    }
    sections
}

/// Files of code that are longer than [`LINES_MAX`].
fn long_files() -> Values {
    let lines = |file: &Path| fs::read_to_string(file).expect("UTF-8").lines().count();
    let all = files(&workspace(), &["rs", "py", "js", "mjs", "proto"]);
    all.iter().map(|file| (shown(file), lines(file))).filter(|(_, lines)| *lines > LINES_MAX).collect()
}

/// Folders with more than [`ENTRIES_MAX`] entries. Golden files are data.
fn full_folders() -> Values {
    let all = folders().into_iter().filter(|folder| !folder.iter().any(|name| name == "golden"));
    let name = |folder: &Path| if folder == workspace() { "the repository".to_owned() } else { shown(folder) };
    let counts = all.map(|folder| (name(&folder), entries(&folder).len()));
    counts.filter(|(_, entries)| *entries > ENTRIES_MAX).collect()
}

/// Pairs of folders of one crate that reach each other by imports.
fn mutual_folders() -> Values {
    let mut pairs = Values::new();
    for sources in sources() {
        let mut arrows = BTreeMap::<String, BTreeSet<String>>::new();
        for (module, named) in imports(&sources) {
            for (from, to) in named.iter().filter_map(|other| sibling_folders(&sources, &module, other)) {
                arrows.entry(to.clone()).or_default();
                arrows.entry(from).or_default().insert(to);
            }
        }
        for circle in circles(&arrows) {
            for (index, first) in circle.iter().enumerate() {
                let pair = |second: &String| (format!("{}: {first} <-> {second}", shown(&sources)), 1);
                pairs.extend(circle[index + 1..].iter().map(pair));
            }
        }
    }
    pairs
}

/// The folders in which the paths of two modules part; `None` if one of the two is a file there.
fn sibling_folders(sources: &Path, first: &str, second: &str) -> Option<(String, String)> {
    if first.ends_with("tests") {
        return None;
    }
    let [first, second]: [Vec<_>; 2] = [first, second].map(|module| module.split("::").collect());
    let same = first.iter().zip(&second).take_while(|(a, b)| a == b).count();
    let folder = |module: &[&str]| {
        let folder = module.get(..=same)?.join("/");
        sources.join(&folder).is_dir().then_some(folder)
    };
    Some((folder(&first)?, folder(&second)?))
}

/// Names of types that the sources declare more often than [`DECLARATIONS_MAX`] times.
fn repeated_types() -> Values {
    let mut declared = Values::new();
    for file in sources().iter().flat_map(|sources| files(sources, &["rs"])) {
        for line in without_comments(&fs::read_to_string(&file).expect("UTF-8")).lines() {
            if let Some(name) = declared_type(line) {
                *declared.entry(name.to_owned()).or_default() += 1;
            }
        }
    }
    declared.retain(|_, count| *count > DECLARATIONS_MAX);
    declared
}

/// The type that a line declares. An indented `type` belongs to a trait.
fn declared_type(line: &str) -> Option<&str> {
    let mut words = line.split_whitespace().skip_while(|word| word.starts_with("pub"));
    let kind = words.next()?;
    let is_type = ["struct", "enum", "trait", "union"].contains(&kind) || kind == "type" && !line.starts_with(' ');
    let name = words.next().filter(|_| is_type)?;
    let name = name.split(|c: char| !c.is_alphanumeric()).next().unwrap_or_default();
    (!name.is_empty()).then_some(name)
}

/// Pages with more than [`WORDS_MAX`] words.
fn long_pages() -> Values {
    let words = |file: &Path| fs::read_to_string(file).expect("UTF-8").split_whitespace().count();
    let all = files(&workspace(), &["md"]);
    all.iter().map(|file| (shown(file), words(file))).filter(|(_, words)| *words > WORDS_MAX).collect()
}

/// Long options of each subcommand, with its verbs' (`recorder stop --json` is `recorder --json`), and default keys.
fn counts() -> Values {
    let completions = clearway_tests::run(&workspace(), "clearway", &["completions", "fish"]);
    let completions = String::from_utf8(completions.stdout).expect("UTF-8");
    let options: BTreeSet<_> =
        completions.lines().filter_map(long_option).filter(|(_, name)| *name != "help").collect();
    let defaults = fs::read_to_string(workspace().join("deploy/clearway.toml")).expect("UTF-8");
    let is_key = |line: &&str| {
        let is_word = |key: &str| key.chars().all(|c| c.is_ascii_lowercase() || c == '_');
        line.split_once(" = ").is_some_and(|(key, _)| is_word(key))
    };
    Values::from([
        ("long options of all subcommands".to_owned(), options.len()),
        ("keys of deploy/clearway.toml with a default".to_owned(), defaults.lines().filter(is_key).count()),
    ])
}

/// The subcommand and the name of the long option that a line of fish's completions declares.
fn long_option(line: &str) -> Option<(&str, &str)> {
    let (condition, option) = line.split_once(" -l ")?;
    let subcommand = condition.split_once("__fish_clearway_using_subcommand ").map_or("", |(_, rest)| rest);
    Some((subcommand.split([' ', ';', '"']).next()?, option.split(' ').next()?))
}

/// Compares a section with today's values; an entry that is not in the file may not be there at all, unless it is one
/// of the counts that grow with the project.
fn only_shrinks(title: &str, advice: &str, today: &Values) {
    if std::env::var_os("CLEARWAY_RATCHET").is_some() {
        println!("[{title}]\n{}", lines(today));
    }
    if std::env::var_os("CLEARWAY_BLESS").is_some() {
        bless(title, today);
    }
    let sections = allowed();
    let section = sections.get(title).unwrap_or_else(|| panic!("ratchet.txt has no section [{title}]"));
    let most = |name: &str| section.get(name).map_or(0, |allowed| allowed.most);
    let grown: Vec<_> = today.iter().filter(|(name, value)| **value > most(name)).collect();
    let grown = grown.iter().map(|(name, value)| format!("{name}: {value}, allowed {}", most(name)));
    let grown = grown.collect::<Vec<_>>().join("\n");
    assert!(grown.is_empty(), "[{title}] may only shrink ({advice}):\n{grown}");
}

fn lines(values: &Values) -> String {
    values.iter().fold(String::new(), |mut text, (name, value)| {
        writeln!(text, "{name}: {value}").expect("a text grows");
        text
    })
}

/// Lowers the values of a section, and removes values that are no exception any more. A section that is not there gets
/// today's values.
fn bless(title: &str, today: &Values) {
    static ONE_AT_A_TIME: std::sync::Mutex<()> = std::sync::Mutex::new(());
    let _file = ONE_AT_A_TIME.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    let mut sections = allowed();
    match sections.get_mut(title) {
        Some(section) => {
            section.retain(|name, _| today.contains_key(name));
            section.iter_mut().for_each(|(name, allowed)| allowed.most = allowed.most.min(today[name]));
        }
        None => {
            let new = |(name, most): (&String, &usize)| (name.clone(), Allowed { most: *most, reason: String::new() });
            sections.insert(title.to_owned(), today.iter().map(new).collect());
        }
    }
    let mut text = String::new();
    for (title, section) in sections {
        writeln!(text, "[{title}]").expect("a text grows");
        for (name, Allowed { most, reason }) in section {
            let reason = if reason.is_empty() { String::new() } else { format!(" # {reason}") };
            writeln!(text, "{name}: {most}{reason}").expect("a text grows");
        }
    }
    fs::write(ratchet_file(), text).expect("the repository can be written");
}

#[test]
fn no_source_file_is_longer_than_400_lines_but_for_a_list_that_shrinks() {
    only_shrinks("lines of files over 400", "split the file by meaning", &long_files());
}

#[test]
fn no_folder_has_more_than_twelve_entries_but_for_a_list_that_shrinks() {
    only_shrinks("entries of folders over 12", "group what belongs together", &full_folders());
}

#[test]
fn no_two_folders_of_a_crate_import_each_other_but_for_a_list_that_shrinks() {
    only_shrinks("folders that import each other", "move what both need below both", &mutual_folders());
}

#[test]
fn a_type_name_is_declared_at_most_twice_but_for_a_list_that_shrinks() {
    only_shrinks("types declared more than twice", "give it a name that greps", &repeated_types());
}

#[test]
fn no_page_has_more_than_700_words_but_for_a_list_that_shrinks() {
    only_shrinks("words of pages over 700", "make a page of each subject", &long_pages());
}

#[test]
fn options_and_keys_only_become_less() {
    only_shrinks("counts", "raise it by hand, with the reason behind a #", &counts());
}

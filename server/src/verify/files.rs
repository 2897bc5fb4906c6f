//! Paths, patterns and stores of the command line -> files, in alphabetical order; a shard of them.

use std::collections::BTreeSet;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::{Context, Result, bail};

/// Part `index` of `count` equal parts of a list of files; both from 1 on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shard {
    index: usize,
    count: usize,
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let numbers = text.split_once('/').and_then(|(index, count)| Some((index.parse().ok()?, count.parse().ok()?)));
        match numbers {
            Some((index, count)) if (1..=count).contains(&index) => Ok(Self { index, count }),
            _ => Err("I/N is needed, with I from 1 to N, such as 2/5".into()),
        }
    }
}

/// The files that paths, folders, patterns and URLs of stores name, each once, in alphabetical order; with a shard, its
/// part of them, which may be empty. A recording in a store is its URL.
///
/// # Errors
/// If a path does not exist, or a folder, a pattern or a store has no recording.
pub fn find(given: &[String], shard: Option<Shard>) -> Result<Vec<PathBuf>> {
    let mut files = BTreeSet::new();
    for text in given {
        let text = text.strip_prefix("file://").unwrap_or(text);
        if is_url(text) {
            files.extend(in_store(text)?);
            continue;
        }
        let path = Path::new(text);
        // A file may have a name with the letters of patterns.
        if path.is_dir() {
            let inside = matching(&format!("{}/**/*.mcap", glob::Pattern::escape(text)))?;
            if inside.is_empty() {
                bail!("{text}: no file *.mcap in this folder or below");
            }
            files.extend(inside);
        } else if path.exists() || !text.contains(['*', '?', '[']) {
            files.insert(path.to_owned());
        } else {
            let matched = matching(text)?;
            if matched.is_empty() {
                bail!("{text}: no file matches this pattern");
            }
            files.extend(matched);
        }
    }
    // A saved part is a hard link: a file with several names is found by its first one alone.
    let mut seen = BTreeSet::new();
    files.retain(|path| path.metadata().map_or(true, |of| seen.insert((of.dev(), of.ino()))));
    let Some(Shard { index, count }) = shard else { return Ok(files.into_iter().collect()) };
    Ok(files.into_iter().skip(index - 1).step_by(count).collect())
}

/// True for the URL of a store, or of a recording in one.
pub fn is_url(text: &str) -> bool {
    text.contains("://")
}

/// The URLs of the recordings that the URL of a store names.
#[cfg(feature = "store")]
fn in_store(url: &str) -> Result<Vec<PathBuf>> {
    let found = crate::process::block_on(clearway_daemon::store::fetch::list(url))?;
    if found.is_empty() {
        bail!("{url}: no recording *.mcap in this store");
    }
    Ok(found.into_iter().map(PathBuf::from).collect())
}

#[cfg(not(feature = "store"))]
fn in_store(url: &str) -> Result<Vec<PathBuf>> {
    bail!("{url}: this clearway was built without the feature store");
}

/// The files that match a pattern.
fn matching(pattern: &str) -> Result<Vec<PathBuf>> {
    let paths = glob::glob(pattern).with_context(|| format!("{pattern}: not a pattern"))?;
    let paths: Vec<PathBuf> = paths.collect::<Result<_, _>>()?;
    Ok(paths.into_iter().filter(|path| path.is_file()).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_shards_together_are_all_files_each_once() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("deeper")).unwrap();
        for name in ["b.mcap", "a.mcap", "deeper/c.mcap", "d[1].mcap", "e.txt"] {
            std::fs::write(folder.path().join(name), "").unwrap();
        }
        let at = |name: &str| folder.path().join(name).display().to_string();
        std::fs::hard_link(at("b.mcap"), at("deeper/saved.mcap")).unwrap();
        let all = find(&[at(".").trim_end_matches("/.").to_owned()], None).unwrap();
        let names = all.iter().map(|path| path.strip_prefix(folder.path()).unwrap().display().to_string());
        assert_eq!(names.collect::<Vec<_>>(), ["a.mcap", "b.mcap", "d[1].mcap", "deeper/c.mcap"]);
        assert_eq!(find(&[at("*.mcap"), at("a.mcap"), at("deeper/*")], None).unwrap(), all, "each file once");
        assert_eq!(find(&[at("d[1].mcap")], None).unwrap(), all[2..3], "a file of this name, not a pattern");
        for count in 1..7 {
            let shard = |index| find(&[at("**/*.mcap")], Some(Shard { index, count })).unwrap();
            let mut together: Vec<_> = (1..=count).flat_map(shard).collect();
            together.sort();
            assert_eq!(together, all, "{count} shards");
        }
        assert!(find(&[at("*.pcap")], None).unwrap_err().to_string().contains("no file matches"));
        assert!(find(&[at("a[")], None).unwrap_err().to_string().contains("not a pattern"));
    }

    #[test]
    fn a_shard_is_one_of_its_number() {
        assert_eq!("2/5".parse(), Ok(Shard { index: 2, count: 5 }));
        for wrong in ["0/5", "6/5", "1/0", "-1/2", "2", "a/b", "1/2/3", ""] {
            assert!(wrong.parse::<Shard>().is_err(), "{wrong}");
        }
    }
}

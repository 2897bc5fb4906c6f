//! Files and folders -> scans with their labels.
//!
//! A scan `STEM.bin` and its labels `STEM.label` belong together in one folder, in `velodyne/` beside `labels/` as
//! SemanticKITTI lays them out, or in any two folders side by side. Labels without a scan are an error; scans without
//! labels are counted, for a drive is often labelled in part.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Deeper folders are not looked into: a whole data set has `sequences/00/velodyne`.
const DEPTH_MAX: usize = 5;

/// One labelled scan.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Pair {
    /// float32 x y z intensity a point.
    pub scan: PathBuf,
    /// u32 a point.
    pub labels: PathBuf,
}

/// The labelled scans of one path.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Pairs {
    /// In the order of their scans' names, folder by folder.
    pub pairs: Vec<Pair>,
    /// Scans nobody labelled.
    pub unlabelled: usize,
}

/// Why a path gives no pairs.
#[derive(Debug, thiserror::Error)]
pub enum PairsError {
    /// It cannot be read.
    #[error("{}: {source}", path.display())]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// Neither a scan nor labels.
    #[error("{}: a folder, a scan (.bin) or labels (.label) are needed", path.display())]
    Kind {
        /// The file.
        path: PathBuf,
    },
    /// Labels whose scan is missing.
    #[error("{}: no {stem}.bin beside it, in ../velodyne or in a folder beside its own", labels.display())]
    NoScan {
        /// The labels.
        labels: PathBuf,
        /// Name of the scan without its extension.
        stem: String,
    },
    /// Labels that several scans could have.
    #[error("{}: {} and {} could both be its scan", labels.display(), first.display(), second.display())]
    Ambiguous {
        /// The labels.
        labels: PathBuf,
        /// A scan of its name.
        first: PathBuf,
        /// Another.
        second: PathBuf,
    },
    /// Two files of labels for one scan.
    #[error("{}: {} and {} both label it", scan.display(), first.display(), second.display())]
    TwoLabels {
        /// The scan.
        scan: PathBuf,
        /// Labels.
        first: PathBuf,
        /// Others.
        second: PathBuf,
    },
    /// Nothing is labelled.
    #[error("{}: no labelled scan: {scans} scan(s) (.bin), no labels (.label) of their names", path.display())]
    NoPair {
        /// The path.
        path: PathBuf,
        /// Scans found.
        scans: usize,
    },
}

/// Looks for the labelled scans of a folder, or for the other half of a file.
///
/// # Errors
/// [`PairsError`], which names the file that stands alone.
pub fn find(path: &Path) -> Result<Pairs, PairsError> {
    let (mut scans, mut labels) = (BTreeSet::new(), BTreeSet::new());
    let metadata = path.metadata().map_err(|source| PairsError::Read { path: path.to_owned(), source })?;
    if metadata.is_dir() {
        walk(path, 0, &mut scans, &mut labels)?;
    } else {
        match extension(path) {
            Some("label") => _ = labels.insert(path.to_owned()),
            Some("bin") => {
                labels.extend(others(path, "labels", "label")?);
                scans.insert(path.to_owned());
            }
            _ => return Err(PairsError::Kind { path: path.to_owned() }),
        }
    }
    let mut found = Pairs::default();
    for labels in labels {
        let pair = Pair { scan: scan_of(&labels)?, labels };
        if let Some(other) = found.pairs.iter().find(|other| other.scan == pair.scan) {
            let (first, second) = (other.labels.clone(), pair.labels);
            return Err(PairsError::TwoLabels { scan: pair.scan, first, second });
        }
        scans.remove(&pair.scan);
        found.pairs.push(pair);
    }
    if found.pairs.is_empty() {
        return Err(PairsError::NoPair { path: path.to_owned(), scans: scans.len() });
    }
    found.pairs.sort();
    found.unlabelled = scans.len();
    Ok(found)
}

fn extension(path: &Path) -> Option<&str> {
    path.extension()?.to_str()
}

fn walk(
    folder: &Path,
    depth: usize,
    scans: &mut BTreeSet<PathBuf>,
    labels: &mut BTreeSet<PathBuf>,
) -> Result<(), PairsError> {
    for path in entries(folder)? {
        if path.is_dir() {
            if depth < DEPTH_MAX {
                walk(&path, depth + 1, scans, labels)?;
            }
            continue;
        }
        match extension(&path) {
            Some("bin") => _ = scans.insert(path),
            Some("label") => _ = labels.insert(path),
            _ => {}
        }
    }
    Ok(())
}

fn entries(folder: &Path) -> Result<Vec<PathBuf>, PairsError> {
    let read = |source| PairsError::Read { path: folder.to_owned(), source };
    let entries = std::fs::read_dir(folder).map_err(read)?;
    let mut paths = entries.map(|entry| Ok(entry.map_err(read)?.path())).collect::<Result<Vec<_>, _>>()?;
    paths.sort();
    Ok(paths)
}

fn scan_of(labels: &Path) -> Result<PathBuf, PairsError> {
    let scans = others(labels, "velodyne", "bin")?;
    match &scans[..] {
        [scan] => Ok(scan.clone()),
        [] => {
            let stem = labels.file_stem().unwrap_or_default().to_string_lossy().into_owned();
            Err(PairsError::NoScan { labels: labels.to_owned(), stem })
        }
        [first, second, ..] => {
            Err(PairsError::Ambiguous { labels: labels.to_owned(), first: first.clone(), second: second.clone() })
        }
    }
}

/// The files that may be the other half of `path`: the one beside it, else the one in the folder SemanticKITTI has it
/// in, else all in folders beside its own.
fn others(path: &Path, folder: &str, extension: &str) -> Result<Vec<PathBuf>, PairsError> {
    let beside = path.with_extension(extension);
    if beside.is_file() {
        return Ok(vec![beside]);
    }
    // A bare file name has the parent "", whose parent is nowhere.
    let absolute = std::path::absolute(path).map_err(|source| PairsError::Read { path: path.to_owned(), source })?;
    let (Some(name), Some(above)) = (beside.file_name(), absolute.parent().and_then(Path::parent)) else {
        return Ok(Vec::new());
    };
    let usual = above.join(folder).join(name);
    if usual.is_file() {
        return Ok(vec![usual]);
    }
    let all = entries(above)?.into_iter().map(|folder| folder.join(name));
    Ok(all.filter(|file| file.is_file()).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder(files: &[&str]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for file in files {
            let path = folder.path().join(file);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, b"").unwrap();
        }
        folder
    }

    fn names(files: &[&str]) -> Vec<(String, String)> {
        let folder = folder(files);
        let relative = |path: &Path| path.strip_prefix(folder.path()).unwrap().display().to_string();
        let pairs = find(folder.path()).unwrap().pairs;
        pairs.iter().map(|pair| (relative(&pair.scan), relative(&pair.labels))).collect()
    }

    #[test]
    fn scans_and_labels_are_paired_beside_each_other_in_a_sequence_and_in_sibling_folders() {
        let pair = |scan: &str, labels: &str| (scan.to_owned(), labels.to_owned());
        assert_eq!(
            names(&["0.bin", "0.label", "1.label", "1.bin"]),
            [pair("0.bin", "0.label"), pair("1.bin", "1.label")]
        );
        let sequences = ["s/00/velodyne/0.bin", "s/00/labels/0.label", "s/01/velodyne/0.bin", "s/01/labels/0.label"];
        let expected = [pair(sequences[0], sequences[1]), pair(sequences[2], sequences[3])];
        assert_eq!(names(&sequences), expected);
        assert_eq!(names(&["scans/7.bin", "said/7.label", "notes.txt"]), [pair("scans/7.bin", "said/7.label")]);
    }

    #[test]
    fn scans_nobody_labelled_are_counted() {
        let folder = folder(&["a/0.bin", "a/1.bin", "a/2.bin", "b/1.label"]);
        let found = find(folder.path()).unwrap();
        assert_eq!((found.pairs.len(), found.unlabelled), (1, 2));
        assert_eq!(find(&folder.path().join("a/1.bin")).unwrap().pairs, found.pairs);
        assert_eq!(find(&folder.path().join("b/1.label")).unwrap().pairs, found.pairs);
    }

    #[test]
    fn files_that_stand_alone_are_named() {
        let error = |files: &[&str]| find(folder(files).path()).unwrap_err().to_string();
        assert!(error(&["labels/3.label"]).contains("3.label: no 3.bin"));
        assert!(error(&["a/3.bin", "b/3.bin", "c/3.label"]).contains("could both be its scan"));
        assert!(error(&["a/3.bin", "b/3.label", "c/3.label"]).contains("both label it"));
        assert!(error(&["3.bin", "4.bin"]).contains("2 scan(s) (.bin), no labels"));
        assert!(find(Path::new("/no/such/folder")).unwrap_err().to_string().starts_with("/no/such/folder"));
    }
}

//! Files and folders -> scans with their labels.
//!
//! A scan `STEM.bin` and its labels `STEM.label` form a pair in one folder, in `velodyne/` beside `labels/` as
//! SemanticKITTI has them, or in any two folders of one parent. Labels without a scan are an error. Scans without
//! labels are counted, because a drive is often labelled in part.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Greatest depth of the folders that are searched; a whole data set has `sequences/00/velodyne`.
const DEPTH_MAX: usize = 5;

/// One labelled scan.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Pair {
    /// File of the scan: float32 x y z intensity for each point.
    pub scan: PathBuf,
    /// File of the labels: u32 for each point.
    pub labels: PathBuf,
}

/// The labelled scans of one path.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Pairs {
    /// The pairs, sorted by the path of the scan.
    pub pairs: Vec<Pair>,
    /// Number of scans without labels.
    pub unlabelled: usize,
}

/// Why a path has no pairs.
#[derive(Debug, thiserror::Error)]
pub enum PairsError {
    /// A file or folder cannot be read.
    #[error("{}: {source}", path.display())]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// A file that is neither a scan nor labels.
    #[error("{}: a folder, a scan (.bin) or labels (.label) are needed", path.display())]
    Kind {
        /// The file.
        path: PathBuf,
    },
    /// Labels without a scan.
    #[error(
        "{}: no {stem}.bin in its folder, in ../velodyne or in another folder of the same parent",
        labels.display()
    )]
    NoScan {
        /// File of the labels.
        labels: PathBuf,
        /// Name of the scan's file without its extension.
        stem: String,
    },
    /// Labels with several possible scans.
    #[error("{}: {} and {} could both be its scan", labels.display(), first.display(), second.display())]
    Ambiguous {
        /// File of the labels.
        labels: PathBuf,
        /// One scan of that name.
        first: PathBuf,
        /// Another scan of that name.
        second: PathBuf,
    },
    /// Two files of labels for one scan.
    #[error("{}: {} and {} both label it", scan.display(), first.display(), second.display())]
    TwoLabels {
        /// File of the scan.
        scan: PathBuf,
        /// One file of labels.
        first: PathBuf,
        /// Another file of labels.
        second: PathBuf,
    },
    /// No scan is labelled.
    #[error("{}: no labelled scan: {scans} scan(s) (.bin), no labels (.label) of their names", path.display())]
    NoPair {
        /// The path, as given.
        path: PathBuf,
        /// Number of scans found.
        scans: usize,
    },
}

/// Finds the labelled scans of a folder, or the labels of a scan, or the scan of labels.
///
/// # Errors
/// [`PairsError`], which names the file without a counterpart.
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

/// The files that may form a pair with `path`: the one in the same folder, else the one in SemanticKITTI's folder for
/// it, else all of that name in the other folders of the same parent.
fn others(path: &Path, folder: &str, extension: &str) -> Result<Vec<PathBuf>, PairsError> {
    let beside = path.with_extension(extension);
    if beside.is_file() {
        return Ok(vec![beside]);
    }
    // A path without a folder has the parent "", which has no parent.
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
    fn scans_and_labels_pair_in_one_folder_in_a_sequence_and_in_two_folders() {
        let pair = |scan: &str, labels: &str| (scan.to_owned(), labels.to_owned());
        assert_eq!(
            names(&["0.bin", "0.label", "1.label", "1.bin"]),
            [pair("0.bin", "0.label"), pair("1.bin", "1.label")]
        );
        let sequences = ["s/00/velodyne/0.bin", "s/00/labels/0.label", "s/01/velodyne/0.bin", "s/01/labels/0.label"];
        let expected = [pair(sequences[0], sequences[1]), pair(sequences[2], sequences[3])];
        assert_eq!(names(&sequences), expected);
        assert_eq!(names(&["scans/7.bin", "truth/7.label", "notes.txt"]), [pair("scans/7.bin", "truth/7.label")]);
    }

    #[test]
    fn scans_without_labels_are_counted() {
        let folder = folder(&["a/0.bin", "a/1.bin", "a/2.bin", "b/1.label"]);
        let found = find(folder.path()).unwrap();
        assert_eq!((found.pairs.len(), found.unlabelled), (1, 2));
        assert_eq!(find(&folder.path().join("a/1.bin")).unwrap().pairs, found.pairs);
        assert_eq!(find(&folder.path().join("b/1.label")).unwrap().pairs, found.pairs);
    }

    #[test]
    fn a_file_without_its_counterpart_is_named() {
        let error = |files: &[&str]| find(folder(files).path()).unwrap_err().to_string();
        assert!(error(&["labels/3.label"]).contains("3.label: no 3.bin"));
        assert!(error(&["a/3.bin", "b/3.bin", "c/3.label"]).contains("could both be its scan"));
        assert!(error(&["a/3.bin", "b/3.label", "c/3.label"]).contains("both label it"));
        assert!(error(&["3.bin", "4.bin"]).contains("2 scan(s) (.bin), no labels"));
        assert!(find(Path::new("/no/such/folder")).unwrap_err().to_string().starts_with("/no/such/folder"));
    }
}

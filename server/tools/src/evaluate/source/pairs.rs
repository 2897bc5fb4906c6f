//! Files and folders -> scans with their labels.
//!
//! A scan `STEM.bin` or `STEM.pcd` and its labels `STEM.label` form a pair in one folder, in `velodyne/` beside
//! `labels/` as SemanticKITTI has them, or in two folders of one parent. Both are inside the folder that is given, or
//! the labels are at a place of their own that is given too (`--labels`). Labels without a scan are an error. Scans
//! without labels are counted, because a drive is often labelled in part.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};

/// Greatest depth of the folders that are searched; a whole data set has `sequences/00/velodyne`.
const DEPTH_MAX: usize = 5;

/// One labelled scan.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LabelledScan {
    /// File of the scan.
    pub scan: PathBuf,
    /// File of the labels: u32 for each point.
    pub labels: PathBuf,
}

/// The labelled scans of one path.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LabelledScans {
    /// The pairs, sorted by the path of the scan.
    pub pairs: Vec<LabelledScan>,
    /// Number of scans without labels.
    pub unlabelled: usize,
}

/// Finds the labelled scans of a folder, or the labels of a scan. The labels are inside the folder, or beside the scan,
/// unless `labels` names a file or folder of labels. Labels there that belong to no scan of `path` are left out.
///
/// # Errors
/// If a path cannot be read or has no labelled scan, labels have no scan or several, or a scan has several labels. The
/// error names the files.
pub fn find_pairs(path: &Path, labels: Option<&Path>) -> Result<LabelledScans> {
    let mut files = FoundFiles::default();
    files.add(path)?;
    if let Some(labels) = labels {
        let mut elsewhere = FoundFiles::default();
        elsewhere.add(labels)?;
        files.labels = elsewhere.labels;
    }
    let mut found: BTreeMap<&Path, &PathBuf> = BTreeMap::new();
    for file in &files.labels {
        let scan = match files.scans_of(file, labels.is_some())[..] {
            [scan] => scan,
            [] if labels.is_some() => continue,
            [] => bail!(
                "{}: no {stem}.bin or {stem}.pcd in {}, neither beside it, nor in ../velodyne, nor in another folder of \
                 the same parent",
                file.display(),
                path.display(),
                stem = stem(file)
            ),
            [first, second, ..] => {
                bail!("{}: {} and {} could both be its scan", file.display(), first.display(), second.display())
            }
        };
        if let Some(other) = found.insert(scan, file) {
            bail!("{}: {} and {} both label it", scan.display(), other.display(), file.display());
        }
    }
    if found.is_empty() {
        bail!(
            "{}: no labelled scan: {} scan(s) (.bin, .pcd), no labels (.label) of their names; --labels gives labels \
             that are elsewhere",
            path.display(),
            files.scans.len()
        );
    }
    let unlabelled = files.scans.len() - found.len();
    let pair = |(scan, labels): (&Path, &PathBuf)| LabelledScan { scan: scan.to_owned(), labels: labels.clone() };
    Ok(LabelledScans { pairs: found.into_iter().map(pair).collect(), unlabelled })
}

/// The scans and labels that a search has found.
#[derive(Default)]
struct FoundFiles {
    scans: BTreeSet<PathBuf>,
    labels: BTreeSet<PathBuf>,
}

impl FoundFiles {
    /// Adds all files of a folder and of the folders in it. Of a file, adds it with its counterpart.
    fn add(&mut self, path: &Path) -> Result<()> {
        let named = || path.display().to_string();
        if path.metadata().with_context(named)?.is_dir() {
            return self.walk(path, 0);
        }
        // A path without a folder has the parent "", which has no parent.
        let path = std::path::absolute(path).with_context(named)?;
        if !self.insert(path.clone()) {
            bail!("{}: a folder, a scan (.bin, .pcd) or labels (.label) are needed", path.display());
        }
        for file in counterparts(&path).into_iter().filter(|file| file.is_file()) {
            self.insert(file);
        }
        Ok(())
    }

    fn walk(&mut self, folder: &Path, depth: usize) -> Result<()> {
        let named = || folder.display().to_string();
        for entry in std::fs::read_dir(folder).with_context(named)? {
            let path = entry.with_context(named)?.path();
            if !path.is_dir() {
                self.insert(path);
            } else if depth < DEPTH_MAX {
                self.walk(&path, depth + 1)?;
            }
        }
        Ok(())
    }

    /// Adds a file if it is a scan or labels; returns `false` if it is neither.
    fn insert(&mut self, path: PathBuf) -> bool {
        match path.extension().and_then(|extension| extension.to_str()) {
            Some("bin" | "pcd") => _ = self.scans.insert(path),
            Some("label") => _ = self.labels.insert(path),
            _ => return false,
        }
        true
    }

    /// The scans that may belong to these labels: the scans beside the file, else the scans in SemanticKITTI's folder
    /// for scans, else the scans of its name in the other folders of the same parent. Labels that are elsewhere than
    /// all scans may belong to any scan of their name.
    fn scans_of(&self, labels: &Path, are_elsewhere: bool) -> Vec<&Path> {
        let all = || self.scans.iter().map(PathBuf::as_path).filter(|scan| stem(scan) == stem(labels));
        let (folder, above) = (labels.parent(), labels.parent().and_then(Path::parent));
        let usual = above.map(|above| above.join("velodyne"));
        let within = |folder: Option<&Path>| all().filter(|scan| folder.is_some() && scan.parent() == folder).collect();
        let near = || all().filter(|scan| scan.parent().and_then(Path::parent) == above).collect();
        let mut choices: Vec<Vec<&Path>> = vec![within(folder), within(usual.as_deref()), near()];
        if are_elsewhere {
            choices.push(all().collect());
        }
        choices.into_iter().find(|scans| !scans.is_empty()).unwrap_or_default()
    }
}

/// The files that form a pair with a scan or with labels: in the same folder, and in SemanticKITTI's folder for them.
fn counterparts(path: &Path) -> Vec<PathBuf> {
    let (stem, folder) = (stem(path), path.parent().unwrap_or(Path::new("")));
    let (usual, extensions): (_, &[&str]) = match path.extension().is_some_and(|extension| extension == "label") {
        true => ("velodyne", &["bin", "pcd"]),
        false => ("labels", &["label"]),
    };
    let above = folder.parent().unwrap_or(Path::new("")).join(usual);
    let names = extensions.iter().map(|extension| format!("{stem}.{extension}"));
    names.flat_map(|name| [folder.join(&name), above.join(&name)]).collect()
}

/// Name of a file without `.bin`, `.pcd`, `.pcd.bin` or `.label`.
fn stem(path: &Path) -> String {
    let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    name.strip_suffix(".pcd").map_or(name.clone(), str::to_owned)
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
        let pairs = find_pairs(folder.path(), None).unwrap().pairs;
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
        let folder = folder(&["a/0.bin", "a/1.pcd", "a/2.bin", "b/1.label"]);
        let found = find_pairs(folder.path(), None).unwrap();
        assert_eq!((found.pairs.len(), found.unlabelled), (1, 2));
    }

    #[test]
    fn files_beside_the_given_folder_are_not_searched() {
        let folder = folder(&["a/0.label", "b/0.bin"]);
        let error = find_pairs(&folder.path().join("a"), None).unwrap_err().to_string();
        assert!(error.contains("0.label: no 0.bin"), "{error}");
        let error = find_pairs(&folder.path().join("b/0.bin"), None).unwrap_err().to_string();
        assert!(error.contains("no labelled scan: 1 scan(s)"), "{error}");
    }

    #[test]
    fn a_file_finds_its_counterpart_beside_it_and_in_a_sequence() {
        let folder = folder(&["a/0.bin", "a/0.label", "s/velodyne/3.bin", "s/labels/3.label"]);
        for file in ["a/0.bin", "a/0.label", "s/velodyne/3.bin", "s/labels/3.label"] {
            let found = find_pairs(&folder.path().join(file), None).unwrap();
            assert_eq!((found.pairs.len(), found.unlabelled), (1, 0), "{file}");
        }
    }

    #[test]
    fn labels_that_are_elsewhere_are_given() {
        let folder = folder(&["a/0.bin", "a/1.bin", "b/0.label", "b/5.label", "c/d/1.label"]);
        let found = |labels: &str| find_pairs(&folder.path().join("a"), Some(&folder.path().join(labels))).unwrap();
        for (labels, scan) in [("b", "a/0.bin"), ("b/0.label", "a/0.bin"), ("c", "a/1.bin")] {
            let found = found(labels);
            assert_eq!((found.pairs.len(), found.unlabelled), (1, 1), "{labels}");
            assert_eq!(found.pairs[0].scan, folder.path().join(scan), "{labels}");
        }
        let one = find_pairs(&folder.path().join("a/0.bin"), Some(&folder.path().join("b"))).unwrap();
        assert_eq!((one.pairs.len(), one.unlabelled), (1, 0));
    }

    #[test]
    fn a_file_without_its_counterpart_is_named() {
        let error = |files: &[&str]| find_pairs(folder(files).path(), None).unwrap_err().to_string();
        assert!(error(&["labels/3.label"]).contains("3.label: no 3.bin"));
        assert!(error(&["a/3.bin", "b/3.bin", "c/3.label"]).contains("could both be its scan"));
        assert!(error(&["a/3.bin", "b/3.label", "c/3.label"]).contains("both label it"));
        assert!(error(&["3.bin", "4.bin"]).contains("2 scan(s) (.bin, .pcd), no labels"));
        let error = find_pairs(Path::new("/no/such/folder"), None).unwrap_err().to_string();
        assert!(error.starts_with("/no/such/folder"));
    }
}

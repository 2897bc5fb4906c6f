//! A file or folder -> the files to read, with their kinds, or why they cannot be read.

use std::io::{Error, ErrorKind, Read};
use std::path::{Path, PathBuf};

use clearway_daemon::base::file_advice::{advised, open_to_read};

use super::capture::CaptureError;
use super::kitti::ScanError;
use super::mcap::McapError;

/// The kind of a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// pcap or pcapng.
    Capture,
    /// MCAP, or a ROS 2 bag in sqlite, which is read as the MCAP file of the same messages.
    Mcap,
    /// One scan: KITTI `.bin`, nuScenes `.pcd.bin` or `.pcd`.
    Scan,
}

/// Files cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum FilesError {
    /// A file or folder cannot be opened.
    #[error("{}: {source}", file.display())]
    Open {
        /// The file or folder.
        file: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The kind of a file is unknown.
    #[error("{}: not pcap, pcapng, MCAP, .db3, KITTI .bin, nuScenes .pcd.bin or .pcd", file.display())]
    Kind {
        /// The file or folder.
        file: PathBuf,
    },
    /// A file can be read after it is converted.
    #[error("{}: {what}: {advice}", file.display())]
    Converted {
        /// Path of the file.
        file: PathBuf,
        /// The kind of the file, in words.
        what: &'static str,
        /// The command that converts the file.
        advice: String,
    },
    /// A folder has no file of a known kind.
    #[error("{}: no pcap, pcapng, mcap, db3, bin or pcd file in this folder{}", file.display(), within(below))]
    Empty {
        /// The file or folder.
        file: PathBuf,
        /// A folder in it that has such files, if there is one.
        below: Option<PathBuf>,
    },
    /// A file of a vehicle begins before the file before it has ended.
    #[error(
        "{}: it begins {overlap_s:.3} s before the end of the file before it; give the files of one vehicle in the \
         order of their times, without overlap, and each drive in one format",
        file.display()
    )]
    Overlap {
        /// Path of the later file.
        file: PathBuf,
        /// By how much, in seconds.
        overlap_s: f64,
    },
    /// A capture cannot be read.
    #[error(transparent)]
    Capture(#[from] CaptureError),
    /// An MCAP file cannot be read.
    #[error(transparent)]
    Mcap(#[from] McapError),
    /// A scan cannot be read.
    #[error(transparent)]
    Scan(#[from] ScanError),
}

/// A file that is truncated or damaged; the readings of its whole parts were used.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Truncated {
    /// Path of the file.
    pub file: PathBuf,
    /// How the file is incomplete.
    pub reason: String,
}

/// Finds the kind of a file.
///
/// # Errors
/// [`FilesError::Open`] if the file cannot be read or is empty, [`FilesError::Kind`] if its kind is unknown.
pub fn kind(file: &Path) -> Result<Kind, FilesError> {
    let mut magic = Vec::new();
    open_to_read(file)
        .and_then(|open| open.take(8).read_to_end(&mut magic))
        .map_err(|source| FilesError::Open { file: file.to_owned(), source: advised(file, source) })?;
    match &magic[..] {
        // pcap in both byte orders, with micro- and nanoseconds; pcapng's section header.
        [0xd4, 0xc3, 0xb2, 0xa1, ..] | [0xa1, 0xb2, 0xc3, 0xd4, ..] => return Ok(Kind::Capture),
        [0x4d, 0x3c, 0xb2, 0xa1, ..] | [0xa1, 0xb2, 0x3c, 0x4d, ..] => return Ok(Kind::Capture),
        [0x0a, 0x0d, 0x0d, 0x0a, ..] => return Ok(Kind::Capture),
        [0x89, b'M', b'C', b'A', b'P', ..] => return Ok(Kind::Mcap),
        b"SQLite f" => return Ok(Kind::Mcap),
        _ => {}
    }
    // Without known first bytes the name decides; the reader of that kind then reports the fault.
    let by_name = kind_by_name(file);
    if magic.is_empty() && by_name != Some(Kind::Scan) {
        let source = Error::new(ErrorKind::UnexpectedEof, "the file is empty");
        return Err(FilesError::Open { file: file.to_owned(), source });
    }
    let by_name = by_name.ok_or_else(|| FilesError::Kind { file: file.to_owned() });
    conversion(file, &magic).map_or(by_name, Err)
}

/// The error of a file that can be read after it is converted.
fn conversion(file: &Path, magic: &[u8]) -> Option<FilesError> {
    let name = file.display();
    let (what, advice) = match magic {
        [0x28, 0xb5, 0x2f, 0xfd, ..] => ("compressed with zstd as a whole", format!("`zstd -d {name}` first")),
        [0x1f, 0x8b, ..] => ("compressed with gzip", format!("`gunzip -k {name}` first")),
        [0x04, 0x22, 0x4d, 0x18, ..] => ("compressed with lz4 as a whole", format!("`lz4 -d {name}` first")),
        [b'P', b'K', 3, 4, ..] => ("a zip archive", format!("`unzip {name}` first")),
        [b'B', b'Z', b'h', ..] => ("compressed with bzip2", format!("`bunzip2 -k {name}` first")),
        _ if magic.starts_with(b"#ROSBAG ") => {
            ("a ROS 1 bag", format!("`rosbags-convert --src {name} --dst ros2_bag` first"))
        }
        _ => return None,
    };
    Some(FilesError::Converted { file: file.to_owned(), what, advice })
}

fn kind_by_name(file: &Path) -> Option<Kind> {
    match file.extension()?.to_str()? {
        "pcap" | "pcapng" => Some(Kind::Capture),
        "mcap" | "db3" => Some(Kind::Mcap),
        "bin" | "pcd" => Some(Kind::Scan),
        _ => None,
    }
}

/// Finds the files of a folder whose kind is known, in the order in which they are read.
///
/// # Errors
/// [`FilesError::Empty`] if there is none, [`FilesError::Converted`] if all must be converted first, or the error of a
/// file that cannot be read.
pub fn files_of_folder(folder: &Path) -> Result<Vec<(PathBuf, Kind)>, FilesError> {
    let open = |source| FilesError::Open { file: folder.to_owned(), source: advised(folder, source) };
    let (mut files, mut to_convert) = (Vec::new(), None);
    for entry in std::fs::read_dir(folder).map_err(open)? {
        let file = entry.map_err(open)?.path();
        // A copy of a macOS folder has a `._NAME` beside each file.
        if is_hidden(&file) {
            continue;
        }
        if file.is_file() && kind_by_name(&file).is_some() {
            files.push((file.clone(), kind(&file)?));
        } else if file.is_file()
            && let Err(error @ FilesError::Converted { .. }) = kind(&file)
        {
            to_convert = to_convert.or(Some(error));
        }
    }
    if let Some(error) = to_convert.filter(|_| files.is_empty()) {
        return Err(error);
    }
    if files.is_empty() {
        return Err(FilesError::Empty { file: folder.to_owned(), below: folder_below(folder) });
    }
    files.sort_by_cached_key(|(file, _)| order_of(file));
    Ok(files)
}

fn is_hidden(file: &Path) -> bool {
    file.file_name().is_some_and(|name| name.as_encoded_bytes().starts_with(b"."))
}

/// The first folder of a folder that has a file of a known kind.
fn folder_below(folder: &Path) -> Option<PathBuf> {
    let paths = |folder: &Path| -> Vec<PathBuf> {
        let mut paths: Vec<_> = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|e| e.path()).collect();
        paths.sort();
        paths
    };
    let has_drive = |folder: &PathBuf| paths(folder).iter().any(|file| kind_by_name(file).is_some());
    paths(folder).into_iter().find(|below| below.is_dir() && has_drive(below))
}

fn within(below: &Option<PathBuf>) -> String {
    below.as_ref().map_or_else(String::new, |below| format!("; give one of its folders, such as {}", below.display()))
}

/// The files that the `metadata.yaml` of a ROS 2 bag names and that are not in its folder.
pub fn missing_parts(folder: &Path) -> Vec<Truncated> {
    let metadata = std::fs::read_to_string(folder.join("metadata.yaml")).unwrap_or_default();
    let listed = metadata.lines().skip_while(|line| line.trim() != "relative_file_paths:").skip(1);
    let names = listed.map_while(|line| line.trim().strip_prefix("- ")).map(|name| name.trim_matches(['"', '\'', ' ']));
    let missing = names.filter(|name| !folder.join(name).exists());
    let reason = "metadata.yaml names it as a part of the bag, and it is not in the folder";
    missing.map(|name| Truncated { file: folder.join(name), reason: reason.to_owned() }).collect()
}

/// The place of a file in its folder: by name, and the files of a split bag or recording by their numbers, so that
/// `drive_10` follows `drive_9`.
fn order_of(file: &Path) -> (String, usize, String) {
    let name = file.file_name().unwrap_or_default().to_string_lossy();
    let (stem, ending) = name.split_once('.').unwrap_or((&name, ""));
    let text = stem.trim_end_matches(|c: char| c.is_ascii_digit());
    let number = stem[text.len()..].trim_start_matches('0');
    // Of two numbers without leading zeros, the number with fewer digits is less.
    (text.to_owned(), number.len(), format!("{number}.{ending}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_bytes_give_the_kind_of_a_file_or_else_its_name() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str, bytes: &[u8]| {
            let file = folder.path().join(name);
            std::fs::write(&file, bytes).unwrap();
            file
        };
        assert_eq!(kind(&at("drive", &[0xd4, 0xc3, 0xb2, 0xa1, 2, 0])).unwrap(), Kind::Capture);
        assert_eq!(kind(&at("a.bin", &[0x89, b'M', b'C', b'A', b'P'])).unwrap(), Kind::Mcap);
        assert_eq!(kind(&at("b.bin", &[0; 16])).unwrap(), Kind::Scan);
        assert!(matches!(kind(&at("notes.txt", b"hello")), Err(FilesError::Kind { .. })));
        assert_eq!(kind(&at("bag_0.db3", b"SQLite format 3\0")).unwrap(), Kind::Mcap);
        assert!(matches!(kind(Path::new("/no/such/file")), Err(FilesError::Open { .. })));
    }
}

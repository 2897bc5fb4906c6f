//! Scan files of other programs -> readings: KITTI `.bin`, nuScenes `.pcd.bin` and `.pcd`, read by
//! [`clearway_mapping::scan_file`].
//!
//! These files have no stamps. The scans get the stamps of a 10 Hz sensor from a fixed time on ([`EPOCH_NS`]), so that
//! the same files always yield the same maps.

use std::path::{Path, PathBuf};

use clearway_daemon::ingest::queue::Reading;
use clearway_mapping::event::Body;
use clearway_mapping::scan_file::{self, ScanFileError, ScanFormat};

/// Stamp of the first scan, ns since the Unix epoch: 2011-09-26 00:00:00 UTC, the day of KITTI's first drives.
pub const EPOCH_NS: i64 = 1_316_995_200_000_000_000;
/// Time between two scans, in ns: 10 Hz, as the sensor of KITTI.
pub const PERIOD_NS: i64 = 100_000_000;

/// A scan cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum ScanError {
    /// The file cannot be read.
    #[error("{}: {source}", file.display())]
    Read {
        /// Path of the file.
        file: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The file has no valid scan.
    #[error("{}: {source}", file.display())]
    Scan {
        /// Path of the file.
        file: PathBuf,
        /// Why the file has no valid scan.
        source: Box<ScanFileError>,
    },
}

/// Reads one scan. Its stamp follows from `index`, which counts the scans of this replay from 0.
///
/// # Errors
/// [`ScanError::Read`] if the file cannot be read, [`ScanError::Scan`] if it has no valid scan.
pub fn read(file: &Path, index: u64) -> Result<Reading, ScanError> {
    read_with_format(file, index).map(|(_, reading)| reading)
}

/// Reads one scan as [`read`] does, with the format of its file.
///
/// # Errors
/// [`ScanError::Read`] if the file cannot be read, [`ScanError::Scan`] if it has no valid scan.
pub fn read_with_format(file: &Path, index: u64) -> Result<(ScanFormat, Reading), ScanError> {
    let bytes = std::fs::read(file).map_err(|source| ScanError::Read { file: file.to_owned(), source })?;
    let scan = scan_file::read(&file.to_string_lossy(), &bytes);
    let (format, mut scan) = scan.map_err(|source| ScanError::Scan { file: file.to_owned(), source: source.into() })?;
    scan.stamp_ns = EPOCH_NS + i64::try_from(index).unwrap_or(i64::MAX / PERIOD_NS) * PERIOD_NS;
    Ok((format, Reading { arrival_ns: scan.stamp_ns, source: 0, body: Body::Scan(scan) }))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn written(name: &str, bytes: &[u8]) -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join(name);
        std::fs::write(&file, bytes).unwrap();
        (folder, file)
    }

    #[test]
    fn scans_without_stamps_are_a_tenth_of_a_second_apart() {
        let bytes: Vec<u8> = [1.0f32, 2.0, 3.0, 0.5].iter().flat_map(|v| v.to_le_bytes()).collect();
        let (_folder, file) = written("0.bin", &bytes);
        let (format, reading) = read_with_format(&file, 3).unwrap();
        let Reading { arrival_ns, body: Body::Scan(scan), .. } = reading else { panic!("no scan") };
        assert_eq!(format, ScanFormat::Kitti);
        assert_eq!(arrival_ns, EPOCH_NS + 300_000_000);
        assert_eq!((scan.x, scan.z, scan.intensity), (vec![1.0], vec![3.0], vec![0.5]));
    }
}

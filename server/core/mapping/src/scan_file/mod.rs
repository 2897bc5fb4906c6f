//! Scan files of other programs -> [`Scan`]: KITTI `.bin`, nuScenes `.pcd.bin`, and `.pcd`. Such files contain no
//! stamps: the stamp of the scan is 0.
//!
//! | file | in -> out |
//! |---|---|
//! | `bin` | float32 x y z intensity (KITTI), or with ring (nuScenes); the content decides which -> scan |
//! | `pcd` | `.pcd` in ASCII, binary and compressed binary -> scan |
//! | `lzf` | LZF -> plain bytes, as many as stated |
//! | `format` | the formats; rings for a scan whose file states none |
//! | `error` | why a file is refused |
//!
//! Points keep the axes of the file. A point whose coordinates are not finite stays in the scan, so that labels keep
//! their points; the maps leave it out and count it. If a file states no rings, and its points are stored ring by ring,
//! as KITTI's are, the rings follow from the order of the points.

mod bin;
mod error;
mod format;
mod lzf;
mod pcd;

use crate::sensor::observation::Scan;

pub use bin::read_bin;
pub use error::{BinDoubt, ScanFileError};
pub use format::{POINTS_MAX, ScanFormat};
pub use pcd::read_pcd;

/// Reads a scan file. A name that ends in `.pcd` means Point Cloud Data; the content of any other file decides between
/// KITTI and nuScenes, and if it fits both, the ending `.pcd.bin` means nuScenes.
///
/// # Errors
/// [`ScanFileError`] as [`read_bin`] and [`read_pcd`].
pub fn read(name: &str, bytes: &[u8]) -> Result<(ScanFormat, Scan), ScanFileError> {
    if name.to_ascii_lowercase().ends_with(".pcd") {
        return Ok((ScanFormat::Pcd, read_pcd(bytes)?));
    }
    bin::read_named(name, bytes)
}

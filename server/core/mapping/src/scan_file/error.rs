//! Why a scan file cannot be read.

use super::format::POINTS_MAX;

/// A scan file that cannot be read.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ScanFileError {
    /// The length of a `.bin` file is 0, no multiple of the length of a point, or too large.
    #[error("{bytes} bytes: a KITTI scan has 16 a point, a nuScenes scan 20, and a scan has up to {POINTS_MAX} points")]
    Length {
        /// Length of the file, bytes.
        bytes: usize,
    },
    /// The content of a `.bin` file is neither a KITTI nor a nuScenes scan.
    #[error("neither a KITTI scan (16 bytes a point: {kitti}) nor a nuScenes scan (20 bytes a point: {nuscenes})")]
    Content {
        /// Why it is no KITTI scan.
        kitti: BinDoubt,
        /// Why it is no nuScenes scan.
        nuscenes: BinDoubt,
    },
    /// An entry of the header of a `.pcd` file is not allowed, or does not fit its points.
    #[error("{what} = {value}: allowed: {allowed}")]
    Pcd {
        /// Name of the entry.
        what: &'static str,
        /// Value of the entry.
        value: String,
        /// What is allowed.
        allowed: &'static str,
    },
}

/// Why the content of a `.bin` file is no scan of one format.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum BinDoubt {
    /// The length of the file is no multiple of the length of a point.
    #[error("the length is no multiple of it")]
    Length,
    /// Too many points have values that no sensor returns.
    #[error("{odd} of {points} points are impossible, the first is point {first} with {field} = {value}")]
    Values {
        /// Number of points with such a value.
        odd: usize,
        /// Number of points of the file.
        points: usize,
        /// Index of the first such point.
        first: usize,
        /// Name of its first such value.
        field: &'static str,
        /// The value.
        value: f32,
    },
}

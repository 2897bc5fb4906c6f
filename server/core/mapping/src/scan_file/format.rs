//! The formats of scan files, and what all of them have in common.

use crate::sensor::observation::Scan;
use crate::sensor::rings;

/// Greatest number of points of a scan file. Ours: no sensor returns more in one revolution. A header that states more
/// is refused before memory is allocated.
pub const POINTS_MAX: usize = 4_000_000;

/// The format of a scan file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ScanFormat {
    /// KITTI `.bin`: float32 x y z intensity, 16 bytes a point.
    Kitti,
    /// nuScenes `.pcd.bin`: float32 x y z intensity ring, 20 bytes a point.
    NuScenes,
    /// Point Cloud Data, `.pcd`.
    Pcd,
}

impl ScanFormat {
    /// Name of the format, for people.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Kitti => "KITTI .bin",
            Self::NuScenes => "nuScenes .pcd.bin",
            Self::Pcd => "PCD",
        }
    }

    /// Yaw of the sensor on a vehicle whose x axis points forward, degrees. The x axis of nuScenes' LIDAR points to the
    /// right of the vehicle and its y axis forward; the other formats have x forward.
    pub fn yaw_deg(self) -> f64 {
        if self == Self::NuScenes { -90.0 } else { 0.0 }
    }
}

/// Fills in the rings of a scan whose file states none, if its points are stored ring by ring; ranks stated rings by
/// their elevations, lowest first.
pub(super) fn complete_rings(scan: &mut Scan) {
    scan.ring = if scan.ring.is_empty() { rings::from_order(scan) } else { rings::ranked(scan) }.unwrap_or_default();
}

//! Scan files without a header: KITTI `.bin` and nuScenes `.pcd.bin`.
//!
//! Nothing in such a file states its format, and most lengths fit both. A file is read as the format whose values a
//! sensor can return: coordinates within a kilometre, an intensity of 0 to 255, and for nuScenes a small whole number
//! as ring. A file of one format that is read as the other has coordinates in place of intensities or rings.

use super::error::{BinDoubt, ScanFileError};
use super::format::{POINTS_MAX, ScanFormat, complete_rings};
use crate::sensor::config::RINGS_MAX;
use crate::sensor::observation::Scan;

/// Greatest coordinate of a point, metres. Ours, as of all positions: no sensor of the family reaches half as far.
const COORDINATE_M_MAX: f32 = 1000.0;
/// Greatest intensity: KITTI states 0 to 1, nuScenes 0 to 255.
const INTENSITY_MAX: f32 = 255.0;
/// One point in this many may have impossible values, beside the lost returns. Ours: a file that is read as the wrong
/// format has such values in a third of its points.
const ODD_PARTS_MAX: usize = 20;

/// Reads a KITTI or nuScenes scan. The content decides which it is; if it fits both, it is KITTI's.
///
/// # Errors
/// [`ScanFileError::Length`] if the file is not a list of 1 to [`POINTS_MAX`] points, [`ScanFileError::Content`] if its
/// values fit neither format.
pub fn read_bin(bytes: &[u8]) -> Result<Scan, ScanFileError> {
    read_named("", bytes).map(|(_, scan)| scan)
}

/// Reads a scan, with its format; if the content fits both formats, the name decides.
///
/// # Errors
/// As [`read_bin`].
pub(super) fn read_named(name: &str, bytes: &[u8]) -> Result<(ScanFormat, Scan), ScanFileError> {
    let fits_length = |stride| bytes.len().is_multiple_of(stride) && bytes.len() / stride <= POINTS_MAX;
    if bytes.is_empty() || !(fits_length(16) || fits_length(20)) {
        return Err(ScanFileError::Length { bytes: bytes.len() });
    }
    let check =
        |fits, check: fn(&[u8]) -> Result<(), BinDoubt>| if fits { check(bytes) } else { Err(BinDoubt::Length) };
    let is_named_nuscenes = name.to_ascii_lowercase().ends_with(".pcd.bin");
    let format = match (check(fits_length(16), check_values::<16>), check(fits_length(20), check_values::<20>)) {
        (Err(kitti), Err(nuscenes)) => return Err(ScanFileError::Content { kitti, nuscenes }),
        (Ok(()), Ok(())) if is_named_nuscenes => ScanFormat::NuScenes,
        (Ok(()), _) => ScanFormat::Kitti,
        (Err(_), Ok(())) => ScanFormat::NuScenes,
    };
    let mut scan = if format == ScanFormat::Kitti { points::<16>(bytes) } else { points::<20>(bytes) };
    complete_rings(&mut scan);
    Ok((format, scan))
}

fn float(point: &[u8], field: usize) -> f32 {
    f32::from_le_bytes([0, 1, 2, 3].map(|byte| point[4 * field + byte]))
}

/// The first value of a point that no sensor returns, with its name.
fn odd_value(point: &[u8]) -> Option<(&'static str, f32)> {
    // NaN fails every comparison. Small whole numbers and text look like tiny, subnormal floats.
    let is_coordinate = |v: f32| v.abs() <= COORDINATE_M_MAX && !v.is_subnormal();
    let is_intensity = |v: f32| (0.0..=INTENSITY_MAX).contains(&v) && !v.is_subnormal();
    let is_ring = |v: f32| (0.0..RINGS_MAX as f32).contains(&v) && v.fract() == 0.0;
    let checks: [(&str, &dyn Fn(f32) -> bool); 5] = [
        ("x", &is_coordinate),
        ("y", &is_coordinate),
        ("z", &is_coordinate),
        ("intensity", &is_intensity),
        ("ring", &is_ring),
    ];
    let fields = (0..point.len() / 4).map(|field| float(point, field));
    checks.iter().zip(fields).find(|((_, is_possible), value)| !is_possible(*value)).map(|((name, _), v)| (*name, v))
}

/// True if all coordinates of a point are NaN: an organised cloud states a lost return so.
fn is_lost(point: &[u8]) -> bool {
    (0..3).all(|field| float(point, field).is_nan())
}

fn check_values<const STRIDE: usize>(bytes: &[u8]) -> Result<(), BinDoubt> {
    let stated = || bytes.chunks_exact(STRIDE).enumerate().filter(|(_, point)| !is_lost(point));
    let points = stated().count();
    let mut odd = stated().filter_map(|(at, point)| Some((at, odd_value(point)?)));
    let Some((first, (field, value))) = odd.next() else { return Ok(()) };
    let odd = 1 + odd.count();
    if odd * ODD_PARTS_MAX <= points { Ok(()) } else { Err(BinDoubt::Values { odd, points, first, field, value }) }
}

fn points<const STRIDE: usize>(bytes: &[u8]) -> Scan {
    let field = |field: usize| -> Vec<f32> { bytes.chunks_exact(STRIDE).map(|point| float(point, field)).collect() };
    let mut scan = Scan { x: field(0), y: field(1), z: field(2), intensity: field(3), ..Scan::default() };
    if STRIDE == 20 {
        scan.intensity.iter_mut().for_each(|intensity| *intensity /= INTENSITY_MAX);
        // A ring that is no whole number is saturated; so few points have such a ring that the ring's elevation stays.
        scan.ring = field(4).into_iter().map(|ring| ring as u16).collect();
    }
    scan
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bytes(floats: &[f32]) -> Vec<u8> {
        floats.iter().flat_map(|value| value.to_le_bytes()).collect()
    }

    /// Points of `fields` floats on 8 rings on level ground, ring by ring from the lowest.
    fn scan(fields: usize) -> Vec<u8> {
        let point = |i: usize| {
            let (ring, angle) = ((i / 100) as f32, (i % 100) as f32 * 0.0628);
            [(4.0 + ring) * libm::cosf(angle), (4.0 + ring) * libm::sinf(angle), -1.7, 0.25, ring, 0.013 * i as f32]
        };
        (0..800).flat_map(|i| bytes(&point(i)[..fields])).collect()
    }

    #[test]
    fn a_scan_file_with_half_a_point_is_refused_with_its_length() {
        assert_eq!(read_bin(&[0; 24]), Err(ScanFileError::Length { bytes: 24 }));
        assert_eq!(read_bin(&[]), Err(ScanFileError::Length { bytes: 0 }));
    }

    #[test]
    fn the_content_of_a_file_gives_its_format_whatever_its_name() {
        for name in ["0.bin", "0.pcd.bin", "scan"] {
            let (format, kitti) = read_named(name, &scan(4)).unwrap();
            assert_eq!((format, kitti.x.len(), kitti.intensity[5]), (ScanFormat::Kitti, 800, 0.25), "{name}");
            let (format, nuscenes) = read_named(name, &scan(5)).unwrap();
            assert_eq!((format, nuscenes.x.len(), nuscenes.intensity[5]), (ScanFormat::NuScenes, 800, 0.25 / 255.0));
            assert_eq!((&kitti.x, &kitti.z, &kitti.ring), (&nuscenes.x, &nuscenes.z, &nuscenes.ring), "{name}");
            assert_eq!((nuscenes.ring[0], nuscenes.ring[799]), (0, 7));
        }
        // Zeros fit both formats: the name decides.
        let zeros = [0; 80];
        assert_eq!(read_named("a.bin", &zeros).unwrap().0, ScanFormat::Kitti);
        assert_eq!(read_named("a.pcd.bin", &zeros).unwrap().0, ScanFormat::NuScenes);
    }

    #[test]
    fn a_file_that_is_neither_format_is_refused_with_the_reason() {
        // x y z alone; x y z intensity ring time.
        for fields in [3, 6] {
            let error = read_bin(&scan(fields)).unwrap_err();
            assert!(matches!(error, ScanFileError::Content { .. }), "{fields}: {error:?}");
            let message = error.to_string();
            assert!(message.contains("of 600 points") || message.contains("of 1200 points"), "{message}");
            assert!(message.contains("are impossible, the first is point"), "{message}");
        }
        let labels: Vec<u8> = (0..4000u32).flat_map(|i| (40 + i % 30).to_le_bytes()).collect();
        assert!(matches!(read_bin(&labels), Err(ScanFileError::Content { .. })));
        let doubles: Vec<u8> = (0..4000).flat_map(|i| (f64::from(i) * 0.017 - 30.0).to_le_bytes()).collect();
        assert!(matches!(read_bin(&doubles), Err(ScanFileError::Content { .. })));
        let far = [1.0f32, 2.0, 1001.0, 0.5].repeat(3);
        let message = read_bin(&bytes(&far)).unwrap_err().to_string();
        let expected = "3 of 3 points are impossible, the first is point 0 with z = 1001";
        assert!(message.contains(expected) && message.contains("the length is no multiple of it"), "{message}");
    }

    #[test]
    fn one_point_in_twenty_may_be_lost() {
        let mut floats = [1.0f32, 2.0, -1.7, 0.5].repeat(40);
        floats[8] = f32::NAN;
        floats[16] = f32::INFINITY;
        let scan = read_bin(&bytes(&floats)).unwrap();
        assert!(scan.x.len() == 40 && scan.x[2].is_nan(), "the points keep their places");
        floats[24] = f32::NAN;
        assert!(matches!(read_bin(&bytes(&floats)), Err(ScanFileError::Content { .. })));
    }
}

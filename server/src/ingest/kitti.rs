//! Scans somebody else has assembled -> readings: KITTI `.bin` (float32 x y z intensity) and `.pcd` (binary or ASCII, with
//! fields x y z and, where present, intensity).
//!
//! Such files carry no stamps: the scans are given those of a 10 Hz sensor from a fixed moment on ([`EPOCH_NS`]), so that
//! the same files always make the same maps.

use std::path::{Path, PathBuf};

use clearway_mapping::event::{Body, Scan};

use super::Reading;

/// Stamp of the first scan: 2011-09-26 00:00:00 UTC, the day of KITTI's first drives.
pub const EPOCH_NS: i64 = 1_316_995_200_000_000_000;
/// Scans come at 10 Hz.
pub const PERIOD_NS: i64 = 100_000_000;
/// No sensor gives more in one turn; a header that claims it is refused before anything is allocated.
const POINTS_MAX: usize = 4_000_000;

/// Why a scan cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum ScanError {
    /// The file cannot be read.
    #[error("{}: {source}", file.display())]
    Read {
        /// The scan.
        file: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// A `.bin` that is no list of points.
    #[error("{}: {bytes} bytes: a KITTI scan has 16 a point, and up to {POINTS_MAX} points", file.display())]
    Length {
        /// The scan.
        file: PathBuf,
        /// Bytes in it.
        bytes: usize,
    },
    /// A `.pcd` that cannot be used.
    #[error("{}: {what} = {value}: allowed: {allowed}", file.display())]
    Pcd {
        /// The scan.
        file: PathBuf,
        /// Which header entry.
        what: &'static str,
        /// What was found.
        value: String,
        /// What may stand there.
        allowed: &'static str,
    },
}

/// Reads one scan; `index` counts the scans of this replay from 0 and gives it its stamp.
///
/// # Errors
/// [`ScanError`], which names the file and what is wrong with it.
pub fn read(file: &Path, index: u64) -> Result<Reading, ScanError> {
    let bytes = std::fs::read(file).map_err(|source| ScanError::Read { file: file.to_owned(), source })?;
    let mut scan = match file.extension().and_then(|extension| extension.to_str()) {
        Some("pcd") => read_pcd(file, &bytes)?,
        _ => read_bin(file, &bytes)?,
    };
    scan.stamp_ns = EPOCH_NS + i64::try_from(index).unwrap_or(i64::MAX / PERIOD_NS) * PERIOD_NS;
    Ok(Reading { arrival_ns: scan.stamp_ns, source: 0, body: Body::Scan(scan) })
}

fn read_bin(file: &Path, bytes: &[u8]) -> Result<Scan, ScanError> {
    if bytes.is_empty() || !bytes.len().is_multiple_of(16) || bytes.len() / 16 > POINTS_MAX {
        return Err(ScanError::Length { file: file.to_owned(), bytes: bytes.len() });
    }
    let mut scan = Scan::default();
    for point in bytes.chunks_exact(16) {
        let [x, y, z, intensity] = [0, 4, 8, 12].map(|at| f32::from_le_bytes([0, 1, 2, 3].map(|i| point[at + i])));
        scan.x.push(x);
        scan.y.push(y);
        scan.z.push(z);
        scan.intensity.push(intensity);
    }
    Ok(scan)
}

/// Where one field of a PCD point lies.
#[derive(Clone, Copy)]
struct Field {
    /// Index of the field among the numbers of an ASCII line.
    column: usize,
    /// First byte of the field in a binary point.
    offset: usize,
}

fn read_pcd(file: &Path, bytes: &[u8]) -> Result<Scan, ScanError> {
    let wrong =
        |what, value: &str, allowed| ScanError::Pcd { file: file.to_owned(), what, value: value.into(), allowed };
    let (mut fields, mut sizes, mut types, mut counts) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let (mut points, mut rest) = (None, bytes);
    let data = loop {
        let Some(end) = rest.iter().position(|&byte| byte == b'\n') else {
            return Err(wrong("DATA", "(missing)", "a header that ends with DATA binary or DATA ascii"));
        };
        let line = String::from_utf8_lossy(&rest[..end]).into_owned();
        rest = &rest[end + 1..];
        let mut words = line.split_whitespace().map(str::to_owned);
        let numbers =
            |words: &mut dyn Iterator<Item = String>| words.map(|w| w.parse().unwrap_or(0)).collect::<Vec<usize>>();
        match words.next().as_deref() {
            Some("FIELDS") => fields = words.collect(),
            Some("SIZE") => sizes = numbers(&mut words),
            Some("TYPE") => types = words.collect(),
            Some("COUNT") => counts = numbers(&mut words),
            Some("POINTS") => points = numbers(&mut words).first().copied(),
            Some("DATA") => break words.next().unwrap_or_default(),
            _ => {}
        }
    };
    let points = points.filter(|&points| points <= POINTS_MAX);
    let points = points.ok_or_else(|| wrong("POINTS", "(missing or too many)", "0 to 4000000"))?;
    if counts.is_empty() {
        counts = vec![1; fields.len()];
    }
    if sizes.len() != fields.len() || types.len() != fields.len() || counts.len() != fields.len() {
        return Err(wrong("FIELDS", &fields.join(" "), "one SIZE, TYPE and COUNT each"));
    }
    let find = |name: &str| {
        let index = fields.iter().position(|field| field == name)?;
        let float = sizes[index] == 4 && types[index] == "F" && counts[index] == 1;
        let column = counts[..index].iter().sum();
        let offset = counts[..index].iter().zip(&sizes).map(|(count, size)| count.saturating_mul(*size)).sum();
        float.then_some(Field { column, offset })
    };
    let position = |name| find(name).ok_or_else(|| wrong("FIELDS", &fields.join(" "), "x y z as 4-byte floats"));
    let places = [Some(position("x")?), Some(position("y")?), Some(position("z")?), find("intensity")];

    let mut scan = Scan::default();
    let mut push = |value: &dyn Fn(Field) -> Option<f32>| {
        let [x, y, z, intensity] = places.map(|place| place.map_or(Some(0.0), value));
        if let (Some(x), Some(y), Some(z), Some(intensity)) = (x, y, z, intensity) {
            scan.x.push(x);
            scan.y.push(y);
            scan.z.push(z);
            scan.intensity.push(intensity);
        }
    };
    match data.as_str() {
        "binary" => {
            let stride: usize = counts.iter().zip(&sizes).map(|(count, size)| count.saturating_mul(*size)).sum();
            if stride == 0 || rest.len() / stride < points {
                return Err(wrong("POINTS", &points.to_string(), "as many as the file has bytes for"));
            }
            for point in rest.chunks_exact(stride).take(points) {
                push(&|field| {
                    let bytes = point.get(field.offset..field.offset + 4)?;
                    Some(f32::from_le_bytes(bytes.try_into().ok()?))
                });
            }
        }
        "ascii" => {
            for line in String::from_utf8_lossy(rest).lines().take(points) {
                let words: Vec<&str> = line.split_whitespace().collect();
                push(&|field| words.get(field.column)?.parse().ok());
            }
        }
        other => return Err(wrong("DATA", other, "binary, ascii")),
    }
    if scan.x.len() != points {
        return Err(wrong("POINTS", &points.to_string(), "as many as there are lines of numbers"));
    }
    Ok(scan)
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
        let Reading { arrival_ns, body: Body::Scan(scan), .. } = read(&file, 3).unwrap() else { panic!("no scan") };
        assert_eq!(arrival_ns, EPOCH_NS + 300_000_000);
        assert_eq!((scan.x, scan.z, scan.intensity), (vec![1.0], vec![3.0], vec![0.5]));
    }

    #[test]
    fn a_scan_of_half_a_point_is_refused_with_its_length() {
        let (_folder, file) = written("0.bin", &[0; 24]);
        assert!(matches!(read(&file, 0), Err(ScanError::Length { bytes: 24, .. })));
    }

    #[test]
    fn ascii_and_binary_pcd_say_the_same() {
        let header = |data| {
            format!(
                "VERSION 0.7\nFIELDS x y z label intensity\nSIZE 4 4 4 2 4\nTYPE F F F U F\nCOUNT 1 1 1 1 1\nPOINTS 1\nDATA {data}\n"
            )
        };
        let (_a, ascii) = written("a.pcd", format!("{}1 2 3 9 0.5\n", header("ascii")).as_bytes());
        let mut bytes = header("binary").into_bytes();
        [1.0f32, 2.0, 3.0].iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        bytes.extend(9u16.to_le_bytes());
        bytes.extend(0.5f32.to_le_bytes());
        let (_b, binary) = written("b.pcd", &bytes);
        assert_eq!(read(&ascii, 0).unwrap(), read(&binary, 0).unwrap());
    }

    #[test]
    fn a_pcd_that_claims_more_points_than_it_has_is_refused() {
        let claim = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nPOINTS 3999999\nDATA binary\n";
        let (_folder, file) = written("a.pcd", claim.as_bytes());
        let error = read(&file, 0).unwrap_err().to_string();
        assert!(error.contains("POINTS = 3999999"), "{error}");
    }
}

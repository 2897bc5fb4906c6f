//! Scans as files hold them -> [`Scan`]: KITTI `.bin` (float32 x y z intensity) and `.pcd` (binary or ASCII, with fields
//! x y z and, where present, intensity). Such files carry no stamps: the scan's is 0.

use crate::event::Scan;

/// No sensor gives more in one turn; a header that claims it is refused before anything is allocated.
pub const POINTS_MAX: usize = 4_000_000;

/// Bytes that are no scan.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ScanFileError {
    /// A `.bin` that is no list of points.
    #[error("{bytes} bytes: a KITTI scan has 16 a point, and up to {POINTS_MAX} points")]
    Length {
        /// Bytes in it.
        bytes: usize,
    },
    /// A `.pcd` that cannot be used.
    #[error("{what} = {value}: allowed: {allowed}")]
    Pcd {
        /// Which header entry.
        what: &'static str,
        /// What was found.
        value: String,
        /// What may stand there.
        allowed: &'static str,
    },
}

/// Reads a KITTI `.bin`.
///
/// # Errors
/// [`ScanFileError::Length`].
pub fn read_bin(bytes: &[u8]) -> Result<Scan, ScanFileError> {
    if bytes.is_empty() || !bytes.len().is_multiple_of(16) || bytes.len() / 16 > POINTS_MAX {
        return Err(ScanFileError::Length { bytes: bytes.len() });
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

/// Reads a `.pcd`.
///
/// # Errors
/// [`ScanFileError::Pcd`], which names the header's entry, its value and what is allowed.
pub fn read_pcd(bytes: &[u8]) -> Result<Scan, ScanFileError> {
    let wrong = |what, value: &str, allowed| ScanFileError::Pcd { what, value: value.into(), allowed };
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

    #[test]
    fn a_scan_of_half_a_point_is_refused_with_its_length() {
        assert_eq!(read_bin(&[0; 24]), Err(ScanFileError::Length { bytes: 24 }));
        assert_eq!(read_bin(&[]), Err(ScanFileError::Length { bytes: 0 }));
    }

    #[test]
    fn ascii_and_binary_pcd_say_the_same() {
        let header = |data| {
            format!(
                "VERSION 0.7\nFIELDS x y z label intensity\nSIZE 4 4 4 2 4\nTYPE F F F U F\nCOUNT 1 1 1 1 1\nPOINTS 1\nDATA {data}\n"
            )
        };
        let ascii = format!("{}1 2 3 9 0.5\n", header("ascii"));
        let mut bytes = header("binary").into_bytes();
        [1.0f32, 2.0, 3.0].iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        bytes.extend(9u16.to_le_bytes());
        bytes.extend(0.5f32.to_le_bytes());
        let scan = read_pcd(&bytes).unwrap();
        assert_eq!((&scan.x[..], &scan.z[..], &scan.intensity[..]), (&[1.0][..], &[3.0][..], &[0.5][..]));
        assert_eq!(read_pcd(ascii.as_bytes()), Ok(scan));
    }

    #[test]
    fn a_pcd_that_claims_more_points_than_it_has_is_refused() {
        let claim = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nPOINTS 3999999\nDATA binary\n";
        let error = read_pcd(claim.as_bytes()).unwrap_err().to_string();
        assert!(error.contains("POINTS = 3999999"), "{error}");
    }
}

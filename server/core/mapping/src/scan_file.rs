//! Scan files -> [`Scan`]: KITTI `.bin` (float32 x y z intensity) and `.pcd` (binary or ASCII, with the fields x y z
//! and possibly intensity). Such files contain no stamps: the stamp of the scan is 0.

use crate::event::Scan;

/// Greatest number of points of a scan file. Ours: no sensor returns more in one revolution. A header that states more
/// is refused before memory is allocated.
pub const POINTS_MAX: usize = 4_000_000;

/// A scan file that cannot be read.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ScanFileError {
    /// The length of a `.bin` file is 0, not a multiple of 16, or too large.
    #[error("{bytes} bytes: a KITTI scan has 16 a point, and up to {POINTS_MAX} points")]
    Length {
        /// Length of the file, bytes.
        bytes: usize,
    },
    /// An entry of the header of a `.pcd` file is not allowed.
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

/// Reads a KITTI `.bin` file.
///
/// # Errors
/// [`ScanFileError::Length`] if the file is not a list of 1 to [`POINTS_MAX`] points.
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

/// Reads a `.pcd` file.
///
/// # Errors
/// [`ScanFileError::Pcd`] if an entry of the header is missing or not allowed, or if the file contains fewer points
/// than its header states.
pub fn read_pcd(bytes: &[u8]) -> Result<Scan, ScanFileError> {
    let (header, rest) = Header::read(bytes)?;
    let points = header.points()?;
    let fields = header.coordinate_fields()?;
    let mut scan = Scan::default();
    let mut push = |value: &dyn Fn(Field) -> Option<f32>| {
        let [x, y, z, intensity] = fields.map(|field| field.map_or(Some(0.0), value));
        if let (Some(x), Some(y), Some(z), Some(intensity)) = (x, y, z, intensity) {
            scan.x.push(x);
            scan.y.push(y);
            scan.z.push(z);
            scan.intensity.push(intensity);
        }
    };
    match header.data.as_str() {
        "binary" => {
            let stride = header.bytes_before(header.fields.len());
            if stride == 0 || rest.len() / stride < points {
                return Err(pcd_error("POINTS", &header.points, "as many as the file has bytes for"));
            }
            for point in rest.chunks_exact(stride).take(points) {
                push(&|field| {
                    let bytes = point.get(field.offset..)?.first_chunk()?;
                    Some(f32::from_le_bytes(*bytes))
                });
            }
        }
        "ascii" => {
            for line in String::from_utf8_lossy(rest).lines().take(points) {
                let words: Vec<&str> = line.split_whitespace().collect();
                push(&|field| words.get(field.column)?.parse().ok());
            }
        }
        other => return Err(pcd_error("DATA", other, "binary, ascii")),
    }
    if scan.x.len() != points {
        return Err(pcd_error("POINTS", &header.points, "as many as there are lines of numbers"));
    }
    Ok(scan)
}

fn pcd_error(what: &'static str, value: &str, allowed: &'static str) -> ScanFileError {
    ScanFileError::Pcd { what, value: value.into(), allowed }
}

/// Position of one field in a point of a PCD file.
#[derive(Clone, Copy)]
struct Field {
    /// Index of the field among the numbers of an ASCII line.
    column: usize,
    /// First byte of the field in a binary point.
    offset: usize,
}

/// The entries of a PCD file's header.
#[derive(Default)]
struct Header {
    fields: Vec<String>,
    sizes: Vec<usize>,
    types: Vec<String>,
    counts: Vec<usize>,
    /// The entry as it is written; empty if it is missing.
    points: String,
    data: String,
}

impl Header {
    /// Reads the header; returns it with the bytes behind it. A word that is not a number is read as 0, which no field
    /// may have.
    fn read(bytes: &[u8]) -> Result<(Self, &[u8]), ScanFileError> {
        let (mut header, mut rest) = (Self::default(), bytes);
        loop {
            let Some(end) = rest.iter().position(|&byte| byte == b'\n') else {
                return Err(pcd_error("DATA", "(missing)", "a header that ends with DATA binary or DATA ascii"));
            };
            let line = String::from_utf8_lossy(&rest[..end]).into_owned();
            rest = &rest[end + 1..];
            let mut words = line.split_whitespace().map(str::to_owned);
            let entry = words.next();
            let numbers = || line.split_whitespace().skip(1).map(|word| word.parse().unwrap_or(0)).collect();
            match entry.as_deref() {
                Some("FIELDS") => header.fields = words.collect(),
                Some("SIZE") => header.sizes = numbers(),
                Some("TYPE") => header.types = words.collect(),
                Some("COUNT") => header.counts = numbers(),
                Some("POINTS") => header.points = words.next().unwrap_or_default(),
                Some("DATA") => {
                    header.data = words.next().unwrap_or_default();
                    break;
                }
                _ => {}
            }
        }
        if header.counts.is_empty() {
            header.counts = vec![1; header.fields.len()];
        }
        if [header.sizes.len(), header.types.len(), header.counts.len()] != [header.fields.len(); 3] {
            return Err(pcd_error("FIELDS", &header.fields.join(" "), "one SIZE, TYPE and COUNT each"));
        }
        Ok((header, rest))
    }

    /// Number of points.
    fn points(&self) -> Result<usize, ScanFileError> {
        let points = self.points.parse().ok().filter(|&points| points <= POINTS_MAX);
        points.ok_or_else(|| pcd_error("POINTS", &self.points, "0 to 4000000"))
    }

    /// Number of bytes of a binary point before field `index`.
    fn bytes_before(&self, index: usize) -> usize {
        let lengths = self.counts.iter().zip(&self.sizes).map(|(count, size)| count.saturating_mul(*size));
        lengths.take(index).fold(0, usize::saturating_add)
    }

    /// Positions of x, y, z and intensity; `None` for an intensity that is missing.
    fn coordinate_fields(&self) -> Result<[Option<Field>; 4], ScanFileError> {
        let find = |name: &str| {
            let index = self.fields.iter().position(|field| field == name)?;
            let float = self.sizes[index] == 4 && self.types[index] == "F" && self.counts[index] == 1;
            let column = self.counts[..index].iter().copied().fold(0, usize::saturating_add);
            float.then_some(Field { column, offset: self.bytes_before(index) })
        };
        let required = || pcd_error("FIELDS", &self.fields.join(" "), "x y z as 4-byte floats");
        let position = |name| find(name).ok_or_else(required);
        Ok([Some(position("x")?), Some(position("y")?), Some(position("z")?), find("intensity")])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scan_file_with_half_a_point_is_refused_with_its_length() {
        assert_eq!(read_bin(&[0; 24]), Err(ScanFileError::Length { bytes: 24 }));
        assert_eq!(read_bin(&[]), Err(ScanFileError::Length { bytes: 0 }));
    }

    #[test]
    fn ascii_and_binary_pcd_files_give_the_same_scan() {
        let header = |data| {
            let fields = "FIELDS x y z label intensity\nSIZE 4 4 4 2 4\nTYPE F F F U F\nCOUNT 1 1 1 1 1\n";
            format!("VERSION 0.7\n{fields}POINTS 1\nDATA {data}\n")
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
    fn a_pcd_file_that_states_more_points_than_it_contains_is_refused() {
        let header = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nPOINTS 3999999\nDATA binary\n";
        let error = read_pcd(header.as_bytes()).unwrap_err().to_string();
        assert!(error.contains("POINTS = 3999999"), "{error}");
        let error = read_pcd(header.replace("3999999", "4000001").as_bytes()).unwrap_err().to_string();
        assert_eq!(error, "POINTS = 4000001: allowed: 0 to 4000000");
        let huge = header.replace("COUNT 1 1 1", &format!("COUNT {0} {0} 1", u64::MAX));
        assert!(read_pcd(huge.as_bytes()).unwrap_err().to_string().contains("FIELDS = x y z"));
    }
}

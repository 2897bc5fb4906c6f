//! Point Cloud Data files, `.pcd` (v0.7): `ascii`, `binary` and `binary_compressed`, with fields of any type.

use super::error::ScanFileError;
use super::format::{POINTS_MAX, complete_rings};
use super::lzf;
use crate::sensor::observation::Scan;

/// Names of the fields that state a point's laser, the best first.
const RING_FIELDS: [&str; 4] = ["ring", "channel", "laser", "laser_id"];

/// Reads a `.pcd` file with the fields x y z, and possibly intensity and ring (or channel, laser, `laser_id`).
///
/// # Errors
/// [`ScanFileError::Pcd`] if an entry of the header is missing or not allowed, if the file contains fewer points than
/// its header states, or if a value is no number.
pub fn read_pcd(bytes: &[u8]) -> Result<Scan, ScanFileError> {
    let (header, rest) = PcdHeader::read(bytes)?;
    let points = header.points()?;
    let fields = header.used_fields()?;
    let mut scan = match header.data.as_str() {
        "binary" => {
            let stride = header.bytes_before(header.fields.len());
            if rest.len() / stride < points {
                return Err(pcd_error("POINTS", &header.points, "as many as the file has bytes for"));
            }
            let point = |bytes: &[u8]| row(fields, |field| Some(field.kind.decode(bytes.get(field.offset..)?)));
            scan_of(rest.chunks_exact(stride).take(points).map_while(point), fields)
        }
        "binary_compressed" => {
            let plain = header.unpack(rest, points)?;
            // The values of one field follow each other, point by point.
            let at = |field: Field, point: usize| field.offset * points + point * field.kind.size();
            let point = |index| row(fields, |field| Some(field.kind.decode(plain.get(at(field, index)..)?)));
            scan_of((0..points).map_while(point), fields)
        }
        "ascii" => {
            let text = String::from_utf8_lossy(rest);
            let point = |line: &str| {
                let words: Vec<&str> = line.split_whitespace().collect();
                row(fields, |field| words.get(field.column)?.parse().ok())
            };
            // As in PCL, empty lines are none.
            let lines = text.lines().filter(|line| !line.trim().is_empty());
            scan_of(lines.take(points).map_while(point), fields)
        }
        other => return Err(pcd_error("DATA", other, "ascii, binary, binary_compressed")),
    }?;
    if scan.x.len() != points {
        return Err(pcd_error("POINTS", &header.points, "as many as there are lines of numbers"));
    }
    complete_rings(&mut scan);
    Ok(scan)
}

fn pcd_error(what: &'static str, value: &str, allowed: &'static str) -> ScanFileError {
    ScanFileError::Pcd { what, value: value.into(), allowed }
}

/// Values of the used fields of one point; 0 for a field that the file does not have. `None` if `value` returns `None`.
fn row(fields: [Option<Field>; 5], value: impl Fn(Field) -> Option<f64>) -> Option<[f64; 5]> {
    let mut row = [0.0; 5];
    for (slot, field) in row.iter_mut().zip(fields) {
        if let Some(field) = field {
            *slot = value(field)?;
        }
    }
    Some(row)
}

/// The scan of these points: x, y, z, intensity and ring. A point with a wrong ring counts as lost: its x is NaN.
///
/// # Errors
/// [`ScanFileError::Pcd`] if more than a tenth of the points have a wrong ring.
fn scan_of(points: impl Iterator<Item = [f64; 5]>, fields: [Option<Field>; 5]) -> Result<Scan, ScanFileError> {
    let (mut scan, mut first_wrong, mut wrong) = (Scan::default(), None, 0);
    for [mut x, y, z, intensity, mut ring] in points {
        if fields[4].is_some() && (!(0.0..=f64::from(u16::MAX)).contains(&ring) || ring.fract() != 0.0) {
            (first_wrong, wrong) = (first_wrong.or(Some(ring)), wrong + 1);
            (x, ring) = (f64::NAN, 0.0);
        }
        scan.x.push(x as f32);
        scan.y.push(y as f32);
        scan.z.push(z as f32);
        scan.intensity.push(intensity as f32);
        if fields[4].is_some() {
            scan.ring.push(ring as u16);
        }
    }
    match first_wrong {
        Some(ring) if 10 * wrong > scan.x.len() => {
            Err(pcd_error("ring", &ring.to_string(), "a whole number of 0 to 65535"))
        }
        _ => Ok(scan),
    }
}

/// The type of a field's values.
#[derive(Clone, Copy)]
enum FieldKind {
    F32,
    F64,
    /// Signed whole number of this many bytes.
    Signed(usize),
    /// Unsigned whole number of this many bytes.
    Unsigned(usize),
}

impl FieldKind {
    fn new(kind: &str, size: usize) -> Option<Self> {
        match (kind, size) {
            ("F", 4) => Some(Self::F32),
            ("F", 8) => Some(Self::F64),
            ("I", 1 | 2 | 4 | 8) => Some(Self::Signed(size)),
            ("U", 1 | 2 | 4 | 8) => Some(Self::Unsigned(size)),
            _ => None,
        }
    }

    fn size(self) -> usize {
        match self {
            Self::F32 => 4,
            Self::F64 => 8,
            Self::Signed(size) | Self::Unsigned(size) => size,
        }
    }

    /// The first value of `bytes`, little-endian; NaN if there are too few bytes.
    fn decode(self, bytes: &[u8]) -> f64 {
        let Some(own) = bytes.get(..self.size()) else { return f64::NAN };
        let mut eight = [0; 8];
        eight[..own.len()].copy_from_slice(own);
        let bits = u64::from_le_bytes(eight);
        let unused = 64 - 8 * own.len();
        match self {
            Self::F32 => f64::from(f32::from_bits(bits as u32)),
            Self::F64 => f64::from_bits(bits),
            Self::Signed(_) => (((bits << unused) as i64) >> unused) as f64,
            Self::Unsigned(_) => bits as f64,
        }
    }
}

/// Type and position of one field in a point of a PCD file.
#[derive(Clone, Copy)]
struct Field {
    kind: FieldKind,
    /// Index of the field among the numbers of an ASCII line.
    column: usize,
    /// First byte of the field in a binary point.
    offset: usize,
}

/// The entries of a PCD file's header.
#[derive(Default)]
struct PcdHeader {
    fields: Vec<String>,
    sizes: Vec<usize>,
    types: Vec<String>,
    counts: Vec<usize>,
    /// The entry as it is written; empty if it is missing.
    points: String,
    data: String,
}

impl PcdHeader {
    /// Reads the header; returns it with the bytes behind it. A word that is not a number is read as 0, which no field
    /// may have.
    fn read(bytes: &[u8]) -> Result<(Self, &[u8]), ScanFileError> {
        let (mut header, mut rest) = (Self::default(), bytes);
        loop {
            let Some(end) = rest.iter().position(|&byte| byte == b'\n') else {
                return Err(pcd_error("DATA", "(missing)", "a header that ends with DATA and the kind of the data"));
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

    /// Positions of x, y, z, intensity and ring; `None` for an intensity or ring that is missing or no number.
    fn used_fields(&self) -> Result<[Option<Field>; 5], ScanFileError> {
        let find = |name: &str| {
            let index = self.fields.iter().position(|field| field == name)?;
            let kind = FieldKind::new(&self.types[index], self.sizes[index]).filter(|_| self.counts[index] == 1)?;
            let column = self.counts[..index].iter().copied().fold(0, usize::saturating_add);
            Some(Field { kind, column, offset: self.bytes_before(index) })
        };
        let allowed = "x y z, one number each: F of SIZE 4 or 8, I or U of SIZE 1, 2, 4 or 8";
        let position = |name| find(name).ok_or_else(|| pcd_error("FIELDS", &self.describe(), allowed));
        let ring = RING_FIELDS.iter().find_map(|name| find(name));
        Ok([Some(position("x")?), Some(position("y")?), Some(position("z")?), find("intensity"), ring])
    }

    /// The fields with their types and sizes, for an error.
    fn describe(&self) -> String {
        let fields = self.fields.iter().zip(&self.types).zip(&self.sizes);
        fields.map(|((name, kind), size)| format!("{name} {kind}{size}")).collect::<Vec<_>>().join(", ")
    }

    /// Unpacks the points of `DATA binary_compressed`: two lengths of 4 bytes, packed and plain, and LZF.
    fn unpack(&self, rest: &[u8], points: usize) -> Result<Vec<u8>, ScanFileError> {
        let expected = self.bytes_before(self.fields.len()).checked_mul(points);
        let Some((lengths, rest)) = rest.split_first_chunk::<8>() else {
            return Err(pcd_error("DATA", "binary_compressed", "two lengths and as many packed bytes"));
        };
        let [packed, plain] = [0, 4].map(|at| u32::from_le_bytes([0, 1, 2, 3].map(|i| lengths[at + i])) as usize);
        if Some(plain) != expected {
            return Err(pcd_error("unpacked length", &plain.to_string(), "POINTS times the length of a point"));
        }
        let Some(packed_bytes) = rest.get(..packed) else {
            return Err(pcd_error("packed length", &packed.to_string(), "as many bytes as the file has"));
        };
        lzf::unpack(packed_bytes, plain)
            .ok_or_else(|| pcd_error("DATA", "binary_compressed", "LZF of the stated length"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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

    /// Three points with doubles, whole numbers and a ring: field by field for a compressed file, else point by point.
    fn mixed(data: &str) -> Vec<u8> {
        let fields = "FIELDS ring x y z _\nSIZE 1 8 2 4 1\nTYPE U F I F U\nCOUNT 1 1 1 1 3\n";
        let mut file = format!("{fields}POINTS 3\nDATA {data}\n").into_bytes();
        let columns: [Vec<Vec<u8>>; 5] = [
            [7u8, 3, 7].iter().map(|v| v.to_le_bytes().to_vec()).collect(),
            [1.5f64, -2.25, f64::NAN].iter().map(|v| v.to_le_bytes().to_vec()).collect(),
            [-5i16, 0, 300].iter().map(|v| v.to_le_bytes().to_vec()).collect(),
            [0.5f32, -1.75, -2.0].iter().map(|v| v.to_le_bytes().to_vec()).collect(),
            vec![vec![9; 3]; 3],
        ];
        match data {
            "binary" => (0..3).for_each(|point| columns.iter().for_each(|column| file.extend(&column[point]))),
            "binary_compressed" => {
                let plain: Vec<u8> = columns.concat().concat();
                // Runs of plain bytes alone are LZF too.
                let packed: Vec<u8> = plain.chunks(32).flat_map(|run| [&[run.len() as u8 - 1], run].concat()).collect();
                file.extend((packed.len() as u32).to_le_bytes());
                file.extend((plain.len() as u32).to_le_bytes());
                file.extend(packed);
            }
            _ => file.extend(b"7 1.5 -5 0.5 9 9 9\n3 -2.25 0 -1.75 9 9 9\n7 nan 300 -2 9 9 9\n"),
        }
        file
    }

    #[test]
    fn doubles_whole_numbers_and_lost_points_are_read_in_every_encoding() {
        for data in ["ascii", "binary", "binary_compressed"] {
            let scan = read_pcd(&mixed(data)).unwrap();
            assert!(scan.x[..2] == [1.5, -2.25] && scan.x[2].is_nan(), "{data}: {:?}", scan.x);
            assert_eq!((&scan.y[..], &scan.z[..]), (&[-5.0, 0.0, 300.0][..], &[0.5, -1.75, -2.0][..]), "{data}");
            // The ring of the lower point is 0.
            assert_eq!((&scan.ring[..], &scan.intensity[..]), (&[1, 0, 1][..], &[0.0; 3][..]), "{data}");
        }
    }

    #[test]
    fn a_compressed_file_of_another_length_is_refused() {
        let file = mixed("binary_compressed");
        let at = file.windows(18).position(|line| line == b"binary_compressed\n").unwrap() + 18;
        for cut in [at + 3, at + 8, file.len() - 1] {
            assert!(matches!(read_pcd(&file[..cut]), Err(ScanFileError::Pcd { .. })), "cut at {cut}");
        }
        let altered = |byte: usize, value: u8| {
            let mut file = file.clone();
            file[byte] = value;
            read_pcd(&file).unwrap_err().to_string()
        };
        assert_eq!(altered(at + 7, 255), "unpacked length = 4278190134: allowed: POINTS times the length of a point");
        assert_eq!(altered(at + 8, 255), "DATA = binary_compressed: allowed: LZF of the stated length");
    }

    #[test]
    fn a_field_that_is_no_number_is_refused_with_its_type() {
        let header = "FIELDS x y z\nSIZE 4 4 3\nTYPE F F F\nCOUNT 1 1 1\nPOINTS 0\nDATA ascii\n";
        let error = read_pcd(header.as_bytes()).unwrap_err().to_string();
        assert!(error.contains("FIELDS = x F4, y F4, z F3") && error.contains("F of SIZE 4 or 8"), "{error}");
        let error = read_pcd(header.replace("SIZE 4 4 3", "SIZE 4 4 4").replace("ascii", "zip").as_bytes());
        assert_eq!(error.unwrap_err().to_string(), "DATA = zip: allowed: ascii, binary, binary_compressed");
        let ringed = "FIELDS x y z ring\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nPOINTS 1\nDATA ascii\n1 2 3 0.5\n";
        let error = read_pcd(ringed.as_bytes()).unwrap_err().to_string();
        assert_eq!(error, "ring = 0.5: allowed: a whole number of 0 to 65535");
    }

    #[test]
    fn a_pcd_file_that_states_more_points_than_it_contains_is_refused() {
        let header = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nPOINTS 3999999\nDATA binary\n";
        let error = read_pcd(header.as_bytes()).unwrap_err().to_string();
        assert!(error.contains("POINTS = 3999999"), "{error}");
        for data in ["ascii", "binary_compressed"] {
            assert!(read_pcd(header.replace("binary", data).as_bytes()).is_err(), "{data}");
        }
        let error = read_pcd(header.replace("3999999", "4000001").as_bytes()).unwrap_err().to_string();
        assert_eq!(error, "POINTS = 4000001: allowed: 0 to 4000000");
        let huge = header.replace("COUNT 1 1 1", &format!("COUNT {0} {0} 1", u64::MAX));
        assert!(read_pcd(huge.as_bytes()).unwrap_err().to_string().contains("FIELDS = x F4"));
    }
}

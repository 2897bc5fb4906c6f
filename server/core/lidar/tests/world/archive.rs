//! Readers of zip and npy, as far as the references need them.

use std::collections::BTreeMap;
use std::io::Read;

/// All files of a zip archive, by name.
pub fn unzip(path: &str) -> BTreeMap<String, Vec<u8>> {
    let bytes = std::fs::read(super::data(path)).unwrap();
    let u16_at = |at: usize| usize::from(u16::from_le_bytes([bytes[at], bytes[at + 1]]));
    let u32_at = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
    let end = bytes.windows(4).rposition(|w| w == b"PK\x05\x06").unwrap();
    let mut entry = u32_at(end + 16);
    let mut files = BTreeMap::new();
    for _ in 0..u16_at(end + 10) {
        let (method, packed, name) = (u16_at(entry + 10), u32_at(entry + 20), u16_at(entry + 28));
        let header = u32_at(entry + 42);
        let start = header + 30 + u16_at(header + 26) + u16_at(header + 28);
        let packed = &bytes[start..start + packed];
        let mut file = Vec::new();
        match method {
            0 => file.extend_from_slice(packed),
            8 => drop(flate2::read::DeflateDecoder::new(packed).read_to_end(&mut file).unwrap()),
            other => panic!("zip method {other}"),
        }
        files.insert(String::from_utf8(bytes[entry + 46..entry + 46 + name].to_vec()).unwrap(), file);
        entry += 46 + name + u16_at(entry + 30) + u16_at(entry + 32);
    }
    files
}

/// One point of velodyne-decoder.
#[derive(Clone, Copy, Debug)]
pub struct Reference {
    pub xyz: [f32; 3],
    pub intensity: f32,
    pub ring: u16,
    pub return_type: u8,
}

/// The points of all scans of a reference, in the order of the scans.
pub fn reference(path: &str) -> Vec<Reference> {
    // The order of the map is scan0, scan1, …, because there are fewer than ten scans.
    unzip(path).values().flat_map(|npy| rows(npy)).collect()
}

fn rows(npy: &[u8]) -> Vec<Reference> {
    let header = 10 + usize::from(u16::from_le_bytes([npy[8], npy[9]]));
    let text = String::from_utf8_lossy(&npy[10..header]);
    assert!(text.contains("'<f4'") && text.contains("False") && text.contains(", 8)"), "{text}");
    let values: Vec<f32> = npy[header..].chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
    let row = |row: &[f32]| Reference {
        xyz: [row[0], row[1], row[2]],
        intensity: row[3],
        ring: row[6] as u16,
        return_type: row[7] as u8,
    };
    values.chunks_exact(8).map(row).collect()
}

/// Rows of a CSV file of VeloView (x to the right, y ahead, z up, intensity), converted to the sensor's frame.
pub fn veloview(csv: &str) -> Vec<([f32; 3], u8)> {
    let row = |line: &str| {
        let values: Vec<f32> = line.split(',').map(|value| value.trim().parse().unwrap()).collect();
        ([values[1], -values[0], values[2]], values[3] as u8)
    };
    csv.lines().skip(1).filter(|line| !line.is_empty()).map(row).collect()
}

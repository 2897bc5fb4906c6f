//! The cells of a channel -> a NumPy file (format 1.0): an array (rows, columns) in C order, little-endian.

use clearway_client::codec::Cells;

/// Encodes the cells as a NumPy file. The header is padded to a multiple of 64 bytes, as the format requires.
pub fn encode(cells: &Cells, (rows, columns): (u32, u32)) -> Vec<u8> {
    let dtype = match cells {
        Cells::U8(_) => "|u1",
        Cells::I8(_) => "|i1",
        Cells::U16(_) => "<u2",
    };
    let mut header = format!("{{'descr': '{dtype}', 'fortran_order': False, 'shape': ({rows}, {columns}), }}");
    let padding = (64 - (10 + header.len() + 1) % 64) % 64;
    header.push_str(&" ".repeat(padding));
    header.push('\n');
    let mut file = b"\x93NUMPY\x01\x00".to_vec();
    file.extend_from_slice(&(header.len() as u16).to_le_bytes());
    file.extend_from_slice(header.as_bytes());
    file.extend_from_slice(&cells.as_ref().to_le_bytes());
    file
}

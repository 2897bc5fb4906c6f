//! Reads sweeps of Argoverse 2: Arrow files (Feather v2) with the columns x y z (f16) intensity laser_number (u8)
//! offset_ns (i32), in LZ4 frames. It reads as much of Arrow, its flatbuffers and LZ4 as these files use.

use clearway_mapping::event::Scan;

/// A sweep as two scans, of lasers 0 to 31 and 32 to 63, in the ego frame of Argoverse, whose origin is the rear axle.
pub fn scans(file: &[u8], start_ns: i64) -> [Scan; 2] {
    let mut scans = [Scan::default(), Scan::default()];
    // The schema comes first; every message is a marker, a length, metadata and a body.
    let mut at = 8 + 8 + u32_at(file, 12);
    while u32_at(file, at) == 0xffff_ffff && u32_at(file, at + 4) > 0 {
        let body = at + 8 + u32_at(file, at + 4);
        let message = at + 8 + u32_at(file, at + 8);
        let bodies = i64_at(file, field(file, message, 3));
        let batch = follow(file, field(file, message, 2));
        let buffers = follow(file, field(file, batch, 2));
        let columns: Vec<Vec<u8>> = (0..u32_at(file, buffers))
            .map(|k| (i64_at(file, buffers + 4 + 16 * k), i64_at(file, buffers + 12 + 16 * k)))
            .filter(|(_, length)| *length > 0)
            .map(|(offset, length)| column(&file[body + offset..body + offset + length]))
            .collect();
        let [x, y, z, intensity, laser, offset_ns] = &columns[..] else { panic!("{} columns", columns.len()) };
        for (point, laser) in laser.iter().enumerate() {
            let scan = &mut scans[usize::from(laser / 32)];
            scan.x.push(f16(x, point));
            scan.y.push(f16(y, point));
            scan.z.push(f16(z, point));
            scan.intensity.push(f32::from(intensity[point]) / 255.0);
            scan.ring.push(u16::from(laser % 32));
            scan.offset_ns.push(u32_at(offset_ns, 4 * point) as i32);
        }
        at = body + bodies;
    }
    for scan in &mut scans {
        let last = *scan.offset_ns.iter().max().unwrap();
        scan.stamp_ns = start_ns + i64::from(last);
        scan.offset_ns.iter_mut().for_each(|offset| *offset -= last);
    }
    scans
}

fn u32_at(bytes: &[u8], at: usize) -> usize {
    u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize
}

fn i64_at(bytes: &[u8], at: usize) -> usize {
    usize::try_from(i64::from_le_bytes(bytes[at..at + 8].try_into().unwrap())).unwrap()
}

fn follow(bytes: &[u8], at: usize) -> usize {
    at + u32_at(bytes, at)
}

/// Position of a field of a flatbuffer table.
fn field(bytes: &[u8], table: usize, number: usize) -> usize {
    let shape = table - u32_at(bytes, table);
    let slot = shape + 4 + 2 * number;
    table + usize::from(u16::from_le_bytes([bytes[slot], bytes[slot + 1]]))
}

fn f16(bytes: &[u8], index: usize) -> f32 {
    let bits = u32::from(u16::from_le_bytes([bytes[2 * index], bytes[2 * index + 1]]));
    let (sign, exponent, fraction) = (bits >> 15, bits >> 10 & 31, (bits & 1023) as f32);
    let size = match exponent {
        0 => fraction / 1024.0 * 2f32.powi(-14),
        31 => f32::NAN,
        _ => (1.0 + fraction / 1024.0) * 2f32.powi(exponent as i32 - 15),
    };
    if sign == 1 { -size } else { size }
}

/// Unpacks a column: its length, then an LZ4 frame without checksums of its blocks.
fn column(bytes: &[u8]) -> Vec<u8> {
    let (length, frame) = (i64_at(bytes, 0), &bytes[8..]);
    assert_eq!(u32_at(frame, 0), 0x184D_2204, "LZ4");
    assert_eq!(frame[4] & 0x18, 0, "neither block checksums nor a content size");
    let (mut out, mut at) = (Vec::with_capacity(length), 7);
    while u32_at(frame, at) > 0 {
        let (stored, size) = (u32_at(frame, at) >> 31 == 1, u32_at(frame, at) & 0x7fff_ffff);
        let block = &frame[at + 4..at + 4 + size];
        if stored {
            out.extend_from_slice(block)
        } else {
            unpack(block, &mut out)
        }
        at += 4 + size;
    }
    assert_eq!(out.len(), length);
    out
}

fn unpack(block: &[u8], out: &mut Vec<u8>) {
    let mut bytes = block.iter().map(|byte| usize::from(*byte));
    while let Some(token) = bytes.next() {
        let length = |short: usize, bytes: &mut dyn Iterator<Item = usize>| {
            let mut more = if short == 15 { 255 } else { 0 };
            let mut length = short;
            while more == 255 {
                more = bytes.next().unwrap();
                length += more;
            }
            length
        };
        let literals = length(token >> 4, &mut bytes);
        out.extend(bytes.by_ref().take(literals).map(|byte| byte as u8));
        let Some(low) = bytes.next() else { break };
        let start = out.len() - (low | bytes.next().unwrap() << 8);
        let matched = length(token & 15, &mut bytes) + 4;
        (start..start + matched).for_each(|place| out.push(out[place]));
    }
}

//! The calibration table that an HDL-64E S2 or S3 sends in its status bytes, one byte per packet.
//!
//! In: the status type and value at the end of every packet. Out: the [`Calibration`], after 4,160 packets (about 1.2
//! s) without a loss. Source: HDL-64E S3 manual 63-HDL64ES3 rev K, appendix E. A cycle is 16 packets: the types H M S D
//! N Y G T V with clock, GPS, temperature and firmware, then seven bytes of the table. The table is 260 cycles, 1,820
//! bytes: `UNIT#` and two thresholds; 28 bytes per laser, 21 of them used; 21 bytes about the unit. It ends with a
//! CRC-16 over the lasers (S3, which also marks every fourth cycle with W) or with its own length (S2).

use super::table::{Calibration, LaserCalibration};
use crate::model::Model;

/// Number of packets of one complete table.
pub const PACKETS_PER_TABLE: usize = CYCLES * CYCLE;
const CYCLE: usize = 16;
const CYCLES: usize = 260;
const BYTES_PER_CYCLE: usize = 7;
const TABLE: usize = CYCLES * BYTES_PER_CYCLE;
const LASERS: usize = 64;
const BYTES_PER_LASER: usize = 28;
const HEADER: &[u8; 5] = b"UNIT#";
const CLOCK_TYPES: &[u8; 9] = b"HMSDNYGTV";
const WARNING_TYPE: u8 = b'W';
/// Angle of one count, in degrees.
const DEG_PER_COUNT: f64 = 0.01;
/// Length of one count, in metres.
const M_PER_COUNT: f64 = 0.001;
/// Focal slope of one count.
const SLOPE_PER_COUNT: f64 = 0.1;

/// Collector of status bytes until they are a complete table.
#[derive(Clone, Debug, Default)]
pub struct StatusTable {
    /// Position of the next status in its cycle; `None` before the first start of a cycle.
    position: Option<usize>,
    /// Bytes of the table so far, from `UNIT#` on.
    bytes: Vec<u8>,
    /// True if one of the cycles so far was marked with W.
    warned: bool,
}

impl StatusTable {
    /// Adds the status of the next packet and returns the model and its table when that status completes the table.
    /// A lost packet or a wrong checksum discards the table.
    pub fn push(&mut self, (status_type, value): (u8, u8)) -> Option<(Model, Calibration)> {
        let position = match self.position {
            Some(position) if fits(position, status_type) => position,
            _ => {
                self.bytes.clear();
                self.position = (status_type == CLOCK_TYPES[0]).then_some(1);
                return None;
            }
        };
        self.position = Some((position + 1) % CYCLE);
        if position < CLOCK_TYPES.len() {
            return None;
        }
        self.warned |= status_type == WARNING_TYPE;
        if self.bytes.is_empty() && position != CLOCK_TYPES.len() {
            return None;
        }
        self.bytes.push(value);
        self.discard_without_header();
        if self.bytes.len() < TABLE {
            return None;
        }
        let read = read(&self.bytes, self.warned);
        self.bytes.clear();
        self.warned = false;
        read
    }

    /// True if the sensor has marked a cycle with W, which an S3 does and an S2 does not.
    pub fn is_s3(&self) -> bool {
        self.warned
    }

    /// Discards the bytes unless they begin with `UNIT#`.
    fn discard_without_header(&mut self) {
        let seen = self.bytes.len().min(HEADER.len());
        if self.bytes[..seen] != HEADER[..seen] {
            self.bytes.clear();
        }
    }
}

/// True if a status type may be at that position of a cycle: the first nine types are fixed, the other seven are
/// digits, W, or above F0.
fn fits(position: usize, status_type: u8) -> bool {
    match CLOCK_TYPES.get(position) {
        Some(expected) => status_type == *expected,
        None => !CLOCK_TYPES.contains(&status_type),
    }
}

fn read(table: &[u8], warned: bool) -> Option<(Model, Calibration)> {
    let sum = u16::from_le_bytes([table[TABLE - 2], table[TABLE - 1]]);
    let model = match sum {
        _ if warned && sum == crc(table) => Model::Hdl64eS3,
        _ if !warned && usize::from(sum) == TABLE => Model::Hdl64eS2,
        _ => return None,
    };
    let lasers = lasers_of(table).map(laser).collect::<Vec<_>>();
    let calibration = Calibration::from_lasers(Some(model.spec().distance_m_per_count), lasers).ok()?;
    calibration.fits(model).ok()?;
    Some((model, calibration))
}

fn lasers_of(table: &[u8]) -> impl Iterator<Item = &[u8]> {
    table[BYTES_PER_CYCLE..][..LASERS * BYTES_PER_LASER].chunks_exact(BYTES_PER_LASER)
}

fn laser(record: &[u8]) -> LaserCalibration {
    let count = |at: usize| f64::from(i16::from_le_bytes([record[at], record[at + 1]]));
    LaserCalibration {
        laser_id: record[0].into(),
        vert_correction: (count(1) * DEG_PER_COUNT).to_radians(),
        rot_correction: (count(3) * DEG_PER_COUNT).to_radians(),
        dist_correction: count(5) * M_PER_COUNT,
        vert_offset_correction: count(11) * M_PER_COUNT,
        horiz_offset_correction: count(13) * M_PER_COUNT,
        two_pt_correction_available: true,
        dist_correction_x: Some(count(7) * M_PER_COUNT),
        dist_correction_y: Some(count(9) * M_PER_COUNT),
        focal_distance: Some(count(15) * M_PER_COUNT),
        focal_slope: Some(count(17) * SLOPE_PER_COUNT),
        min_intensity: Some(record[19]),
        max_intensity: Some(record[20]),
    }
}

/// CRC-16 with polynomial 8005 over bytes 2 to 21 of the record of every laser.
fn crc(table: &[u8]) -> u16 {
    let bytes = lasers_of(table).flat_map(|record| &record[1..21]);
    bytes.fold(0, |crc, byte| {
        (0..8).rev().fold(crc, |crc: u16, bit| {
            let carry = (crc >> 15) ^ u16::from(byte >> bit & 1);
            (crc << 1) ^ (carry * 0x8005)
        })
    })
}

/// Status type and value of [`PACKETS_PER_TABLE`] packets with the bytes of `calibration`, rounded to hundredths of a
/// degree and millimetres. An encoder sends them again and again. For `Hdl64eS3` the status bytes have the form of an
/// S3 (W and CRC), for every other model the form of an S2. A missing near-range correction is sent as
/// `dist_correction`.
///
/// # Panics
/// If the table does not have 64 lasers.
pub fn status_bytes(model: Model, calibration: &Calibration) -> Vec<(u8, u8)> {
    let s3 = model == Model::Hdl64eS3;
    let table = write(calibration, s3);
    let digits = table.iter().enumerate().map(|(at, value)| (b'1' + (at % BYTES_PER_CYCLE) as u8, *value));
    let mut sent = Vec::with_capacity(PACKETS_PER_TABLE);
    for (cycle, seven) in digits.collect::<Vec<_>>().chunks(BYTES_PER_CYCLE).enumerate() {
        // The clock is invented: noon on 1 January 2020, no GPS, 25 degrees Celsius, version 4.07.
        sent.extend(CLOCK_TYPES.iter().copied().zip([12, 0, 0, 1, 1, 20, 0, 25, 0x47]));
        sent.extend_from_slice(seven);
        if s3 && cycle % 4 == 0 && cycle > 0 {
            sent[cycle * CYCLE + CLOCK_TYPES.len()].0 = WARNING_TYPE;
        }
    }
    sent
}

fn write(calibration: &Calibration, s3: bool) -> Vec<u8> {
    assert_eq!(calibration.lasers.len(), LASERS, "only an HDL-64E sends its table");
    let mut table = Vec::with_capacity(TABLE);
    table.extend_from_slice(HEADER);
    table.extend_from_slice(&[24, 24]);
    for laser in &calibration.lasers {
        let start = table.len();
        let angle = |rad: f64| (rad.to_degrees() / DEG_PER_COUNT).round() as i16;
        let length = |m: f64| (m / M_PER_COUNT).round() as i16;
        table.push(laser.laser_id as u8);
        let counts = [
            angle(laser.vert_correction),
            angle(laser.rot_correction),
            length(laser.dist_correction),
            length(laser.dist_correction_x.unwrap_or(laser.dist_correction)),
            length(laser.dist_correction_y.unwrap_or(laser.dist_correction)),
            length(laser.vert_offset_correction),
            length(laser.horiz_offset_correction),
            length(laser.focal_distance.unwrap_or(0.0)),
            (laser.focal_slope.unwrap_or(0.0) / SLOPE_PER_COUNT).round() as i16,
        ];
        table.extend(counts.iter().flat_map(|count| count.to_le_bytes()));
        table.extend([laser.min_intensity.unwrap_or(0), laser.max_intensity.unwrap_or(255)]);
        table.resize(start + BYTES_PER_LASER, 0);
    }
    table.resize(TABLE, 0);
    let sum = if s3 { crc(&table) } else { TABLE as u16 };
    table[TABLE - 2..].copy_from_slice(&sum.to_le_bytes());
    table
}

//! RDDF, the route definition data file of DARPA's Grand Challenges.
//!
//! In: text with one row a line: `number, latitude, longitude, lateral offset, speed limit[, hour, minute, second]`, in
//! degrees, feet and miles an hour. Out: [`Rddf`], and from it the centre line as a [`Road`] in the map frame. A row
//! that cannot be read is left out and reported; the other rows are used. `#` begins a comment.

use crate::road::line::{FOOT_M, LineError, latitude, longitude, number};
use crate::road::local_frame::LocalFrame;
use crate::road::{Road, RoadFrame, RoadPurpose};

/// One mile an hour in metres a second.
const MPH_MPS: f64 = 0.447_04;

/// A route file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Rddf {
    /// The rows, in the order of the file.
    pub rows: Vec<Row>,
    /// The rows that are left out.
    pub refused: Vec<LineError>,
}

/// One waypoint of a route.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Row {
    /// Number of the row in the file.
    pub number: u32,
    /// Latitude, degrees.
    pub latitude_deg: f64,
    /// Longitude, degrees.
    pub longitude_deg: f64,
    /// Distance from the centre line to the edge of the corridor, metres.
    pub lateral_offset_m: f64,
    /// Speed limit, m/s; 0 if the file sets none.
    pub speed_mps: f64,
}

impl Rddf {
    /// Reads a whole file.
    pub fn read(text: &str) -> Self {
        let mut rddf = Self::default();
        for (index, line) in text.lines().enumerate() {
            let row = line.split('#').next().unwrap_or("").trim();
            if row.is_empty() {
                continue;
            }
            match read_row(index + 1, row, rddf.rows.last()) {
                Ok(row) => rddf.rows.push(row),
                Err(refused) => rddf.refused.push(refused),
            }
        }
        rddf
    }

    /// A local frame whose origin is the first row; `None` without rows.
    pub fn local_frame(&self) -> Option<LocalFrame> {
        self.rows.first().map(|row| LocalFrame::new(row.latitude_deg, row.longitude_deg))
    }

    /// The centre line with the widths of the corridor and the speed limits, in a local frame.
    pub fn road(&self, frame: &LocalFrame, purpose: RoadPurpose, stamp_ns: i64) -> Road {
        Road {
            stamp_ns,
            purpose,
            frame: RoadFrame::Map,
            points: self.rows.iter().map(|row| frame.position_m(row.latitude_deg, row.longitude_deg)).collect(),
            widths_m: self.rows.iter().map(|row| 2.0 * row.lateral_offset_m).collect(),
            orientations: Vec::new(),
            speed_limits_mps: self.rows.iter().map(|row| row.speed_mps).collect(),
        }
    }
}

fn read_row(line: usize, row: &str, before: Option<&Row>) -> Result<Row, LineError> {
    let mut fields = row.split(',');
    let at = |what| (line, what);
    let number_field = fields.next().unwrap_or("").trim();
    let refused = |what, found: &str, allowed| LineError { line, what, found: found.to_owned(), allowed };
    let count = number_field
        .parse::<u32>()
        .map_err(|_| refused("number", number_field, "a whole number from 0 to 4294967295"))?;
    let row = Row {
        number: count,
        latitude_deg: latitude(line, fields.next())?,
        longitude_deg: longitude(line, fields.next())?,
        lateral_offset_m: FOOT_M
            * number(at("lateral offset"), fields.next(), f64::MIN_POSITIVE..=1640.0, "more than 0, up to 1640 ft")?,
        speed_mps: MPH_MPS * number(at("speed"), fields.next(), 0.0..=300.0, "0 to 300 mph")?,
    };
    // Two rows at the same position give the line no direction.
    if before.is_some_and(|b| (b.latitude_deg, b.longitude_deg) == (row.latitude_deg, row.longitude_deg)) {
        return Err(refused("place", &format!("{}, {}", row.latitude_deg, row.longitude_deg), "not the row's before"));
    }
    Ok(row)
}

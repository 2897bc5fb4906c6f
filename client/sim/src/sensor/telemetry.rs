//! The 512-byte telemetry datagram: device time, PPS state and the GPS receiver's last GPRMC sentence.
//!
//! In: stamp, place, speed, course. Layout: HDL-32E manual, appendix "Positioning data packet": microseconds past the
//! hour at byte 198, PPS state at 202, NMEA text from 206, everything else 0.

use clearway_lidar::telemetry::TELEMETRY_LENGTH;

/// Geographic position of the world's origin; x points east there.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Datum {
    /// Latitude in degrees, north positive.
    pub latitude_deg: f64,
    /// Longitude in degrees, east positive.
    pub longitude_deg: f64,
}

impl Default for Datum {
    /// The campus of UT Austin, where the car of the UT Austin thesis drove.
    fn default() -> Self {
        Self { latitude_deg: 30.2862, longitude_deg: -97.7394 }
    }
}

impl Datum {
    /// Latitude and longitude, degrees, of a place `x` metres east and `y` metres north (WGS 84's radii at the datum).
    pub fn globe(&self, x: f64, y: f64) -> (f64, f64) {
        const AXIS_M: f64 = 6_378_137.0;
        const SQUARED_ECCENTRICITY: f64 = 6.694_379_990_14e-3;
        let (sin, cos) = self.latitude_deg.to_radians().sin_cos();
        let root = (1.0 - SQUARED_ECCENTRICITY * sin * sin).sqrt();
        let meridian = AXIS_M * (1.0 - SQUARED_ECCENTRICITY) / (root * root * root);
        let parallel = AXIS_M / root * cos;
        (self.latitude_deg + (y / meridian).to_degrees(), self.longitude_deg + (x / parallel).to_degrees())
    }
}

/// State of a GPS receiver at a whole second.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fix {
    /// Time of the fix, ns since the Unix epoch.
    pub stamp_ns: i64,
    /// Latitude in degrees, north positive.
    pub latitude_deg: f64,
    /// Longitude in degrees, east positive.
    pub longitude_deg: f64,
    /// Speed over ground, m/s.
    pub speed_mps: f64,
    /// Course over ground, degrees clockwise from north, in [0, 360).
    pub course_deg: f64,
}

impl Fix {
    /// The fix as an NMEA 0183 RMC sentence with its checksum and line end.
    pub fn gprmc(&self) -> String {
        let ([year, month, day], [hour, minute, second]) = civil_time(self.stamp_ns);
        // Ten-thousandths of a minute first, so that rounding carries into the degrees.
        let angle = |degrees: f64| {
            let parts = (degrees.abs() * 600_000.0).round() as u64;
            (parts / 600_000, (parts % 600_000) as f64 / 10_000.0)
        };
        let ((lat, lat_minute), (lon, lon_minute)) = (angle(self.latitude_deg), angle(self.longitude_deg));
        let (north, east) =
            (if self.latitude_deg < 0.0 { 'S' } else { 'N' }, if self.longitude_deg < 0.0 { 'W' } else { 'E' });
        let knots = self.speed_mps * 3600.0 / 1852.0;
        let body = format!(
            "GPRMC,{hour:02}{minute:02}{second:02},A,{lat:02}{lat_minute:07.4},{north},{lon:03}{lon_minute:07.4},\
             {east},{knots:05.1},{:05.1},{day:02}{month:02}{:02},000.0,E,A",
            self.course_deg,
            year % 100,
        );
        let checksum = body.bytes().fold(0, |sum, byte| sum ^ byte);
        format!("${body}*{checksum:02X}\r\n")
    }
}

/// Year, month and day, hour, minute and second of a stamp, UTC.
pub(crate) fn civil_time(stamp_ns: i64) -> ([i64; 3], [i64; 3]) {
    let second = stamp_ns.div_euclid(1_000_000_000);
    let (year, month, day) = civil_date(second.div_euclid(86_400));
    let of_day = second.rem_euclid(86_400);
    ([year, month, day], [of_day / 3600, of_day / 60 % 60, of_day % 60])
}

/// Year, month and day of a day counted from 1970-01-01 (the Gregorian rule, in eras of 400 years from 1 March of year
/// 0).
fn civil_date(day: i64) -> (i64, i64, i64) {
    let from_march_0 = day + 719_468;
    let (era, of_era) = (from_march_0.div_euclid(146_097), from_march_0.rem_euclid(146_097));
    let year_of_era = (of_era - of_era / 1460 + of_era / 36_524 - of_era / 146_096) / 365;
    let of_year = of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let from_march = (5 * of_year + 2) / 153;
    let month = if from_march < 10 { from_march + 3 } else { from_march - 9 };
    (era * 400 + year_of_era + i64::from(month <= 2), month, of_year - (153 * from_march + 2) / 5 + 1)
}

/// The datagram sent at `stamp_ns` (ns since the Unix epoch), its device time locked to the receiver's pulse.
pub fn telemetry(stamp_ns: i64, fix: &Fix) -> [u8; TELEMETRY_LENGTH] {
    const PPS_LOCKED: u8 = 2;
    let mut payload = [0; TELEMETRY_LENGTH];
    payload[198..202].copy_from_slice(&device_us(stamp_ns).to_le_bytes());
    payload[202] = PPS_LOCKED;
    let sentence = fix.gprmc();
    payload[206..206 + sentence.len()].copy_from_slice(sentence.as_bytes());
    payload
}

/// Device time: microseconds past the UTC hour.
pub fn device_us(stamp_ns: i64) -> u32 {
    (stamp_ns.div_euclid(1000).rem_euclid(3_600_000_000)) as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_are_those_of_the_calendar() {
        for (day, date) in
            [(0, (1970, 1, 1)), (11_016, (2000, 2, 29)), (20_453, (2025, 12, 31)), (20_454, (2026, 1, 1))]
        {
            assert_eq!(civil_date(day), date);
        }
    }

    #[test]
    fn a_fix_reads_as_the_standard_example_does() {
        let fix = Fix {
            stamp_ns: 764_426_119 * 1_000_000_000,
            latitude_deg: 48.0 + 7.038 / 60.0,
            longitude_deg: -(11.0 + 31.0 / 60.0),
            speed_mps: 22.4 * 1852.0 / 3600.0,
            course_deg: 84.4,
        };
        assert_eq!(fix.gprmc(), "$GPRMC,123519,A,4807.0380,N,01131.0000,W,022.4,084.4,230394,000.0,E,A*05\r\n");
    }

    #[test]
    fn a_hundred_metres_north_is_a_hundred_metres_on_the_globe() {
        let datum = Datum::default();
        let (latitude, longitude) = datum.globe(0.0, 100.0);
        // A degree of latitude there, by the usual series: 111132.92 - 559.82 cos 2φ + 1.175 cos 4φ.
        assert!((latitude - datum.latitude_deg - 100.0 / 110_857.2).abs() < 1e-8, "{latitude}");
        assert_eq!(longitude, datum.longitude_deg);
    }
}

//! One GPRMC sentence (NMEA 0183): position, time and speed of a GPS receiver.
//!
//! In: the bytes of the sentence, from `$` to the checksum. Out: [`Gprmc`], or an [`NmeaError`].

const METRES_PER_SECOND_PER_KNOT: f64 = 1852.0 / 3600.0;

/// A GPRMC sentence: recommended minimum of position, time and speed.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gprmc {
    /// True if the receiver reports a valid fix (`A`).
    pub valid: bool,
    /// Time and date, in ns since the Unix epoch, of 1980 to 2079; `None` if either is empty.
    pub utc_ns: Option<i64>,
    /// Latitude in degrees, north positive.
    pub latitude_deg: Option<f64>,
    /// Longitude in degrees, east positive.
    pub longitude_deg: Option<f64>,
    /// Speed over ground, in knots.
    pub speed_knots: Option<f64>,
    /// Course over ground, in degrees clockwise from true north.
    pub course_deg: Option<f64>,
}

/// The reason for which a sentence is refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NmeaError {
    /// A byte is not printable ASCII.
    #[error("byte {byte:#04x} at {at} of the sentence; printable ASCII is allowed")]
    Byte {
        /// The byte that is not allowed.
        byte: u8,
        /// Index of the byte in the sentence, from 0.
        at: usize,
    },
    /// The sentence is not `$..RMC`.
    #[error("sentence starts with `{start}`; $GPRMC, or RMC of another system, is allowed")]
    Sentence {
        /// At most the first eight characters of the sentence.
        start: String,
    },
    /// The checksum is missing or wrong.
    #[error("checksum `{written}`; {computed:02X} is right")]
    Checksum {
        /// Checksum of the sentence as it was sent; empty if there is none.
        written: String,
        /// Checksum that follows from the text.
        computed: u8,
    },
    /// A field cannot be parsed or is out of bounds.
    #[error("{field}: `{value}`; it must be {allowed}")]
    Field {
        /// Name of the field.
        field: &'static str,
        /// Text of the field as it was sent.
        value: String,
        /// Values that are allowed.
        allowed: &'static str,
    },
}

impl Gprmc {
    /// Parses one sentence, from `$` to the checksum, without the end of its line.
    ///
    /// # Errors
    /// - [`NmeaError::Byte`] if a byte is not printable ASCII.
    /// - [`NmeaError::Sentence`] if the sentence is not `$..RMC`.
    /// - [`NmeaError::Checksum`] if the checksum is missing or wrong.
    /// - [`NmeaError::Field`] if a field cannot be parsed or is out of bounds.
    pub fn parse(sentence: &[u8]) -> Result<Self, NmeaError> {
        if let Some(at) = sentence.iter().position(|byte| !(0x20..0x7F).contains(byte)) {
            return Err(NmeaError::Byte { byte: sentence[at], at });
        }
        let sentence: String = sentence.iter().map(|byte| char::from(*byte)).collect();
        let fields = checked_fields(&sentence)?;
        let field = |index: usize| fields.get(index).copied().unwrap_or("");
        Ok(Self {
            valid: match field(2) {
                "A" => true,
                "V" | "" => false,
                other => return Err(wrong("status", other, "A or V")),
            },
            utc_ns: utc_ns(field(1), field(9))?,
            latitude_deg: angle("latitude", field(3), field(4), ("N", "S"), 90.0)?,
            longitude_deg: angle("longitude", field(5), field(6), ("E", "W"), 180.0)?,
            speed_knots: number("speed", field(7), 0.0..=1000.0, "0 to 1000 knots")?,
            course_deg: number("course", field(8), 0.0..=360.0, "0 to 360 degrees")?,
        })
    }

    /// Speed over ground, in m/s.
    pub fn speed_mps(&self) -> Option<f64> {
        self.speed_knots.map(|knots| knots * METRES_PER_SECOND_PER_KNOT)
    }
}

/// The fields between the commas, after the checksum is verified.
fn checked_fields(sentence: &str) -> Result<Vec<&str>, NmeaError> {
    let not_rmc = || NmeaError::Sentence { start: sentence.chars().take(8).collect() };
    let body = sentence.strip_prefix('$').ok_or_else(not_rmc)?;
    let (text, written) = body.split_once('*').unwrap_or((body, ""));
    let fields: Vec<&str> = text.split(',').collect();
    if !(fields[0].len() == 5 && fields[0].ends_with("RMC")) {
        return Err(not_rmc());
    }
    let computed = text.bytes().fold(0, |sum, byte| sum ^ byte);
    let written = written.trim();
    if written.len() != 2 || u8::from_str_radix(written, 16) != Ok(computed) {
        return Err(NmeaError::Checksum { written: written.into(), computed });
    }
    Ok(fields)
}

fn wrong(field: &'static str, value: &str, allowed: &'static str) -> NmeaError {
    NmeaError::Field { field, value: value.into(), allowed }
}

fn number(
    field: &'static str,
    value: &str,
    bounds: std::ops::RangeInclusive<f64>,
    allowed: &'static str,
) -> Result<Option<f64>, NmeaError> {
    if value.is_empty() {
        return Ok(None);
    }
    let number = value.parse().ok().filter(|number| bounds.contains(number));
    number.map(Some).ok_or_else(|| wrong(field, value, allowed))
}

/// Degrees from a text such as `3707.8178` (degrees and decimal minutes without a separator) and a hemisphere.
fn angle(
    field: &'static str,
    value: &str,
    hemisphere: &str,
    (positive, negative): (&str, &str),
    limit_deg: f64,
) -> Result<Option<f64>, NmeaError> {
    const ALLOWED: &str = "degrees and minutes below 60, such as 3707.8178, and a hemisphere";
    let Some(joined) = number(field, value, 0.0..=18_060.0, ALLOWED)? else { return Ok(None) };
    let minutes = joined % 100.0;
    let degrees = (joined / 100.0).floor() + minutes / 60.0;
    let sign = match hemisphere {
        h if h == positive => 1.0,
        h if h == negative => -1.0,
        other => return Err(wrong(field, &format!("{value},{other}"), ALLOWED)),
    };
    if minutes >= 60.0 || degrees > limit_deg {
        return Err(wrong(field, value, ALLOWED));
    }
    Ok(Some(sign * degrees))
}

/// Nanoseconds since the Unix epoch, from a time such as `214106.5` and a date such as `230715`.
fn utc_ns(time: &str, date: &str) -> Result<Option<i64>, NmeaError> {
    if time.is_empty() || date.is_empty() {
        return Ok(None);
    }
    let [hour, minute, second] = pairs(time).ok_or_else(|| wrong("time", time, "hhmmss or hhmmss.s"))?;
    let [day, month, year] = pairs(date).ok_or_else(|| wrong("date", date, "ddmmyy"))?;
    if hour > 23 || minute > 59 || second > 60 {
        return Err(wrong("time", time, "000000 to 235960"));
    }
    let whole_ns = unix_ns([year, month, day], [hour, minute, second]);
    let whole_ns = whole_ns.ok_or_else(|| wrong("date", date, "a day of a month"))?;
    // A float may also have an exponent, which a second may not: only digits are accepted.
    let digits = time.split_once('.').map_or("0", |(_, digits)| digits);
    let fraction = format!("0.{digits}").parse().ok().filter(|_| digits.bytes().all(|digit| digit.is_ascii_digit()));
    let fraction: f64 = fraction.ok_or_else(|| wrong("time", time, "hhmmss or hhmmss.s"))?;
    Ok(Some(whole_ns + (fraction * 1e9).round() as i64))
}

/// Nanoseconds since the Unix epoch of a date (year of two digits, month, day) and a time (hour, minute, second);
/// `None` if there is no such date or time.
pub(crate) fn unix_ns([year, month, day]: [i64; 3], [hour, minute, second]: [i64; 3]) -> Option<i64> {
    let is_time = hour <= 23 && minute <= 59 && second <= 60;
    if !is_time || !(0..=99).contains(&year) || !(1..=12).contains(&month) || day < 1 {
        return None;
    }
    // A receiver without a fix counts from the first day of GPS, 6 January 1980, and sends the year 80.
    let year = if year >= 80 { 1900 + year } else { 2000 + year };
    let days = days_since_1970(year, month, day);
    let next_month = days_since_1970(year + month / 12, month % 12 + 1, 1);
    (days < next_month).then_some((days * 86_400 + hour * 3_600 + minute * 60 + second) * 1_000_000_000)
}

/// The first three pairs of digits of a text.
fn pairs(text: &str) -> Option<[i64; 3]> {
    let digits = text.as_bytes().get(..6)?;
    let whole = digits.iter().all(u8::is_ascii_digit) && matches!(text.as_bytes().get(6), None | Some(b'.'));
    whole.then(|| std::array::from_fn(|i| i64::from(digits[2 * i] - b'0') * 10 + i64::from(digits[2 * i + 1] - b'0')))
}

/// Proleptic Gregorian days from 1 January 1970, by Howard Hinnant's `days_from_civil`.
fn days_since_1970(year: i64, month: i64, day: i64) -> i64 {
    let year = if month <= 2 { year - 1 } else { year };
    let (era, year_of_era) = (year.div_euclid(400), year.rem_euclid(400));
    let day_of_year = (153 * ((month + 9) % 12) + 2) / 5 + day - 1;
    era * 146_097 + year_of_era * 365 + year_of_era / 4 - year_of_era / 100 + day_of_year - 719_468
}

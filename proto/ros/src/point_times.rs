//! Times of points as drivers write them -> ns after the header's stamp.
//!
//! No field states its unit or its origin, and the name of a field does not give them. A unit and an origin (the
//! header's stamp or the Unix epoch) fit if they put nine tenths of the points within 2 s of the header's stamp; a rare
//! unit only if the points are no farther from the header's stamp than they are apart.

use crate::cdr::MessageError;
use crate::point_cloud2::Datatype;

/// Greatest distance of a point's time from the header's stamp. Ours: longer than any revolution, and ns fit in 32
/// bits.
const OFFSET_NS_MAX: i64 = 2_000_000_000;
/// Greatest number of points a second of a sensor. Ours: ten times the fastest sensor of 2026.
const POINTS_PER_NS_MAX: f64 = 0.05;
/// Least span of the times of a cloud, ns. Ours: the packets of nearly all sensors last longer, and times in ms that
/// are read as µs are below it.
const SPAN_NS_MIN: i64 = 300_000;
/// Least number of points whose rate and span are judged.
const RATED_POINTS: usize = 100;
/// Units a second: seconds, ms, µs, ns.
const UNITS: [f64; 4] = [1.0, 1e3, 1e6, 1e9];

/// Offset of each time from the header's stamp in ns; `None` for a time that is farther from it than 2 s.
///
/// # Errors
/// [`MessageError::Value`] if no unit and origin fit, if the numbers have too few bits for the ns or µs of a scan, or
/// if all times are the same, which says nothing of the points.
pub(crate) fn offsets(times: &[f64], datatype: Datatype, header_ns: i64) -> Result<Vec<Option<i64>>, MessageError> {
    let is_float = matches!(datatype, Datatype::Float32 | Datatype::Float64);
    let [seconds, milliseconds, microseconds, nanoseconds] = UNITS.map(TimeReading::AfterStamp);
    let since_epoch = match datatype {
        Datatype::Float64 | Datatype::Int64 | Datatype::Uint64 => &UNITS.map(TimeReading::SinceEpoch)[..],
        // Fewer bits hold no time since the epoch.
        _ => &[],
    };
    let after_stamp = if is_float {
        [seconds, milliseconds, microseconds, nanoseconds]
    } else {
        [nanoseconds, microseconds, milliseconds, seconds]
    };
    // Seconds of floats and ns of integers come first: most drivers write them.
    let order = after_stamp[..1].iter().chain(since_epoch).chain(&after_stamp[1..]);
    let (least, greatest) = times
        .iter()
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(least, greatest), time| (least.min(*time), greatest.max(*time)));
    let refused = |allowed| {
        let shown = format!("{least} to {greatest} with header.stamp {header_ns} ns");
        MessageError::value("time", shown, allowed)
    };
    if matches!(datatype, Datatype::Int8 | Datatype::Uint8 | Datatype::Int16 | Datatype::Uint16) {
        return Err(refused("numbers of 32 or 64 bits: with fewer the unit is not known"));
    }
    if times.len() > 1 && least == greatest {
        return Err(refused("times that differ"));
    }
    for (index, reading) in order.enumerate() {
        let offsets: Vec<Option<i64>> = times.iter().map(|time| reading.offset_ns(*time, header_ns)).collect();
        let fitting = || offsets.iter().flatten();
        let n = fitting().count();
        let (first_ns, last_ns) = fitting().min().zip(fitting().max()).map_or((0, 0), |(first, last)| (*first, *last));
        let span_ns = last_ns - first_ns;
        // Times of a clock that began with the device are small too, but far from the header.
        let is_rare = index > 0 && matches!(reading, TimeReading::AfterStamp(_));
        let is_apart = is_rare && (first_ns > span_ns || last_ns < -span_ns);
        let is_too_fast = span_ns < SPAN_NS_MIN || n as f64 > span_ns as f64 * POINTS_PER_NS_MAX;
        let is_too_fast = is_too_fast && !is_float && n >= RATED_POINTS;
        if 10 * n >= 9 * times.len() && !is_too_fast && !is_apart {
            return Ok(offsets);
        }
    }
    Err(refused("s, ms, us or ns after header.stamp or since the epoch, within 2 s of header.stamp"))
}

/// How a number is read as a time; the value is the number of units a second.
#[derive(Clone, Copy)]
enum TimeReading {
    AfterStamp(f64),
    SinceEpoch(f64),
}

impl TimeReading {
    fn offset_ns(self, time: f64, header_ns: i64) -> Option<i64> {
        let offset_ns = match self {
            _ if !time.is_finite() => None,
            Self::AfterStamp(per_second) => Some((time * (1e9 / per_second)).round() as i64),
            Self::SinceEpoch(1e9) => (time.round() as i64).checked_sub(header_ns),
            // Whole seconds are converted separately: the product of the float with 10^9 would be rounded to 256 ns.
            Self::SinceEpoch(per_second) => {
                let seconds = (time / per_second).floor();
                let rest_ns = ((time - seconds * per_second) * (1e9 / per_second)).round() as i64;
                let whole_ns = (seconds as i64).checked_mul(1_000_000_000);
                whole_ns.and_then(|ns| ns.checked_add(rest_ns)).and_then(|ns| ns.checked_sub(header_ns))
            }
        };
        offset_ns.filter(|ns| (-OFFSET_NS_MAX..=OFFSET_NS_MAX).contains(ns))
    }
}

//! The points of a [`PointCloud2`], by the conventions of drivers.
//!
//! | value | fields | meaning |
//! |---|---|---|
//! | position | `x` `y` `z`, float32 or float64 | metres; NaN, or 0 for all three, means a ray without a return |
//! | intensity | `intensity`, else `reflectivity`, any type | 0 to 1 after scaling, see below |
//! | ring | `ring`, `channel` (nebula), `laser_id`, `line` (Livox), integers | rank by elevation |
//! | time | `time`, `t`, `timestamp`, `time_stamp`, `offset_time` | see below |
//!
//! Intensities: integers are divided by the greatest value of their type; floats stay as they are, or are divided by
//! 255 if one of them is above 1. Rings of drivers that number from the top (Ouster, Hesai) are reversed.
//!
//! Names of times: `time` (Velodyne), `t` (Ouster), `timestamp` (Hesai, RoboSense, Livox), `time_stamp` (nebula,
//! Autoware). Values of times: 32-bit integers are ns after the header's stamp. Floats are seconds after it if all are
//! within 2 s; else, only as float64, seconds since the epoch if at least 10^9, or ns since the epoch if at least
//! 10^18. Every time must be within 2 s of the header's stamp: times of another clock are refused.

use crate::cdr::MessageError;
use crate::point_cloud2::{Datatype, Field, PointCloud2, describe};

const INTENSITIES: &[&str] = &["intensity", "reflectivity"];
const RINGS: &[&str] = &["ring", "channel", "laser_id", "line"];
const TIMES: &[&str] = &["time", "t", "timestamp", "time_stamp", "offset_time"];
/// Greatest distance of a point's time from the header's stamp. Ours: longer than any revolution, and ns fit in 32
/// bits.
const OFFSET_NS_MAX: i64 = 2_000_000_000;

/// Points with a return, in the order of the message, in the frame of its header. Entry i of each list belongs to point
/// i.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Points {
    /// Time of the last point, or the header's stamp if the points have no times; ns since the Unix epoch.
    pub stamp_ns: i64,
    /// Coordinates x in metres.
    pub x: Vec<f32>,
    /// Coordinates y in metres.
    pub y: Vec<f32>,
    /// Coordinates z in metres.
    pub z: Vec<f32>,
    /// Intensities, 0 to 1; 0 if the message has none.
    pub intensity: Vec<f32>,
    /// Rings: rank of the laser by elevation, 0 for the lowest; empty if the message has none.
    pub ring: Vec<u16>,
    /// Times in ns after `stamp_ns` (0 or less); empty if the message has none.
    pub offset_ns: Vec<i32>,
    /// Number of points of the message without a return.
    pub no_returns: u64,
}

impl Points {
    /// Decodes the points of a cloud.
    ///
    /// # Errors
    /// [`MessageError::Value`] if a field is missing, has a wrong type, occurs twice or overlaps another one, if a ring
    /// exceeds 16 bits, or if a time is not within 2 s of the stamp.
    pub fn from_cloud(cloud: &PointCloud2) -> Result<Self, MessageError> {
        let mut points = Self { stamp_ns: cloud.header.stamp_ns, ..Self::default() };
        if cloud.is_empty() {
            return Ok(points);
        }
        let layout = Layout::from_cloud(cloud)?;
        let capacity = cloud.height as usize * cloud.width as usize;
        let mut times = Vec::with_capacity(if layout.time.is_some() { capacity } else { 0 });
        for axis in [&mut points.x, &mut points.y, &mut points.z, &mut points.intensity] {
            axis.reserve_exact(capacity);
        }
        for point in cloud.rows() {
            let [x, y, z] = layout.position.map(|field| field.number(point) as f32);
            if x.is_nan() || y.is_nan() || z.is_nan() || [x, y, z] == [0.0; 3] {
                points.no_returns += 1;
                continue;
            }
            points.x.push(x);
            points.y.push(y);
            points.z.push(z);
            points
                .intensity
                .push(layout.intensity.map_or(0.0, |field| field.number(point) as f32 / field.full_scale()));
            if let Some(field) = layout.ring {
                let ring = field.number(point);
                let allowed = "0 to 65535";
                let exact = (0.0..=f64::from(u16::MAX)).contains(&ring);
                points.ring.push(if exact {
                    ring as u16
                } else {
                    return Err(MessageError::value("ring", ring, allowed));
                });
            }
            times.extend(layout.time.map(|field| field.number(point)));
        }
        scale(&mut points.intensity);
        number_rings_upwards(&mut points);
        if let Some(field) = layout.time {
            points.set_times(&times, field.datatype)?;
        }
        Ok(points)
    }

    /// Converts times as written to offsets from the last one.
    fn set_times(&mut self, times: &[f64], datatype: Datatype) -> Result<(), MessageError> {
        let header_ns = self.stamp_ns;
        let wrong = |time: f64| {
            let shown = format!("{time} with header.stamp {header_ns} ns");
            let allowed =
                "ns (integers) or s after header.stamp, or s or ns since the epoch, within 2 s of header.stamp";
            MessageError::value("time", shown, allowed)
        };
        let greatest = times.iter().fold(0.0_f64, |greatest, time| greatest.max(time.abs()));
        let after_header = |time: f64| match datatype {
            Datatype::Int32 | Datatype::Uint32 => Some(time as i64),
            _ if greatest <= 1e-9 * OFFSET_NS_MAX as f64 => Some((time * 1e9).round() as i64),
            Datatype::Float64 if greatest >= 1e18 => (time.round() as i64).checked_sub(header_ns),
            // Whole seconds are converted separately: the product of the float with 10^9 would be rounded to 256 ns.
            Datatype::Float64 if greatest >= 1e9 => (time.floor() as i64)
                .checked_mul(1_000_000_000)
                .and_then(|ns| ns.checked_add(((time - time.floor()) * 1e9).round() as i64))
                .and_then(|ns| ns.checked_sub(header_ns)),
            _ => None,
        };
        let offset = |time: f64| {
            let offset = after_header(time).filter(|_| time.is_finite());
            offset.filter(|ns| (-OFFSET_NS_MAX..=OFFSET_NS_MAX).contains(ns)).ok_or_else(|| wrong(time))
        };
        let mut newest = i64::MIN;
        for &time in times {
            newest = newest.max(offset(time)?);
        }
        if times.is_empty() {
            return Ok(());
        }
        self.stamp_ns = header_ns.saturating_add(newest);
        for &time in times {
            // The first point can be farther from the last one than either is from the header.
            let before = offset(time)? - newest;
            self.offset_ns.push(i32::try_from(before).map_err(|_| wrong(time))?);
        }
        Ok(())
    }
}

/// The fields of a point.
struct Layout {
    position: [FieldReader; 3],
    intensity: Option<FieldReader>,
    ring: Option<FieldReader>,
    time: Option<FieldReader>,
}

impl Layout {
    fn from_cloud(cloud: &PointCloud2) -> Result<Self, MessageError> {
        let is_float = |datatype| matches!(datatype, Datatype::Float32 | Datatype::Float64);
        let is_time = |datatype| is_float(datatype) || matches!(datatype, Datatype::Int32 | Datatype::Uint32);
        let position = |name: &'static [&str]| {
            let field = find(cloud, name, is_float, "float32, float64 (datatypes 7, 8), count 1, once")?;
            field.ok_or_else(|| {
                let names: Vec<_> = cloud.fields.iter().map(|field| field.name).collect();
                MessageError::value("fields", names.join(" "), "x y z and more")
            })
        };
        let layout = Self {
            position: [position(&["x"])?, position(&["y"])?, position(&["z"])?],
            intensity: find(cloud, INTENSITIES, |_| true, "datatypes 1 to 8, count 1, once")?,
            ring: find(cloud, RINGS, |datatype| !is_float(datatype), "integers (datatypes 1 to 6), count 1, once")?,
            time: find(cloud, TIMES, is_time, "int32, uint32, float32, float64 (datatypes 5 to 8), count 1, once")?,
        };
        layout.check_apart()?;
        Ok(layout)
    }

    fn check_apart(&self) -> Result<(), MessageError> {
        let mut all: Vec<FieldReader> =
            self.position.into_iter().chain(self.intensity).chain(self.ring).chain(self.time).collect();
        all.sort_by_key(|field| field.offset);
        let end = |field: &FieldReader| field.offset + field.datatype.size() as usize;
        match all.windows(2).find(|pair| end(&pair[0]) > pair[1].offset) {
            None => Ok(()),
            Some(pair) => {
                let shown = format!("bytes {} to {} and {} on", pair[0].offset, end(&pair[0]), pair[1].offset);
                Err(MessageError::value("fields[]", shown, "fields that do not overlap"))
            }
        }
    }
}

/// The field with the first of these names that the cloud has.
fn find(
    cloud: &PointCloud2,
    names: &[&str],
    may_be: impl Fn(Datatype) -> bool,
    allowed: &'static str,
) -> Result<Option<FieldReader>, MessageError> {
    let Some(name) = names.iter().find(|name| cloud.fields.iter().any(|field| field.name == **name)) else {
        return Ok(None);
    };
    let named: Vec<&Field> = cloud.fields.iter().filter(|field| field.name == *name).collect();
    let datatype = Datatype::from_number(named[0].datatype).filter(|datatype| may_be(*datatype));
    match datatype.filter(|_| named.len() == 1 && named[0].count == 1) {
        Some(datatype) => {
            Ok(Some(FieldReader { offset: named[0].offset as usize, datatype, big_endian: cloud.big_endian }))
        }
        None => Err(MessageError::value("fields[]", describe(named[0]), allowed)),
    }
}

/// Reads one number of each point. [`PointCloud2::new`] checks that it lies within the point.
#[derive(Clone, Copy, Debug)]
struct FieldReader {
    offset: usize,
    datatype: Datatype,
    big_endian: bool,
}

impl FieldReader {
    #[inline]
    fn number(self, point: &[u8]) -> f64 {
        match self.datatype {
            Datatype::Int8 => i8::from_le_bytes(self.bytes(point)).into(),
            Datatype::Uint8 => u8::from_le_bytes(self.bytes(point)).into(),
            Datatype::Int16 => i16::from_le_bytes(self.bytes(point)).into(),
            Datatype::Uint16 => u16::from_le_bytes(self.bytes(point)).into(),
            Datatype::Int32 => i32::from_le_bytes(self.bytes(point)).into(),
            Datatype::Uint32 => u32::from_le_bytes(self.bytes(point)).into(),
            Datatype::Float32 => f32::from_le_bytes(self.bytes(point)).into(),
            Datatype::Float64 => f64::from_le_bytes(self.bytes(point)),
        }
    }

    /// The bytes of the number, little-endian.
    #[inline]
    fn bytes<const N: usize>(self, point: &[u8]) -> [u8; N] {
        let mut bytes: [u8; N] = point[self.offset..self.offset + N].try_into().expect("N bytes");
        if self.big_endian {
            bytes.reverse();
        }
        bytes
    }

    /// Value of an intensity of 1; floats are scaled later, when all values are known.
    fn full_scale(self) -> f32 {
        match self.datatype {
            Datatype::Int8 => f32::from(i8::MAX),
            Datatype::Uint8 => f32::from(u8::MAX),
            Datatype::Int16 => f32::from(i16::MAX),
            Datatype::Uint16 => f32::from(u16::MAX),
            Datatype::Int32 => i32::MAX as f32,
            Datatype::Uint32 => u32::MAX as f32,
            Datatype::Float32 | Datatype::Float64 => 1.0,
        }
    }
}

/// Scales intensities to 0 to 1; NaN becomes 0.
fn scale(intensity: &mut [f32]) {
    let greatest = intensity.iter().copied().fold(0.0, f32::max);
    let full = if greatest > 1.0 { 255.0 } else { 1.0 };
    for value in intensity {
        *value = if value.is_nan() { 0.0 } else { (*value / full).clamp(0.0, 1.0) };
    }
}

/// Numbers rings from the bottom if their numbers fall with elevation. The highest number is then the lowest ring,
/// which measures the ground and so is in nearly every scan. Sensors have 2, 4 or a multiple of 8 rings, so the number
/// of rings is right even if the highest is missing.
fn number_rings_upwards(points: &mut Points) {
    let Some(highest) = points.ring.iter().max() else { return };
    let rings = match u32::from(*highest) + 1 {
        few @ ..8 => few.next_power_of_two(),
        many => many.next_multiple_of(8),
    };
    let Points { x, y, z, ring, .. } = points;
    let [mut n, mut sum_ring, mut sum_sine, mut sum_both] = [0.0_f64; 4];
    for (index, ring) in ring.iter().enumerate() {
        let [x, y, z] = [x[index], y[index], z[index]].map(f64::from);
        let sine = z / (x * x + y * y + z * z).sqrt();
        if sine.is_finite() {
            let ring = f64::from(*ring);
            (n, sum_ring, sum_sine, sum_both) = (n + 1.0, sum_ring + ring, sum_sine + sine, sum_both + ring * sine);
        }
    }
    if n * sum_both < sum_ring * sum_sine {
        for ring in ring {
            *ring = (rings - 1 - u32::from(*ring)) as u16;
        }
    }
}

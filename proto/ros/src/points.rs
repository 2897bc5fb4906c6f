//! The points of a [`PointCloud2`], by the conventions of the drivers that write them.
//!
//! | value | fields | taken as |
//! |---|---|---|
//! | position | `x` `y` `z`, float32 or float64 | metres; not a number, or all three 0, is a ray without a return |
//! | intensity | `intensity`, else `reflectivity`, any type | 0 to 1, see below |
//! | ring | `ring`, `channel` (nebula), `laser_id`, `line` (Livox), integers | rank by elevation |
//! | time | `time`, `t`, `timestamp`, `time_stamp`, `offset_time` | see below |
//!
//! Intensities: integers over their type's range; floats as they are, or over 255 where one is above 1. Rings of drivers
//! that number from the top (Ouster, Hesai) are turned round.
//!
//! Times are called `time` by Velodyne's driver, `t` by Ouster's, `timestamp` by those of Hesai, RoboSense and Livox,
//! `time_stamp` by nebula and Autoware.
//! Times: 32-bit integers are ns after the header's stamp. Floats are seconds after it where all lie within 2 s, else
//! seconds since the epoch from 10^9 on, else ns since the epoch from 10^18 on (float64 only). Every time must lie
//! within 2 s of the header's stamp: times of another clock are refused, not guessed at.

use crate::cdr::MessageError;
use crate::point_cloud2::{Datatype, Field, PointCloud2, described};

const INTENSITIES: &[&str] = &["intensity", "reflectivity"];
const RINGS: &[&str] = &["ring", "channel", "laser_id", "line"];
const TIMES: &[&str] = &["time", "t", "timestamp", "time_stamp", "offset_time"];
/// How far a point's time may lie from its header's stamp: beyond any turn, within what 32 bits of ns hold.
const OFFSET_NS_MAX: i64 = 2_000_000_000;

/// Points with a return, in the order of the message, in the frame its header names. Same index, same point.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Points {
    /// When the last of them was measured (the header's stamp where the points have no times), ns since the Unix epoch.
    pub stamp_ns: i64,
    /// Metres.
    pub x: Vec<f32>,
    /// Metres.
    pub y: Vec<f32>,
    /// Metres.
    pub z: Vec<f32>,
    /// 0 to 1; 0 where the message has none.
    pub intensity: Vec<f32>,
    /// Rank of the laser by elevation, 0 lowest; empty where the message has none.
    pub ring: Vec<u16>,
    /// ns after `stamp_ns`, so at most 0; empty where the message has none.
    pub offset_ns: Vec<i32>,
    /// Points of the message without a return.
    pub no_returns: u64,
}

impl Points {
    /// Reads the points of a cloud.
    ///
    /// # Errors
    /// [`MessageError::Value`] for a field that is missing, of a wrong type, twice there or over another one, for a
    /// ring beyond 16 bits and for a time that is none.
    pub fn of(cloud: &PointCloud2) -> Result<Self, MessageError> {
        let mut points = Self { stamp_ns: cloud.header.stamp_ns, ..Self::default() };
        if cloud.is_empty() {
            return Ok(points);
        }
        let places = Places::of(cloud)?;
        let capacity = cloud.height as usize * cloud.width as usize;
        let mut times = Vec::with_capacity(if places.time.is_some() { capacity } else { 0 });
        for axis in [&mut points.x, &mut points.y, &mut points.z, &mut points.intensity] {
            axis.reserve_exact(capacity);
        }
        for point in cloud.rows() {
            let [x, y, z] = places.position.map(|place| place.number(point) as f32);
            if x.is_nan() || y.is_nan() || z.is_nan() || [x, y, z] == [0.0; 3] {
                points.no_returns += 1;
                continue;
            }
            points.x.push(x);
            points.y.push(y);
            points.z.push(z);
            points
                .intensity
                .push(places.intensity.map_or(0.0, |place| place.number(point) as f32 / place.full_scale()));
            if let Some(place) = places.ring {
                let ring = place.number(point);
                let allowed = "0 to 65535";
                let exact = (0.0..=f64::from(u16::MAX)).contains(&ring);
                points.ring.push(if exact {
                    ring as u16
                } else {
                    return Err(MessageError::value("ring", ring, allowed));
                });
            }
            times.extend(places.time.map(|place| place.number(point)));
        }
        scale(&mut points.intensity);
        turn_upwards(&mut points);
        if let Some(place) = places.time {
            points.take_times(&times, place.datatype)?;
        }
        Ok(points)
    }

    /// Turns times as written into offsets from the last one.
    fn take_times(&mut self, times: &[f64], datatype: Datatype) -> Result<(), MessageError> {
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
            // The whole seconds apart: their product with 10^9 would be rounded to 256 ns.
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
            // The earliest may lie farther from the last than from the header between them.
            let before = offset(time)? - newest;
            self.offset_ns.push(i32::try_from(before).map_err(|_| wrong(time))?);
        }
        Ok(())
    }
}

/// Where the values lie in each point.
struct Places {
    position: [Place; 3],
    intensity: Option<Place>,
    ring: Option<Place>,
    time: Option<Place>,
}

impl Places {
    fn of(cloud: &PointCloud2) -> Result<Self, MessageError> {
        let is_float = |datatype| matches!(datatype, Datatype::Float32 | Datatype::Float64);
        let is_time = |datatype| is_float(datatype) || matches!(datatype, Datatype::Int32 | Datatype::Uint32);
        let position = |name: &'static [&str]| {
            let place = find(cloud, name, is_float, "float32, float64 (datatypes 7, 8), count 1, once")?;
            place.ok_or_else(|| {
                let names: Vec<_> = cloud.fields.iter().map(|field| field.name).collect();
                MessageError::value("fields", names.join(" "), "x y z and more")
            })
        };
        let places = Self {
            position: [position(&["x"])?, position(&["y"])?, position(&["z"])?],
            intensity: find(cloud, INTENSITIES, |_| true, "datatypes 1 to 8, count 1, once")?,
            ring: find(cloud, RINGS, |datatype| !is_float(datatype), "integers (datatypes 1 to 6), count 1, once")?,
            time: find(cloud, TIMES, is_time, "int32, uint32, float32, float64 (datatypes 5 to 8), count 1, once")?,
        };
        places.check_apart()?;
        Ok(places)
    }

    fn check_apart(&self) -> Result<(), MessageError> {
        let mut all: Vec<Place> =
            self.position.into_iter().chain(self.intensity).chain(self.ring).chain(self.time).collect();
        all.sort_by_key(|place| place.offset);
        let end = |place: &Place| place.offset + place.datatype.size() as usize;
        match all.windows(2).find(|pair| end(&pair[0]) > pair[1].offset) {
            None => Ok(()),
            Some(pair) => {
                let shown = format!("bytes {} to {} and {} on", pair[0].offset, end(&pair[0]), pair[1].offset);
                Err(MessageError::value("fields[]", shown, "fields that do not overlap"))
            }
        }
    }
}

/// The first of these names that the cloud has.
fn find(
    cloud: &PointCloud2,
    names: &[&str],
    may_be: impl Fn(Datatype) -> bool,
    allowed: &'static str,
) -> Result<Option<Place>, MessageError> {
    let Some(name) = names.iter().find(|name| cloud.fields.iter().any(|field| field.name == **name)) else {
        return Ok(None);
    };
    let named: Vec<&Field> = cloud.fields.iter().filter(|field| field.name == *name).collect();
    let datatype = Datatype::of(named[0].datatype).filter(|datatype| may_be(*datatype));
    match datatype.filter(|_| named.len() == 1 && named[0].count == 1) {
        Some(datatype) => Ok(Some(Place { offset: named[0].offset as usize, datatype, big_endian: cloud.big_endian })),
        None => Err(MessageError::value("fields[]", described(named[0]), allowed)),
    }
}

/// One number of each point. [`PointCloud2::new`] has seen to it that it lies within the point.
#[derive(Clone, Copy, Debug)]
struct Place {
    offset: usize,
    datatype: Datatype,
    big_endian: bool,
}

impl Place {
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

    /// Least byte first.
    #[inline]
    fn bytes<const N: usize>(self, point: &[u8]) -> [u8; N] {
        let mut bytes: [u8; N] = point[self.offset..self.offset + N].try_into().expect("that many bytes");
        if self.big_endian {
            bytes.reverse();
        }
        bytes
    }

    /// What stands for an intensity of 1; floats are looked at once all are known.
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

/// Brings intensities into 0 to 1; one that is no number becomes 0.
fn scale(intensity: &mut [f32]) {
    let greatest = intensity.iter().copied().fold(0.0, f32::max);
    let full = if greatest > 1.0 { 255.0 } else { 1.0 };
    for value in intensity {
        *value = if value.is_nan() { 0.0 } else { (*value / full).clamp(0.0, 1.0) };
    }
}

/// Where rings fall with elevation, numbers them from the bottom. The highest number is then the lowest ring, which
/// sees the ground and is in nearly every scan; sensors have 2, 4 or a multiple of 8 rings, so the others keep their
/// number without it too.
fn turn_upwards(points: &mut Points) {
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

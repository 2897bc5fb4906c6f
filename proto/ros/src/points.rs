//! The points of a [`PointCloud2`], by the conventions of drivers.
//!
//! | value | fields | meaning |
//! |---|---|---|
//! | position | `x` `y` `z`, float32 or float64 | metres; NaN, or 0 for all three, means a ray without a return |
//! | intensity | `intensity`, else `reflectivity`, any type | 0 to 1 after scaling, see below |
//! | ring | `ring`, `channel` (nebula), `laser_id`, `line` (Livox), whole numbers of any type | rank by elevation |
//! | time | `time`, `t`, `timestamp`, `time_stamp`, `offset_time` | `point_times` |
//!
//! Intensities: integers are divided by the greatest value of their type; floats stay as they are, or are divided by
//! 255 if one of them is above 1. Rings of drivers that number from the top (Ouster, Hesai) are reversed.
//!
//! A wrong ring or time costs its point; if more than a tenth of the points have one, the field is left out. The points
//! of a cloud without times have the header's stamp.

use crate::cdr::{MessageError, RefusedPart};
use crate::point_cloud2::{Datatype, PointCloud2};
use crate::point_layout::Layout;
use crate::point_times;

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
    /// The fields that were left out, and the points with a wrong ring or time, which are not in the lists.
    pub refused: Vec<RefusedPart>,
}

impl Points {
    /// Decodes the points of a cloud.
    ///
    /// # Errors
    /// [`MessageError::Value`] if `x`, `y` or `z` is missing, has a wrong type, occurs twice or does not lie within the
    /// point.
    pub fn from_cloud(cloud: &PointCloud2) -> Result<Self, MessageError> {
        let mut points = Self { stamp_ns: cloud.header.stamp_ns, ..Self::default() };
        if cloud.is_empty() {
            return Ok(points);
        }
        let layout = Layout::from_cloud(cloud, &mut points.refused)?;
        let capacity = cloud.height as usize * cloud.width as usize;
        let of = |is_used: bool| Vec::with_capacity(if is_used { capacity } else { 0 });
        let (mut rings, mut times) = (of(layout.ring.is_some()), of(layout.time.is_some()));
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
            rings.extend(layout.ring.map(|field| field.number(point)));
            times.extend(layout.time.map(|field| field.number(point)));
        }
        let mut is_wrong = vec![false; points.x.len()];
        let rings = points.judged_rings(&rings, &mut is_wrong);
        let offsets = match layout.time {
            Some(field) => points.judged_times(&times, field.datatype, &mut is_wrong),
            None => Vec::new(),
        };
        points.keep(&is_wrong, rings, offsets);
        scale(&mut points.intensity);
        number_rings_upwards(&mut points);
        Ok(points)
    }

    /// The rings, and which points have a wrong one; empty if the field is left out.
    fn judged_rings(&mut self, rings: &[f64], is_wrong: &mut [bool]) -> Vec<u16> {
        let is_ring = |ring: f64| (0.0..=f64::from(u16::MAX)).contains(&ring) && ring.fract() == 0.0;
        let wrong = || rings.iter().filter(|ring| !is_ring(**ring));
        let Some(first) = wrong().next() else { return rings.iter().map(|ring| *ring as u16).collect() };
        let fault = MessageError::value("ring", first, "whole numbers from 0 to 65535");
        if 10 * wrong().count() > rings.len() {
            self.refused.push(RefusedPart { what: "field", count: 1, fault });
            return Vec::new();
        }
        self.refused.push(RefusedPart { what: "points", count: wrong().count() as u64, fault });
        is_wrong.iter_mut().zip(rings).for_each(|(is_wrong, ring)| *is_wrong |= !is_ring(*ring));
        rings.iter().map(|ring| *ring as u16).collect()
    }

    /// The times in ns after the header's stamp, and which points have a wrong one; empty if the field is left out.
    fn judged_times(&mut self, times: &[f64], datatype: Datatype, is_wrong: &mut [bool]) -> Vec<i64> {
        let offsets = match point_times::offsets(times, datatype, self.stamp_ns) {
            Ok(offsets) => offsets,
            Err(fault) => {
                self.refused.push(RefusedPart { what: "field", count: 1, fault });
                return Vec::new();
            }
        };
        let mut wrong = times.iter().zip(&offsets).zip(&*is_wrong).filter(|((_, offset), is_wrong)| {
            // A point is counted once.
            offset.is_none() && !**is_wrong
        });
        if let Some(((first, _), _)) = wrong.next() {
            let shown = format!("{first} with header.stamp {} ns", self.stamp_ns);
            let fault = MessageError::value("time", shown, "times within 2 s of header.stamp, as of the other points");
            self.refused.push(RefusedPart { what: "points", count: 1 + wrong.count() as u64, fault });
        }
        is_wrong.iter_mut().zip(&offsets).for_each(|(is_wrong, offset)| *is_wrong |= offset.is_none());
        offsets.into_iter().map(Option::unwrap_or_default).collect()
    }

    /// Removes the wrong points and enters the rings and the times of the others. The stamp becomes the time of the
    /// last point.
    fn keep(&mut self, is_wrong: &[bool], rings: Vec<u16>, offsets: Vec<i64>) {
        fn kept<T: Copy>(values: &mut Vec<T>, is_wrong: &[bool]) {
            if !values.is_empty() && is_wrong.contains(&true) {
                let mut wrong = is_wrong.iter();
                values.retain(|_| !wrong.next().expect("an entry for each point"));
            }
        }
        for axis in [&mut self.x, &mut self.y, &mut self.z, &mut self.intensity] {
            kept(axis, is_wrong);
        }
        let mut offsets = offsets;
        self.ring = rings;
        kept(&mut self.ring, is_wrong);
        kept(&mut offsets, is_wrong);
        let Some(newest) = offsets.iter().max().copied() else { return };
        let before = |ns: &i64| i32::try_from(ns - newest);
        // The first point can be farther from the last one than either is from the header.
        match offsets.iter().map(before).collect() {
            Ok(offset_ns) => (self.stamp_ns, self.offset_ns) = (self.stamp_ns.saturating_add(newest), offset_ns),
            Err(_) => {
                let fault = MessageError::value("time", "a span above 2.1 s", "a span of up to 2.1 s");
                self.refused.push(RefusedPart { what: "field", count: 1, fault });
            }
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

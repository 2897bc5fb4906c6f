//! Safe points <-> `clearway.v1.SafePoints`: whole steps, each as the difference from the point before.
//!
//! Neighbours lie a cell apart, and most are linked with the point before them: so a point takes three bytes.

use crate::map::{MapError, SafePoint};
use crate::v1;

/// Places beyond this many steps would not be exact in single precision.
const STEPS_MAX: i64 = 1 << 24;

/// Packs points whose places are multiples of `step_m`; others are rounded to the nearest, radii down to centimetres.
/// `links` hold, for each point, points before it, ascending.
pub fn pack(points: &[SafePoint], step_m: f32) -> v1::SafePoints {
    let steps = |metres: f32| (f64::from(metres) / f64::from(step_m)).round() as i32;
    let differences = |value: &dyn Fn(&SafePoint) -> i32| -> Vec<i32> {
        let values: Vec<i32> = std::iter::once(0).chain(points.iter().map(value)).collect();
        values.array_windows().map(|[before, here]| here.wrapping_sub(*before)).collect()
    };
    let mut packed = v1::SafePoints {
        step_m,
        x: differences(&|point| steps(point.x_m)),
        y: differences(&|point| steps(point.y_m)),
        // A millionth of a centimetre for what single precision took off.
        radius_cm: differences(&|point| (f64::from(point.radius_m) * 100.0 + 1e-6).floor() as i32),
        ..Default::default()
    };
    let (mut last_start, mut last_from) = (0, 0);
    for (index, point) in (0u32..).zip(points) {
        if index > 0 && point.links.last() != Some(&(index - 1)) {
            packed.starts.push(index - last_start);
            last_start = index;
        }
        for link in point.links.iter().filter(|link| *link + 1 < index) {
            packed.link_from.push(index - last_from);
            packed.link_back.push(index - link);
            last_from = index;
        }
    }
    packed
}

/// Unpacks, at most `points_max` points.
///
/// # Errors
/// [`MapError::SafePoint`] of the layer, naming the first point found wrong.
pub(crate) fn unpack(layer: &str, packed: &v1::SafePoints, points_max: usize) -> Result<Vec<SafePoint>, MapError> {
    let wrong = |point: usize, what: String| MapError::SafePoint { layer: layer.to_owned(), point, what };
    let v1::SafePoints { step_m, x, y, radius_cm, starts, link_from, link_back } = packed;
    let lengths = [x.len(), y.len(), radius_cm.len()];
    if lengths != [x.len(); 3] || x.len() > points_max {
        return Err(wrong(0, format!("{lengths:?} values; as many of each, at most {points_max}, are allowed")));
    }
    if !(step_m.is_finite() && *step_m > 0.0) {
        return Err(wrong(0, format!("steps of {step_m} m; finite metres over 0 are needed")));
    }
    let mut points = Vec::with_capacity(x.len());
    let mut sums = [0i64; 3];
    for (index, ((dx, dy), dr)) in x.iter().zip(y).zip(radius_cm).enumerate() {
        for (sum, difference) in sums.iter_mut().zip([dx, dy, dr]) {
            *sum += i64::from(*difference);
        }
        if sums.iter().any(|sum| sum.abs() > STEPS_MAX) || sums[2] < 0 {
            let text = format!("{sums:?} steps and cm; to ±{STEPS_MAX} and a radius of 0 or more are allowed");
            return Err(wrong(index, text));
        }
        let [x_m, y_m] = [sums[0], sums[1]].map(|steps| steps as f32 * step_m);
        let before = index.checked_sub(1).map(|before| before as u32);
        let radius_m = sums[2] as f32 / 100.0;
        points.push(SafePoint { x_m, y_m, radius_m, links: before.into_iter().collect() });
    }
    let mut start = 0;
    for ahead in starts {
        start += *ahead as usize;
        match points.get_mut(start).filter(|_| *ahead > 0) {
            Some(point) => point.links.clear(),
            None => return Err(wrong(start, "starts a line; points behind the first, ascending, are needed".into())),
        }
    }
    link(&mut points, link_from, link_back).map_err(|(point, what)| wrong(point, what))?;
    Ok(points)
}

/// Adds the links that are not to the point before.
fn link(points: &mut [SafePoint], link_from: &[u32], link_back: &[u32]) -> Result<(), (usize, String)> {
    if link_from.len() != link_back.len() {
        return Err((0, format!("links from {} points to {}", link_from.len(), link_back.len())));
    }
    let mut from = 0;
    let mut from_before = None;
    for (ahead, back) in link_from.iter().zip(link_back) {
        from += *ahead as usize;
        let to = from.checked_sub(*back as usize).map(|to| to as u32);
        let (Some(point), Some(to), 2..) = (points.get_mut(from), to, *back) else {
            return Err((from, format!("a link {back} points back; to points before the one before it is allowed")));
        };
        // A pair before leads to a point before: no link is named twice.
        if from_before.is_some_and(|(before, other)| before == from && other >= to) {
            return Err((from, format!("a link to {to} behind a later one; ascending ones are needed")));
        }
        from_before = Some((from, to));
        // The point before stays last.
        let place = point.links.partition_point(|link| *link < to);
        point.links.insert(place, to);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(x_m: f32, y_m: f32, radius_m: f32, links: &[u32]) -> SafePoint {
        SafePoint { x_m, y_m, radius_m, links: links.to_vec() }
    }

    #[test]
    fn points_come_back_as_they_were_their_radii_rounded_down() {
        let points = [
            point(0.0, 0.0, 1.25, &[]),
            point(-0.125, 60.0, 0.999, &[]),
            point(0.25, 59.875, 1.5, &[0, 1]),
            point(0.0, 0.0, 0.0, &[0, 1]),
            point(0.5, -2.0, 3.0, &[0, 2, 3]),
        ];
        let unpacked = unpack("safe_path", &pack(&points, 0.125), 5).unwrap();
        let mut expected = points.to_vec();
        expected[1].radius_m = 0.99;
        assert_eq!(unpacked, expected);
        assert!(unpack("safe_path", &pack(&points, 0.125), 4).is_err());
        assert_eq!(unpack("safe_path", &pack(&[], 0.125), 0), Ok(vec![]));
    }
}

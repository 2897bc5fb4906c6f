//! Safe points <-> `clearway.v1.SafePoints`: integer steps, each as the difference from the point before.
//!
//! Consecutive points lie one cell apart, and most are linked to the point before, so a point needs three bytes.

use crate::limits::SAFE_POINT_STEPS_MAX;
use crate::map::error::MapError;
use crate::map::layer::SafePoint;
use crate::v1;

/// Packs points. Coordinates are rounded to the nearest multiple of `step_m`, radii down to centimetres. The links of
/// each point are earlier points, ascending.
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
        // A millionth of a centimetre makes up for the rounding of single precision.
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

/// Unpacks at most `points_max` points of a layer.
///
/// # Errors
/// [`MapError::SafePoint`] with the first invalid point: if the lists differ in length or there are too many points, if
/// the step is not a finite length over 0, if a point is too far away or has a negative radius, or if a start or link
/// is not ascending or leads to a point that does not exist.
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
        if sums.iter().any(|sum| sum.abs() > SAFE_POINT_STEPS_MAX) || sums[2] < 0 {
            let text =
                format!("{sums:?} steps and cm; to ±{SAFE_POINT_STEPS_MAX} and a radius of 0 or more are allowed");
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
            None => return Err(wrong(start, "starts a line; ascending points after the first are needed".into())),
        }
    }
    add_links(&mut points, link_from, link_back, wrong)?;
    Ok(points)
}

/// Adds the links other than links to the point before. `wrong` makes the error of a point.
fn add_links(
    points: &mut [SafePoint],
    link_from: &[u32],
    link_back: &[u32],
    wrong: impl Fn(usize, String) -> MapError,
) -> Result<(), MapError> {
    if link_from.len() != link_back.len() {
        return Err(wrong(0, format!("links from {} points to {}", link_from.len(), link_back.len())));
    }
    let mut from = 0;
    let mut from_before = None;
    for (ahead, back) in link_from.iter().zip(link_back) {
        from += *ahead as usize;
        let to = from.checked_sub(*back as usize).map(|to| to as u32);
        let (Some(point), Some(to), 2..) = (points.get_mut(from), to, *back) else {
            let text = format!("a link {back} points back; 2 or more, to a point that exists, are needed");
            return Err(wrong(from, text));
        };
        // Links of one point ascend, so no link occurs twice.
        if from_before.is_some_and(|(before, other)| before == from && other >= to) {
            return Err(wrong(from, format!("a link to {to} after one to a later point; ascending links are needed")));
        }
        from_before = Some((from, to));
        // The link to the point before stays last.
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
    fn points_unpack_to_themselves_with_radii_rounded_down() {
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

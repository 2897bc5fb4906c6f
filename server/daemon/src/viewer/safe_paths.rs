//! Safe points of a layer -> lines and poses that viewers draw.
//!
//! In: the points, in the ego frame. Out: pairs of points, each a straight line, for the links and for circles with the
//! safety radii; and a pose for each point, along its link.

use std::f64::consts::TAU;

use clearway_client::SafePoint;
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

/// Name of the layer whose safe points are published.
pub const LAYER: &str = "safe_path";
/// Width of the links' lines in metres.
pub const LINK_M: f64 = 0.15;
/// Red, green, blue and opacity of the links' lines, as on the page.
pub const LINK_RGBA: [f32; 4] = [1.0, 0.88, 0.3, 1.0];
/// Width of the circles' lines in metres.
pub const CIRCLE_M: f64 = 0.05;
/// Red, green, blue and opacity of the circles' lines.
pub const CIRCLE_RGBA: [f32; 4] = [1.0, 1.0, 1.0, 0.5];
/// Height of lines and poses over the ground in metres, so that they are not in the plane of the grids.
const LIFT_M: f64 = 0.05;
/// A circle is drawn every so many points, and at ends and branches. Ours: 2 m apart with cells of 0.25 m.
const CIRCLE_EVERY: usize = 8;
/// Straight lines of a circle.
const SIDES: u32 = 32;

/// A point of a line: x forward, y left, z up, in metres.
pub type Place = [f64; 3];

/// The links, two places each.
pub fn links(points: &[SafePoint]) -> Vec<Place> {
    let ends = points.iter().flat_map(|point| point.links.iter().map(move |&link| (point, link as usize)));
    ends.flat_map(|(point, link)| [place(point), place(&points[link])]).collect()
}

/// Circles with the safety radii, as lines of two places each. The vehicle's own position, which is the first point,
/// has no circle.
pub fn circles(points: &[SafePoint]) -> Vec<Place> {
    let mut linked = vec![0; points.len()];
    for (index, point) in points.iter().enumerate() {
        linked[index] += point.links.len();
        point.links.iter().for_each(|&link| linked[link as usize] += 1);
    }
    let is_drawn = |index: &usize| linked[*index] != 2 || index.is_multiple_of(CIRCLE_EVERY);
    (1..points.len()).filter(is_drawn).flat_map(|index| circle(&points[index])).collect()
}

fn circle(point: &SafePoint) -> impl Iterator<Item = Place> {
    let ([x, y, z], radius_m) = (place(point), f64::from(point.radius_m));
    let corner = move |side: u32| {
        let (sin, cos) = (TAU * f64::from(side % SIDES) / f64::from(SIDES)).sin_cos();
        [x + radius_m * cos, y + radius_m * sin, z]
    };
    (0..SIDES).flat_map(move |side| [corner(side), corner(side + 1)])
}

/// The pose of each point: it heads along the link from the point before it. The vehicle's own position heads straight
/// ahead.
pub fn poses(points: &[SafePoint]) -> Vec<Isometry3<f64>> {
    let pose = |point: &SafePoint| {
        let [x, y, z] = place(point);
        let heading_rad = point.links.last().map_or(0.0, |&link| {
            let [from_x, from_y, _] = place(&points[link as usize]);
            (y - from_y).atan2(x - from_x)
        });
        let rotation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), heading_rad);
        Isometry3::from_parts(Translation3::new(x, y, z), rotation)
    };
    points.iter().map(pose).collect()
}

fn place(point: &SafePoint) -> Place {
    [point.x_m.into(), point.y_m.into(), LIFT_M]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn links_circles_and_poses_lie_where_the_points_are() {
        let point = |x_m, y_m, radius_m, links: &[u32]| SafePoint { x_m, y_m, radius_m, links: links.to_vec() };
        let points = [
            point(0.0, 0.0, 1.0, &[]),
            point(4.0, 0.0, 2.0, &[0]),
            point(4.0, 1.0, 3.0, &[1]),
            point(5.0, 1.0, 1.5, &[2]),
        ];
        let links = links(&points);
        assert_eq!(links.len(), 6);
        assert_eq!(links[2..4], [[4.0, 1.0, LIFT_M], [4.0, 0.0, LIFT_M]]);
        // Only the last point is an end; the others have two links each.
        let circles = circles(&points);
        assert_eq!(circles.len(), 2 * SIDES as usize);
        for [x, y, _] in circles {
            assert!(((x - 5.0).hypot(y - 1.0) - 1.5).abs() < 1e-9, "({x}, {y})");
        }
        let headings: Vec<_> = poses(&points).iter().map(|pose| pose.rotation.euler_angles().2).collect();
        let expected = [0.0, 0.0, TAU / 4.0, 0.0];
        assert_eq!(headings.len(), expected.len());
        for (heading, expected) in headings.into_iter().zip(expected) {
            assert!((heading - expected).abs() < 1e-9, "{heading} instead of {expected}");
        }
    }
}

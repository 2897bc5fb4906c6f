//! Contact of a vehicle with the world: its upright box against every shape, exactly.
//!
//! In: a world, a time, the vehicle's place. Frame: world, metres. Leaves and beams are touched only at the heights at
//! which they hang.

use super::object::{Kind, Shape};
use super::world::World;

/// A vehicle's box: its middle, heading (rad, counter-clockwise from x) and extents. It stands on the ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hull {
    /// Coordinate x of the middle, in metres.
    pub x: f64,
    /// Coordinate y of the middle, in metres.
    pub y: f64,
    /// Heading, in rad, counter-clockwise from x.
    pub heading: f64,
    /// Length, width and height.
    pub size: [f64; 3],
}

impl World {
    /// The first object that a vehicle touches at `time` s, or `None`.
    pub fn touched(&self, hull: &Hull, time: f64) -> Option<Kind> {
        let floor = self.ground.height(hull.x, hull.y);
        let shapes = self.objects.iter().map(|object| (object.kind, object.at(time, &self.ground)));
        let at_its_height = |shape: &Shape| {
            let (bottom, top) = heights(shape);
            bottom < floor + hull.size[2] && top > floor
        };
        let mut touched = shapes.filter(|(_, shape)| at_its_height(shape) && hull.meets(shape));
        touched.next().map(|(kind, _)| kind)
    }
}

impl Hull {
    /// True if the ground that the hull covers overlaps the ground that a shape covers.
    fn meets(&self, shape: &Shape) -> bool {
        let (outline, radius) = shape.outline();
        let corners = outline.map(|corner| self.in_own_frame(corner));
        let half = [self.size[0] / 2.0, self.size[1] / 2.0];
        if radius > 0.0 {
            let off = |axis: usize| (corners[0][axis].abs() - half[axis]).max(0.0);
            return off(0).hypot(off(1)) <= radius;
        }
        // Convex shapes are apart where the normal of a side of either parts them. Two sides of the shape meet at `a`.
        let [a, b, c, _] = corners;
        let normal = |from: [f64; 2], to: [f64; 2]| [from[1] - to[1], to[0] - from[0]];
        [[1.0, 0.0], [0.0, 1.0], normal(a, b), normal(a, c)].iter().all(|axis| {
            let along = corners.map(|corner| axis[0] * corner[0] + axis[1] * corner[1]);
            let own = axis[0].abs() * half[0] + axis[1].abs() * half[1];
            let least = along.iter().copied().fold(f64::INFINITY, f64::min);
            let greatest = along.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            least <= own && greatest >= -own
        })
    }

    fn in_own_frame(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let ((sin, cos), dx, dy) = (self.heading.sin_cos(), x - self.x, y - self.y);
        [dx * cos + dy * sin, dy * cos - dx * sin]
    }
}

/// Bottom and top of a shape.
fn heights(shape: &Shape) -> (f64, f64) {
    match *shape {
        Shape::Block { z, .. } | Shape::Post { z, .. } => z,
        Shape::Panel { length, base: (low, climb), height, .. } => {
            (low + (climb * length).min(0.0), low + (climb * length).max(0.0) + height)
        }
        Shape::Crown { z, rise, underside, .. } => (underside, z + rise),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::ground::Ground;

    #[test]
    fn a_vehicle_touches_standing_objects_and_passes_under_high_ones() {
        let world = World::on(Ground::default())
            .parked_car(10.0, 0.0, 0.0)
            .pole(0.0, 5.0, 0.1, 4.0)
            .fence(&[[-10.0, -5.0], [-10.0, 5.0]], 1.2, None)
            .beam([20.0, -5.0], [20.0, 5.0], 2.5, 3.0);
        let touched = |x, y, heading: f64| world.touched(&Hull { x, y, heading, size: [4.4, 1.8, 1.6] }, 0.0);
        assert_eq!(touched(0.0, 0.0, 0.3), None);
        // Bumper to bumper at 5.6, and the corner of a car that stands askew 0.3 m before that.
        assert_eq!([touched(5.59, 0.0, 0.0), touched(5.61, 0.0, 0.0)], [None, Some(Kind::ParkedCar)]);
        assert_eq!([touched(5.3, 0.0, 0.0), touched(5.3, 0.0, 0.3)], [None, None]);
        assert_eq!([touched(5.42, 0.0, 0.3), touched(5.46, 0.0, 0.3)], [None, Some(Kind::ParkedCar)]);
        assert_eq!([touched(0.0, 3.99, 0.0), touched(0.0, 4.01, 0.0)], [None, Some(Kind::Pole)]);
        assert_eq!([touched(-7.79, 0.0, 0.0), touched(-7.81, 0.0, 0.0)], [None, Some(Kind::Fence)]);
        assert_eq!(touched(20.0, 0.0, 0.0), None);
    }

    #[test]
    fn a_car_that_stands_askew_is_touched_at_its_long_side_too() {
        let world = World::on(Ground::default()).parked_car(3.0, 0.0, -0.5);
        let touched = |y| world.touched(&Hull { x: 0.0, y, heading: 0.0, size: [4.4, 1.8, 1.6] }, 0.0);
        assert_eq!([touched(-1.50), touched(-1.48)], [None, Some(Kind::ParkedCar)]);
    }
}

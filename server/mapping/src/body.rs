//! The vehicle's own box: what is seen of it, and what is seen through it.
//!
//! In: a return and the sensor's place, ego frame at the moment of the firing, metres. Out: what hides it. A ray that
//! crosses the vehicle cannot have come straight: it was thrown back by its own paint or glass, and what it shows is a
//! mirror image.

use crate::config::BodyConfig;

/// Why a return is none of the surroundings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Hidden {
    /// It lies on or in the vehicle.
    OwnBody,
    /// Its ray crosses the vehicle.
    ThroughBody,
}

/// The box as one sensor sees it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Body {
    min_m: [f32; 3],
    max_m: [f32; 3],
    sensor_m: [f32; 3],
    /// Rays of a sensor that sits inside leave the box once, and are not crossed by it.
    sensor_inside: bool,
}

impl Body {
    /// The box as seen from `sensor_m`, ego frame. It reaches down without end: no ray passes under the vehicle.
    pub fn new(config: &BodyConfig, sensor_m: [f32; 3]) -> Self {
        let min_m = [config.x_m_min, config.y_m_min, f32::NEG_INFINITY];
        let max_m = [config.x_m_max, config.y_m_max, config.z_m_max];
        let mut body = Self { min_m, max_m, sensor_m, sensor_inside: false };
        body.sensor_inside = body.holds(sensor_m);
        body
    }

    /// What hides a return at `point_m`, if anything does.
    pub fn hides(&self, point_m: [f32; 3]) -> Option<Hidden> {
        if self.holds(point_m) {
            Some(Hidden::OwnBody)
        } else if !self.sensor_inside && self.crosses(point_m) {
            Some(Hidden::ThroughBody)
        } else {
            None
        }
    }

    fn holds(&self, point_m: [f32; 3]) -> bool {
        (0..3).all(|axis| (self.min_m[axis]..=self.max_m[axis]).contains(&point_m[axis]))
    }

    /// Whether the way from the sensor to the point has a part inside: the slabs' shares of the way overlap.
    fn crosses(&self, point_m: [f32; 3]) -> bool {
        let (mut enter, mut leave) = (0.0f32, 1.0f32);
        for axis in 0..3 {
            let (from, way) = (self.sensor_m[axis], point_m[axis] - self.sensor_m[axis]);
            if way == 0.0 {
                if !(self.min_m[axis]..=self.max_m[axis]).contains(&from) {
                    return false;
                }
                continue;
            }
            let (a, b) = ((self.min_m[axis] - from) / way, (self.max_m[axis] - from) / way);
            (enter, leave) = (enter.max(a.min(b)), leave.min(a.max(b)));
        }
        enter < leave
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BOX: BodyConfig = BodyConfig { x_m_min: -1.0, x_m_max: 3.5, y_m_min: -1.0, y_m_max: 1.0, z_m_max: 1.5 };

    #[test]
    fn the_vehicle_hides_what_is_on_it_and_what_is_behind_it() {
        let roof = Body::new(&BOX, [0.0, 0.0, 2.0]);
        assert_eq!(roof.hides([3.0, 0.5, 1.0]), Some(Hidden::OwnBody), "the bonnet");
        assert_eq!(roof.hides([3.4, 0.0, -0.3]), Some(Hidden::OwnBody), "a ghost under the engine");
        assert_eq!(roof.hides([5.0, 0.0, 0.0]), Some(Hidden::ThroughBody), "the ray passes the bonnet's edge");
        assert_eq!(roof.hides([20.0, 0.0, 0.0]), None, "over the bonnet");
        assert_eq!(roof.hides([0.0, 10.0, 0.0]), None);
        assert_eq!(roof.hides([0.0, 1.2, 0.0]), Some(Hidden::ThroughBody));
        let side = Body::new(&BOX, [0.0, 1.1, 1.0]);
        assert_eq!(side.hides([0.0, 8.0, 0.0]), None);
        assert_eq!(side.hides([0.0, -8.0, 1.0]), Some(Hidden::ThroughBody), "across the vehicle");
        assert_eq!(side.hides([10.0, 1.1, 1.0]), None, "along its side");
        let bumper = Body::new(&BOX, [3.4, 0.0, 0.5]);
        assert_eq!(bumper.hides([9.0, 0.0, 0.0]), None, "a sensor inside sees out");
    }
}

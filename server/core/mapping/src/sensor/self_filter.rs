//! What one sensor sees that is none of the surroundings: the vehicle's own box, what is seen through it, blind
//! sectors.
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
    /// It lies in a sector that the configuration calls blind.
    Blind,
}

/// All that hides returns of one sensor.
#[derive(Clone, Debug, PartialEq)]
pub struct Screen {
    body: Option<Body>,
    blind: Vec<Sector>,
}

impl Screen {
    /// For a sensor at `sensor_m`, ego frame, with these blind sectors ([`crate::config::SensorConfig::blind_deg`]);
    /// `None` where nothing hides anything.
    pub fn new(body: Option<&BodyConfig>, sensor_m: [f32; 3], blind_deg: &[[f32; 2]]) -> Option<Self> {
        let body = body.map(|body| Body::new(body, sensor_m));
        let blind: Vec<_> = blind_deg.iter().map(|ends| Sector::new(*ends)).collect();
        (body.is_some() || !blind.is_empty()).then_some(Self { body, blind })
    }

    /// What hides a return at `point_m` in the sensor's frame, which is `in_ego` in the ego frame, if anything does.
    #[inline(always)]
    pub fn hides(&self, point_m: [f32; 3], in_ego: impl FnOnce() -> [f32; 3]) -> Option<Hidden> {
        if self.blinds(point_m) {
            return Some(Hidden::Blind);
        }
        self.body.and_then(|body| body.hides(in_ego()))
    }

    /// Whether a direction, sensor's frame, lies in a blind sector.
    pub fn blinds(&self, direction: [f32; 3]) -> bool {
        self.blind.iter().any(|sector| sector.holds(direction))
    }
}

/// A sector of directions in the sensor's xy plane.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Sector {
    from: [f32; 2],
    to: [f32; 2],
    /// More than half of all directions.
    wide: bool,
}

impl Sector {
    /// Degrees clockwise from x seen from above.
    fn new([from_deg, to_deg]: [f32; 2]) -> Self {
        let ray = |deg: f32| [deg.to_radians().cos(), -deg.to_radians().sin()];
        Self { from: ray(from_deg), to: ray(to_deg), wide: (to_deg - from_deg).rem_euclid(360.0) > 180.0 }
    }

    fn holds(&self, [x, y, _]: [f32; 3]) -> bool {
        let right_of = |[rx, ry]: [f32; 2]| rx * y - ry * x <= 0.0;
        let left_of = |[rx, ry]: [f32; 2]| rx * y - ry * x >= 0.0;
        if self.wide { right_of(self.from) || left_of(self.to) } else { right_of(self.from) && left_of(self.to) }
    }
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
        let slabs = self.min_m.iter().zip(&self.max_m);
        for ((&from, &to), (&min, &max)) in self.sensor_m.iter().zip(&point_m).zip(slabs) {
            let way = to - from;
            if way == 0.0 {
                if !(min..=max).contains(&from) {
                    return false;
                }
                continue;
            }
            let (a, b) = ((min - from) / way, (max - from) / way);
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
    fn a_blind_sector_runs_clockwise_from_its_first_angle_to_its_second() {
        let at = |deg: f32| [10.0 * deg.to_radians().cos(), -10.0 * deg.to_radians().sin(), 1.0];
        for (from, to) in [(80.0, 100.0), (350.0, 10.0), (30.0, 330.0), (0.0, 180.0)] {
            let screen = Screen::new(None, [0.0; 3], &[[from, to]]).unwrap();
            for deg in (0..360).map(|deg| deg as f32 + 0.5) {
                let inside = if from < to { from < deg && deg < to } else { from < deg || deg < to };
                assert_eq!(screen.hides(at(deg), || [0.0; 3]).is_some(), inside, "{deg} in {from} to {to}");
            }
        }
        assert_eq!(Screen::new(None, [0.0; 3], &[]), None);
    }

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

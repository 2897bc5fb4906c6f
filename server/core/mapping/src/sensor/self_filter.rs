//! The self filter: removes returns that do not belong to the surroundings.
//!
//! In: a return and the position of its sensor, ego frame at the time of the firing, metres. Out: the reason to remove
//! it, if there is one: it lies on the vehicle, its ray crosses the vehicle, or it lies in a blind sector. A ray that
//! crosses the vehicle was reflected by its paint or glass, and its return is a mirror image.

use serde::{Deserialize, Serialize};

use crate::value_check::{ConfigValueError, check};

/// The box around the vehicle, ego frame; the table `[vehicle.body]`. It has no lower end: what is under the vehicle
/// belongs to it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BodyConfig {
    /// Rear end, metres forward of the ego origin.
    pub x_m_min: f32,
    /// Front end, metres forward of the ego origin.
    pub x_m_max: f32,
    /// Right side, metres to the left of the ego origin.
    pub y_m_min: f32,
    /// Left side, metres to the left of the ego origin.
    pub y_m_max: f32,
    /// Top, metres over the ground.
    pub z_m_max: f32,
}

impl BodyConfig {
    pub(crate) fn validate(&self) -> Result<(), ConfigValueError> {
        let at = |key: &str| format!("vehicle.body.{key}");
        for (key, value) in
            [("x_m_min", self.x_m_min), ("x_m_max", self.x_m_max), ("y_m_min", self.y_m_min), ("y_m_max", self.y_m_max)]
        {
            check(f64::from(value), -20.0..=20.0, || at(key), "-20 to 20")?;
        }
        check(f64::from(self.z_m_max), 0.0..=20.0, || at("z_m_max"), "0 to 20")?;
        for (key, least, most) in [("x_m_max", self.x_m_min, self.x_m_max), ("y_m_max", self.y_m_min, self.y_m_max)] {
            if least >= most {
                return Err(ConfigValueError::new(at(key), most, "more than the one before"));
            }
        }
        Ok(())
    }
}

/// Why the self filter removes a return.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FilterReason {
    /// The return lies on or in the vehicle.
    OwnBody,
    /// The ray of the return crosses the vehicle.
    ThroughBody,
    /// The return lies in a blind sector of the configuration.
    Blind,
}

/// Number of points that were removed from one scan, without those nearer than the sensor's least range.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RemovedPoints {
    /// Points with a coordinate that is not finite, or beyond any sensor's reach.
    pub no_position: u64,
    /// Returns on or in the vehicle.
    pub own_body: u64,
    /// Returns whose ray crosses the vehicle.
    pub through_body: u64,
    /// Returns in a blind sector.
    pub blind: u64,
}

impl RemovedPoints {
    /// Counts one return with the filter's decision.
    #[inline(always)]
    pub(crate) fn count(&mut self, reason: Option<FilterReason>) {
        self.own_body += u64::from(reason == Some(FilterReason::OwnBody));
        self.through_body += u64::from(reason == Some(FilterReason::ThroughBody));
        self.blind += u64::from(reason == Some(FilterReason::Blind));
    }
}

/// The self filter of one sensor.
#[derive(Clone, Debug, PartialEq)]
pub struct SelfFilter {
    body: Option<Body>,
    blind: Vec<Sector>,
}

impl SelfFilter {
    /// The filter of a sensor at `sensor_m`, ego frame, metres, with these blind sectors
    /// ([`crate::sensor::config::SensorConfig::blind_deg`]); `None` if there is nothing to filter.
    pub fn new(body: Option<&BodyConfig>, sensor_m: [f32; 3], blind_deg: &[[f32; 2]]) -> Option<Self> {
        let body = body.map(|body| Body::new(body, sensor_m));
        let blind: Vec<_> = blind_deg.iter().map(|ends| Sector::new(*ends)).collect();
        (body.is_some() || !blind.is_empty()).then_some(Self { body, blind })
    }

    /// The reason to remove a return at `point_m`, sensor frame, which is `in_ego()` in the ego frame; `None` if it
    /// stays.
    #[inline(always)]
    pub fn check(&self, point_m: [f32; 3], in_ego: impl FnOnce() -> [f32; 3]) -> Option<FilterReason> {
        if self.is_blind(point_m) {
            return Some(FilterReason::Blind);
        }
        self.body.and_then(|body| body.check(in_ego()))
    }

    /// True if a direction, sensor frame, lies in a blind sector.
    pub fn is_blind(&self, direction: [f32; 3]) -> bool {
        self.blind.iter().any(|sector| sector.contains(direction))
    }
}

/// A sector of directions in the xy plane of the sensor frame.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Sector {
    from: [f32; 2],
    to: [f32; 2],
    /// True if the sector is wider than 180 degrees.
    is_wide: bool,
}

impl Sector {
    /// The sector between two angles, degrees clockwise from x seen from above.
    fn new([from_deg, to_deg]: [f32; 2]) -> Self {
        let ray = |deg: f32| [libm::cosf(deg.to_radians()), -libm::sinf(deg.to_radians())];
        Self { from: ray(from_deg), to: ray(to_deg), is_wide: (to_deg - from_deg).rem_euclid(360.0) > 180.0 }
    }

    fn contains(&self, [x, y, _]: [f32; 3]) -> bool {
        let right_of = |[rx, ry]: [f32; 2]| rx * y - ry * x <= 0.0;
        let left_of = |[rx, ry]: [f32; 2]| rx * y - ry * x >= 0.0;
        if self.is_wide { right_of(self.from) || left_of(self.to) } else { right_of(self.from) && left_of(self.to) }
    }
}

/// The box around the vehicle, as one sensor sees it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Body {
    min_m: [f32; 3],
    max_m: [f32; 3],
    sensor_m: [f32; 3],
    /// True if the sensor is inside the box: then all its rays leave the box, and none counts as crossing it.
    sensor_inside: bool,
}

impl Body {
    /// The box as seen from `sensor_m`, ego frame, metres. The box has no lower end: no ray passes under the vehicle.
    pub fn new(config: &BodyConfig, sensor_m: [f32; 3]) -> Self {
        let min_m = [config.x_m_min, config.y_m_min, f32::NEG_INFINITY];
        let max_m = [config.x_m_max, config.y_m_max, config.z_m_max];
        let mut body = Self { min_m, max_m, sensor_m, sensor_inside: false };
        body.sensor_inside = body.contains(sensor_m);
        body
    }

    /// The reason to remove a return at `point_m`, ego frame, metres; `None` if it stays.
    pub fn check(&self, point_m: [f32; 3]) -> Option<FilterReason> {
        if self.contains(point_m) {
            Some(FilterReason::OwnBody)
        } else if !self.sensor_inside && self.crosses(point_m) {
            Some(FilterReason::ThroughBody)
        } else {
            None
        }
    }

    fn contains(&self, point_m: [f32; 3]) -> bool {
        (0..3).all(|axis| (self.min_m[axis]..=self.max_m[axis]).contains(&point_m[axis]))
    }

    /// True if the line from the sensor to the point crosses the box: its shares within the three slabs overlap.
    fn crosses(&self, point_m: [f32; 3]) -> bool {
        let (mut enter, mut leave) = (0.0f32, 1.0f32);
        let slabs = self.min_m.iter().zip(&self.max_m);
        for ((&from, &to), (&min, &max)) in self.sensor_m.iter().zip(&point_m).zip(slabs) {
            let length = to - from;
            if length == 0.0 {
                if !(min..=max).contains(&from) {
                    return false;
                }
                continue;
            }
            let (a, b) = ((min - from) / length, (max - from) / length);
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
        let at = |deg: f32| [10.0 * libm::cosf(deg.to_radians()), -10.0 * libm::sinf(deg.to_radians()), 1.0];
        for (from, to) in [(80.0, 100.0), (350.0, 10.0), (30.0, 330.0), (0.0, 180.0)] {
            let filter = SelfFilter::new(None, [0.0; 3], &[[from, to]]).unwrap();
            for deg in (0..360).map(|deg| deg as f32 + 0.5) {
                let inside = if from < to { from < deg && deg < to } else { from < deg || deg < to };
                assert_eq!(filter.check(at(deg), || [0.0; 3]).is_some(), inside, "{deg} in {from} to {to}");
            }
        }
        assert_eq!(SelfFilter::new(None, [0.0; 3], &[]), None);
    }

    #[test]
    fn returns_on_the_vehicle_and_through_it_are_removed() {
        let roof = Body::new(&BOX, [0.0, 0.0, 2.0]);
        assert_eq!(roof.check([3.0, 0.5, 1.0]), Some(FilterReason::OwnBody), "the bonnet");
        assert_eq!(roof.check([3.4, 0.0, -0.3]), Some(FilterReason::OwnBody), "a ghost under the engine");
        assert_eq!(roof.check([5.0, 0.0, 0.0]), Some(FilterReason::ThroughBody), "the ray passes the bonnet's edge");
        assert_eq!(roof.check([20.0, 0.0, 0.0]), None, "over the bonnet");
        assert_eq!(roof.check([0.0, 10.0, 0.0]), None);
        assert_eq!(roof.check([0.0, 1.2, 0.0]), Some(FilterReason::ThroughBody));
        let side = Body::new(&BOX, [0.0, 1.1, 1.0]);
        assert_eq!(side.check([0.0, 8.0, 0.0]), None);
        assert_eq!(side.check([0.0, -8.0, 1.0]), Some(FilterReason::ThroughBody), "across the vehicle");
        assert_eq!(side.check([10.0, 1.1, 1.0]), None, "along its side");
        let bumper = Body::new(&BOX, [3.4, 0.0, 0.5]);
        assert_eq!(bumper.check([9.0, 0.0, 0.0]), None, "the sensor is inside the box");
    }
}

//! The table `[vehicle.body]`.

use serde::{Deserialize, Serialize};

use crate::config::check::{ConfigValueError, check};

/// The box around the vehicle, ego frame. It has no lower end: what is under the vehicle belongs to it.
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

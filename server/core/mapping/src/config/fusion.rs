//! The tables `[vehicle.fusion]` and `[vehicle.body]` -> values, checked.

use serde::{Deserialize, Serialize};

use super::{ConfigError, check};

/// Parameters of [`crate::fusion`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FusionConfig {
    /// Name of the sensor whose turns make the maps; empty: the first.
    pub lead: String,
    /// Farther apart from the map's stamp than this, a sensor's newest turn contributes nothing; and a sensor that
    /// gives no turn for so long no longer leads. More than the slowest sensor's turn.
    pub deadline_ms: u32,
    /// Least time between two maps of one lead (a tenth of it is forgiven), for leads that scan faster than maps are
    /// wanted; 0: every turn makes a map.
    pub period_ms: u32,
}

impl Default for FusionConfig {
    fn default() -> Self {
        Self { lead: String::new(), deadline_ms: 200, period_ms: 0 }
    }
}

impl FusionConfig {
    pub(crate) fn validate(&self) -> Result<(), ConfigError> {
        let at = |key: &str| format!("vehicle.fusion.{key}");
        check(f64::from(self.deadline_ms), 10.0..=10_000.0, || at("deadline_ms"), "10 to 10000")?;
        check(f64::from(self.period_ms), 0.0..=10_000.0, || at("period_ms"), "0 to 10000")
    }
}

/// The box that holds the vehicle, ego frame, from the ground (and what is under it) up.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BodyConfig {
    /// Rear end.
    pub x_m_min: f32,
    /// Front end.
    pub x_m_max: f32,
    /// Right side.
    pub y_m_min: f32,
    /// Left side.
    pub y_m_max: f32,
    /// Top over the ground.
    pub z_m_max: f32,
}

impl BodyConfig {
    pub(crate) fn validate(&self) -> Result<(), ConfigError> {
        let at = |key: &str| format!("vehicle.body.{key}");
        for (key, value) in
            [("x_m_min", self.x_m_min), ("x_m_max", self.x_m_max), ("y_m_min", self.y_m_min), ("y_m_max", self.y_m_max)]
        {
            check(f64::from(value), -20.0..=20.0, || at(key), "-20 to 20")?;
        }
        check(f64::from(self.z_m_max), 0.0..=20.0, || at("z_m_max"), "0 to 20")?;
        for (key, least, most) in [("x_m_max", self.x_m_min, self.x_m_max), ("y_m_max", self.y_m_min, self.y_m_max)] {
            if least >= most {
                return Err(ConfigError::new(at(key), most, "more than the one before"));
            }
        }
        Ok(())
    }
}

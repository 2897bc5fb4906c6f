//! The table `[vehicle.fusion]`.

use serde::{Deserialize, Serialize};

use crate::value_check::{ConfigValueError, check};

/// Parameters of [`crate::fusion`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FusionConfig {
    /// Name of the sensor whose scans make the maps. If it is empty, the sensor is chosen when all sensors have
    /// completed a scan, or `deadline_ms` after the first scan: one with known elevations, upright, that sees the most
    /// directions with the most lasers; of equal sensors the first.
    pub reference_sensor: String,
    /// Greatest time between a sensor's newest scan and the map's stamp, ms; an older scan contributes nothing. A
    /// sensor that completes no scan for so long makes no maps until it is back. More than the longest scan of any
    /// sensor.
    pub deadline_ms: u32,
    /// Least time between two maps of one source, ms, with a tolerance of a tenth; for sensors that scan faster than
    /// maps are needed. 0: every scan of the source makes a map.
    pub period_ms: u32,
}

impl Default for FusionConfig {
    /// Ours: the deadline is two revolutions at 10 Hz, so that one lost scan leaves no sensor out.
    fn default() -> Self {
        Self { reference_sensor: String::new(), deadline_ms: 200, period_ms: 0 }
    }
}

impl FusionConfig {
    /// `deadline_ms` in ns.
    pub(crate) fn deadline_ns(&self) -> i64 {
        i64::from(self.deadline_ms) * 1_000_000
    }

    pub(crate) fn validate(&self) -> Result<(), ConfigValueError> {
        let at = |key: &str| format!("vehicle.fusion.{key}");
        check(f64::from(self.deadline_ms), 10.0..=10_000.0, || at("deadline_ms"), "10 to 10000")?;
        check(f64::from(self.period_ms), 0.0..=10_000.0, || at("period_ms"), "0 to 10000")
    }
}

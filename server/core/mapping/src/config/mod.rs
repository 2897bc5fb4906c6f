//! One vehicle's sensors and maps, as the configuration file states them. Keys contain their units; unknown keys are
//! refused.
//!
//! In: the tables of the file. Out: the same as values, checked by [`VehicleConfig::validate`], whose errors name the
//! key, its value and what is allowed. Lengths are in metres. Angles are in degrees here, and in radians in all other
//! modules.
//!
//! | file | table |
//! |---|---|
//! | `vehicle` | `[vehicle]` |
//! | `sensor` | `[[vehicle.sensor]]` |
//! | `time` | `[vehicle.time]` |
//! | `fusion` | `[vehicle.fusion]` |
//! | `body` | `[vehicle.body]` |
//! | `motion` | `[vehicle.maps.motion]` |
//! | [`crate::memory`] | `[vehicle.maps.memory]` |
//! | [`crate::ground`] | `[vehicle.maps.ground]` |
//! | [`crate::reach`] | `[vehicle.maps.reach]` |
//! | [`crate::layer`] | `[vehicle.maps]`, and one table for each layer, in the layer's folder |
//! | `check` | checks of single values, and their error |
//!
//! This module names what other crates use. The files of this crate import from the files of the table, so that none of
//! them depends on a file that uses it.

pub(crate) mod body;
pub(crate) mod check;
pub(crate) mod fusion;
pub(crate) mod motion;
pub(crate) mod sensor;
pub(crate) mod time;
pub(crate) mod vehicle;

pub use body::BodyConfig;
pub use check::ConfigValueError;
pub use fusion::FusionConfig;
pub use motion::MotionConfig;
pub use sensor::{BLIND_MAX, Extrinsics, RINGS_MAX, SensorConfig};
pub use time::TimeConfig;
pub use vehicle::{SENSORS_MAX, VehicleConfig};

pub use crate::ground::config::{GroundConfig, Variant as GroundVariant};
pub use crate::layer::drivability::config::{DrivabilityConfig, DrivabilityVariant, Passage, PlaneTest, Seed};
pub use crate::layer::height_difference::config::HeightDifferenceConfig;
pub use crate::layer::occupancy::config::{Hits, OccupancyConfig, OccupancyVariant};
pub use crate::layer::registry::MapsConfig;
pub use crate::layer::safe_path::config::SafePathConfig;
pub use crate::layer::speed::config::{Bonus, SpeedConfig};
pub use crate::layer::terrain::config::{TerrainConfig, Variant};
pub use crate::memory::config::MemoryConfig;
pub use crate::reach::config::ReachConfig;

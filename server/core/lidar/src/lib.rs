//! From the datagrams of a Velodyne sensor to calibrated revolutions.
//!
//! In: UDP payloads and the times of their arrival. Out: [`Revolution`]s in the sensor's frame (REP-103: x forward at
//! azimuth 0, y left, z up; metres). The crate uses no socket, clock, thread or log: the same datagrams give the same
//! revolutions. Begin with [`Sensor`].
//!
//! The files, in the order of the data:
//!
//! | file | in -> out |
//! |---|---|
//! | [`model`] | the sensor models and their properties |
//! | [`calibration`] | factory tables, ROS YAML, Velodyne XML, status bytes -> per-laser corrections |
//! | [`capture`], [`packet`], [`telemetry`], [`nmea`] (`datagram/`) | captures -> payloads -> packets, telemetry |
//! | [`sensor`] | datagram -> revolution: parse, identify, reorder, decode, cut |
//! | `stream/` | packets -> revolutions: the steps of `sensor` |
//! | [`clock`] (`time/`) | device time, telemetry, arrivals -> stamps |
//! | [`revolution`] | the range image |
//! | `config`, `status` | [`SensorConfig`] and [`SensorStatus`] |

// The core is pure: server/core/clippy.toml lists what it must not use.
#![deny(clippy::disallowed_methods, clippy::disallowed_types)]

pub mod calibration;
mod config;
mod datagram;
pub mod model;
pub mod revolution;
pub mod sensor;
mod status;
mod stream;
mod time;

pub use calibration::{Calibration, CalibrationError, LaserCalibration};
pub use config::SensorConfig;
pub use datagram::{DatagramError, capture, capture_sensor, nmea, packet, telemetry};
pub use model::{Model, ModelSpec, ReturnMode};
pub use revolution::{Blocked, BlockedSector, Echo, Firing, Partial, Point, Revolution};
pub use sensor::Sensor;
pub use status::{CalibrationSource, SensorStatus};
pub use time::clock::{self, Clock};

//! Velodyne datagrams to calibrated revolutions.
//!
//! In: UDP payloads with the stamp of their arrival. Out: [`Revolution`]s in the sensor's frame (REP-103: x forward
//! at azimuth 0, y left, z up; metres). No socket, clock, thread or log: the same datagrams give the same revolutions.
//!
//! The files, in the order the data flows:
//!
//! | file | in -> out |
//! |---|---|
//! | [`capture`] | pcap or pcapng file -> UDP payloads |
//! | [`model`] | the sensors and their nominal figures |
//! | [`calibration`] | factory tables, ROS YAML, Velodyne XML -> per-laser corrections |
//! | [`packet`] | 1206 bytes -> [`packet::Packet`], or [`Refusal`] |
//! | [`telemetry`] | 512 bytes -> [`telemetry::Telemetry`] |
//! | `identify` | packet -> model |
//! | [`sensor`] | the door: datagram in, revolution out |
//! | `order` | packets as they arrive -> in the order they were sent, without copies |
//! | `decoder` | packets of a known model -> revolutions, by way of the next nine |
//! | `unit_clock` | status bytes of an HDL-64E -> what telemetry would say |
//! | `timeline` | device microseconds past the hour -> one timeline |
//! | [`clock`] | timeline, telemetry, arrival -> stamps |
//! | `firing` | packet -> firings |
//! | `turns` | firings -> cuts, gaps, reversals |
//! | `loss` | packets missing -> packets lost |
//! | `beam` | raw returns -> corrected points |
//! | [`revolution`] | the range image |
//! | [`blocked`] | revolutions -> sectors and lasers that see nothing any more |

mod beam;
pub mod blocked;
pub mod calibration;
pub mod capture;
pub mod clock;
mod decoder;
mod firing;
mod identify;
mod loss;
pub mod model;
mod order;
pub mod packet;
pub mod revolution;
pub mod sensor;
pub mod telemetry;
mod timeline;
mod turns;
mod unit_clock;

pub use blocked::{Blocked, BlockedSector};
pub use calibration::{Calibration, CalibrationError, LaserCalibration};
pub use clock::{Clock, GPS_LATE_NS_MAX};
pub use model::{Model, ModelSpec, ReturnMode};
pub use packet::Refusal;
pub use revolution::{Echo, Firing, Partial, Point, Revolution};
pub use sensor::{CalibrationSource, Sensor, SensorConfig, SensorStatus};

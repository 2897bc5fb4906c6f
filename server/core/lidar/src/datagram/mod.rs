//! The datagrams of a sensor: how they are read from a capture, and how their bytes are parsed.
//!
//! | file | in -> out |
//! |---|---|
//! | [`capture`] | pcap or pcapng file -> UDP payloads |
//! | [`capture_sensor`] | the datagrams of a capture -> the datagrams of one sensor |
//! | [`packet`] | payload of 1206 bytes -> `Packet`, read in place |
//! | [`telemetry`] | payload of 512 bytes -> `Telemetry` |
//! | [`nmea`] | one GPRMC sentence -> `Gprmc` |
//! | `error` | the reasons for which a datagram is refused |

pub mod capture;
pub mod capture_sensor;
mod error;
pub mod nmea;
pub mod packet;
pub mod telemetry;

pub use error::DatagramError;

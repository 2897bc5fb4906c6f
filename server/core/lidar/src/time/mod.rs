//! The time of a sensor: from device time, telemetry and arrivals to stamps in Unix time.
//!
//! | file | in -> out |
//! |---|---|
//! | `timeline` | device time in microseconds past the hour -> one timeline without jumps |
//! | `minimum_delay` | arrival less device time of every packet -> the least of a revolution |
//! | `gps` | telemetry -> the newest valid GPRMC, and whether it is trusted |
//! | `status_clock` | status bytes of an HDL-64E -> the telemetry that they replace |
//! | [`clock`] | timeline, telemetry, arrivals -> stamps of a revolution, and the clock that they follow |

pub mod clock;
pub(crate) mod gps;
mod minimum_delay;
pub(crate) mod status_clock;
mod timeline;

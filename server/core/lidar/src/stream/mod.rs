//! The stream of packets of one sensor: from packets to revolutions.
//!
//! | file | in -> out |
//! |---|---|
//! | `identify` | packet -> model, or the return mode of a packet of a known model |
//! | `order` | packets in order of arrival -> packets in order of sending, without copies |
//! | `decoder` | ordered packets of a known model -> revolutions; it uses the files below |
//! | `packet_firings` | packet -> azimuths of its firings |
//! | `cut` | azimuths -> where a revolution ends, gaps, reversals |
//! | `loss` | missing packets -> lost packets, field-of-view gap |
//! | `points` | raw returns -> corrected points |
//! | `status_bytes` | status bytes of an HDL-64E -> telemetry, model, corrections |
//! | `blocked_detector` | revolutions -> blocked sectors and lasers |
//! | `azimuth` | differences between azimuths |

mod azimuth;
mod blocked_detector;
mod cut;
pub(crate) mod decoder;
pub(crate) mod identify;
mod loss;
pub(crate) mod order;
mod packet_firings;
mod points;
mod status_bytes;

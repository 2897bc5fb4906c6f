//! Where scans come from whose truth is known.
//!
//! | file | in -> out |
//! |---|---|
//! | [`pairs`] | paths -> scans with their labels |
//! | [`labels`] | labels -> the truth about the points of a scan |
//! | [`objects`] | labelled scans with objects cut into them -> counts |
//! | `one_sensor` | extrinsics of a sensor -> a pipeline; a scan -> its map |
//! | [`variation`] | a scan -> the same scan of a bent or rolled world, with fewer lasers, from another place |
//! | [`scans`] | labelled scans and their variations -> counts |
//! | [`written`] | a varied scan and its truth -> files for other programs |
//! | [`worlds`] | a simulated scene -> maps, and the truth about their points |
//! | [`random`] | seeds -> counts by type of world |

pub mod labels;
pub mod objects;
mod one_sensor;
pub mod pairs;
pub mod random;
pub mod scans;
pub mod variation;
pub mod worlds;
pub mod written;

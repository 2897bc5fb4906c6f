//! Where scans come from whose truth is known.
//!
//! | file | in -> out |
//! |---|---|
//! | [`pairs`] | paths -> scans with their labels |
//! | [`labels`] | labels -> the truth about the points of a scan |
//! | [`variation`] | a scan -> the same scan of a bent or rolled world, with fewer lasers, from another place |
//! | [`scans`] | labelled scans and their variations -> counts |
//! | [`written`] | a varied scan and its truth -> files for other programs |
//! | [`argoverse`] | a log of Argoverse 2 -> counts |
//! | [`worlds`] | a simulated scene -> maps, and the truth about their points |
//! | [`random`] | seeds -> counts by type of world |
//! | [`setup`] | sensor and maps -> a pipeline |

pub mod argoverse;
pub mod labels;
pub mod pairs;
#[cfg(feature = "sim")]
pub mod random;
pub mod scans;
pub mod setup;
pub mod variation;
#[cfg(feature = "sim")]
pub mod worlds;
pub mod written;

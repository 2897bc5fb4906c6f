//! Roads: checked when they arrive, kept until the next one, and transformed into the ego frame of each map.
//!
//! In: [`crate::event::Road`] events, or the text of a route or lane file. Out: points and widths for
//! [`crate::layer::speed`]. A road is one strip; the newest road of each purpose is used.
//!
//! | file | in -> out |
//! |---|---|
//! | [`check`](check()) | road -> error, if a value is not allowed |
//! | `store` | checked roads -> the newest of each purpose, in the ego frame of a map |
//! | [`rddf`] | route file -> waypoints -> road |
//! | [`rndf`] | lane file -> lanes -> roads |
//! | `line` | field of a line -> number, or why the line is left out |
//! | `local_frame` | latitude and longitude -> metres |

mod check;
mod line;
mod local_frame;
pub mod rddf;
pub mod rndf;
mod store;

pub use check::{POINTS_MAX, RoadError, check};
pub use line::{FOOT_M, LineError};
pub use local_frame::LocalFrame;
pub use store::{Roads, StoredRoad};

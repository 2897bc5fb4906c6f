//! Roads: checked when they arrive, kept until the next one, and transformed into the ego frame of each map.
//!
//! In: [`Road`] events, or the text of a route or lane file. Out: points and widths for
//! the layer `speed`. A road is one strip; the newest road of each purpose is used.
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

/// A road: points along its middle, and its width at each. [`check`](check()) states what is allowed.
#[derive(Clone, Debug, PartialEq)]
pub struct Road {
    /// Time at which the road was seen or read, ns since the Unix epoch. The points are in the ego frame of this stamp.
    pub stamp_ns: i64,
    /// What the road is used for.
    pub purpose: RoadPurpose,
    /// Frame of the points.
    pub frame: RoadFrame,
    /// Points x, y, metres, in driving order.
    pub points: Vec<[f64; 2]>,
    /// Whole width at each point, metres.
    pub widths_m: Vec<f64>,
    /// Votes for each dominant orientation in the detector's image; empty if the road was not found in an image.
    pub orientations: Vec<f32>,
    /// Speed limit from each point to the next one, m/s; 0: no limit. Empty if the road has no limits.
    pub speed_limits_mps: Vec<f64>,
}

/// What a road is used for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RoadPurpose {
    /// A detected road or a lane: it is painted into the speed map, and replaces the road before.
    Paint,
    /// The centre line of the route (RDDF): it is never painted. Its curvature shows where a detector fails; its width
    /// is the corridor in which roads are painted; its limits cap the speed.
    Route,
}

/// Frame of a road's points.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RoadFrame {
    /// The ego frame at the road's stamp.
    Ego,
    /// The locally fixed world frame. The road is not used until an ego pose is known.
    Map,
}

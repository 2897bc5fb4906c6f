//! What the planner and the follower share: the vehicle, its limits, its move and its pose.

use clearway_client::MapView;

/// Greatest speed in m/s.
pub const MPS_MAX: f64 = 8.0;
/// Greatest braking and lateral acceleration in m/s².
pub const BRAKE_MPS2: f64 = 4.0;
/// Greatest curvature in 1/m.
pub const CURVATURE_MAX: f64 = 0.2;

/// A point, in metres.
pub type Point = [f64; 2];

/// What the vehicle should do until the next map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Move {
    /// Curvature of the arc to follow in 1/m, positive to the left.
    pub curvature_per_m: f64,
    /// Speed in m/s; 0 if there is no path.
    pub mps: f64,
    /// Length of the path towards the goal, in metres.
    pub path_m: f64,
}

/// Where the vehicle was at the end of a map's scan: x and y in metres, heading in radians; `None` if it is not known.
pub fn ego_pose(map: &MapView) -> Option<[f64; 3]> {
    let p = map.header().map_from_ego.as_ref()?;
    Some([p.x, p.y, f64::atan2(2.0 * (p.qw * p.qz + p.qx * p.qy), 1.0 - 2.0 * (p.qy * p.qy + p.qz * p.qz))])
}

/// A point of the frame of the poses, in the ego frame of this pose.
pub fn in_ego(ego: [f64; 3], [x, y]: Point) -> Point {
    let ([dx, dy], (sin, cos)) = ([x - ego[0], y - ego[1]], ego[2].sin_cos());
    [dx * cos + dy * sin, dy * cos - dx * sin]
}

/// Distance between two points, in metres.
pub fn distance(a: Point, b: Point) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

//! A planner's [`Plan`] -> whether it can be recorded and drawn, and the plan in the ego frame of a map.

use crate::limits::{
    PLAN_AHEAD_NS_MAX, PLAN_CORNERS_MAX, PLAN_DRAWN_NS_MAX, PLAN_POINTS_MAX, PLAN_TEXT_BYTES_MAX, PLANNER_BYTES_MAX,
};
use crate::v1::{Plan, PlanFrame, PlanGoal, Pose};

/// Greatest number of a plan, such as a position in metres. Ours: a map's frame may lie at the middle of the Earth.
const NUMBER_MAX: f64 = 1e9;
/// Half the width of the cross at a goal, in metres. Ours.
const GOAL_M: f64 = 0.75;

/// Why a plan is refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PlanError {
    /// The bytes are not a plan.
    #[error("not a clearway.v1.Plan: {reason}")]
    Message {
        /// Error of the protobuf decoder.
        reason: String,
    },
    /// The plan is of another vehicle than its key states.
    #[error("plan of vehicle {vehicle:?}: {expected:?} or none is allowed")]
    Vehicle {
        /// The vehicle in the plan.
        vehicle: String,
        /// The vehicle in the key.
        expected: String,
    },
    /// The frame is unknown, or not stated.
    #[error("frame {frame}: PLAN_FRAME_EGO (1) and PLAN_FRAME_MAP (2) are allowed")]
    Frame {
        /// Number of the frame.
        frame: i32,
    },
    /// The path has no point, or too many.
    #[error("path of {points} points: 1 to {PLAN_POINTS_MAX} are allowed")]
    Points {
        /// Number of points.
        points: usize,
    },
    /// A list does not have a number for each point of the path.
    #[error("{list} of {count} numbers: one for each of the {points} points is allowed")]
    List {
        /// Field of the list, as in `clearway.v1.Plan`.
        list: &'static str,
        /// Number of numbers.
        count: usize,
        /// Number of points of the path.
        points: usize,
    },
    /// The footprint is no polygon.
    #[error("footprint_m of {count} numbers: none, or x and y of 3 to {PLAN_CORNERS_MAX} corners are allowed")]
    Footprint {
        /// Number of numbers.
        count: usize,
    },
    /// A number is NaN, infinite, or greater than any place on the Earth.
    #[error("{field}[{index}] is {value}: finite numbers up to 1e9 are allowed")]
    NotDrawable {
        /// Field with the number, as in `clearway.v1.Plan`.
        field: &'static str,
        /// Index of the number.
        index: usize,
        /// The number that cannot be drawn.
        value: f64,
    },
    /// The quaternion of `map_from_ego` has another length than 1.
    #[error("map_from_ego with a quaternion of length {length}: 1 is allowed")]
    Quaternion {
        /// Length of the quaternion.
        length: f64,
    },
    /// The name of the planner or the text is too long.
    #[error("{field} of {bytes} bytes: up to {bytes_max} are allowed")]
    Length {
        /// Field with the text, as in `clearway.v1.Plan`.
        field: &'static str,
        /// Length of the text, in bytes.
        bytes: usize,
        /// Greatest length in bytes.
        bytes_max: usize,
    },
    /// The stamp is in the future.
    #[error(
        "stamp {stamp_ns} ns: {} ms ahead of the clock; up to {} ms are allowed",
        .ahead_ns / 1_000_000,
        PLAN_AHEAD_NS_MAX / 1_000_000
    )]
    StampAhead {
        /// The stamp, ns since the Unix epoch.
        stamp_ns: i64,
        /// Time by which it is ahead, ns.
        ahead_ns: i64,
    },
}

/// Checks a plan that is sent at `now_ns`, in ns since the Unix epoch.
///
/// # Errors
/// The first [`PlanError`] but `Message` and `Vehicle`, which concern how the plan came.
pub fn check(plan: &Plan, now_ns: i64) -> Result<(), PlanError> {
    if PlanFrame::try_from(plan.frame).unwrap_or_default() == PlanFrame::Unspecified {
        return Err(PlanError::Frame { frame: plan.frame });
    }
    let points = plan.x.len();
    if !(1..=PLAN_POINTS_MAX).contains(&points) {
        return Err(PlanError::Points { points });
    }
    for (list, count, may_lack) in [("y", plan.y.len(), false), ("heading_rad", plan.heading_rad.len(), true)] {
        if count != points && !(may_lack && count == 0) {
            return Err(PlanError::List { list, count, points });
        }
    }
    let count = plan.footprint_m.len();
    if count > 0 && !(count.is_multiple_of(2) && (3..=PLAN_CORNERS_MAX).contains(&(count / 2))) {
        return Err(PlanError::Footprint { count });
    }
    check_numbers(plan)?;
    let texts = [("planner", &plan.planner, PLANNER_BYTES_MAX), ("text", &plan.text, PLAN_TEXT_BYTES_MAX)];
    if let Some((field, text, bytes_max)) = texts.into_iter().find(|(_, text, bytes_max)| text.len() > *bytes_max) {
        return Err(PlanError::Length { field, bytes: text.len(), bytes_max });
    }
    let ahead_ns = plan.stamp_ns.saturating_sub(now_ns);
    match ahead_ns > PLAN_AHEAD_NS_MAX {
        true => Err(PlanError::StampAhead { stamp_ns: plan.stamp_ns, ahead_ns }),
        false => Ok(()),
    }
}

fn check_numbers(plan: &Plan) -> Result<(), PlanError> {
    let goal = plan.goal.map_or([0.0; 2], |goal| [goal.x, goal.y]);
    let pose =
        plan.map_from_ego.map_or([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], |p| [p.x, p.y, p.z, p.qx, p.qy, p.qz, p.qw]);
    let fields: [(_, &[f64]); 6] = [
        ("x", &plan.x),
        ("y", &plan.y),
        ("heading_rad", &plan.heading_rad),
        ("footprint_m", &plan.footprint_m),
        ("goal", &goal),
        ("map_from_ego", &pose),
    ];
    for (field, numbers) in fields {
        // A range contains no NaN.
        if let Some(index) = numbers.iter().position(|number| !(-NUMBER_MAX..=NUMBER_MAX).contains(number)) {
            return Err(PlanError::NotDrawable { field, index, value: numbers[index] });
        }
    }
    let length = pose[3..].iter().map(|number| number * number).sum::<f64>().sqrt();
    if (length - 1.0).abs() > 0.01 { Err(PlanError::Quaternion { length }) } else { Ok(()) }
}

/// A plan that was checked, in the ego frame of a map with this stamp and pose, with a heading for each point; `None`
/// if the stamps differ by more than [`PLAN_DRAWN_NS_MAX`], or if a plan in the world frame has no place in a map
/// without a pose.
pub fn over(plan: &Plan, capture_end_ns: i64, map_from_ego: Option<&Pose>) -> Option<Plan> {
    if capture_end_ns.abs_diff(plan.stamp_ns) > PLAN_DRAWN_NS_MAX.unsigned_abs() {
        return None;
    }
    let ego = map_from_ego.map(Planar::of);
    let move_by = match (plan.frame(), plan.map_from_ego.as_ref().map(Planar::of), ego) {
        (PlanFrame::Map, _, Some(ego)) => Planar::default().seen_from(ego),
        (PlanFrame::Ego, Some(from), Some(ego)) if plan.stamp_ns != capture_end_ns => from.seen_from(ego),
        (PlanFrame::Ego, ..) => Planar::default(),
        (PlanFrame::Map, _, None) | (PlanFrame::Unspecified, ..) => return None,
    };
    let mut moved = Plan { frame: PlanFrame::Ego.into(), map_from_ego: map_from_ego.copied(), ..plan.clone() };
    moved.heading_rad = headings(plan).into_iter().map(|heading| heading + move_by.yaw).collect();
    for (x, y) in moved.x.iter_mut().zip(&mut moved.y) {
        (*x, *y) = move_by.apply(*x, *y);
    }
    if let Some(goal) = &mut moved.goal {
        (goal.x, goal.y) = move_by.apply(goal.x, goal.y);
    }
    Some(moved)
}

/// The heading at each point of a plan's path: as sent, or along the path.
pub fn headings(plan: &Plan) -> Vec<f64> {
    if !plan.heading_rad.is_empty() {
        return plan.heading_rad.clone();
    }
    let mut heading = 0.0;
    let points: Vec<_> = plan.x.iter().zip(&plan.y).collect();
    let mut headings: Vec<f64> = Vec::with_capacity(points.len());
    for ends in points.windows(2) {
        let (dx, dy) = (ends[1].0 - ends[0].0, ends[1].1 - ends[0].1);
        if (dx, dy) != (0.0, 0.0) {
            heading = dy.atan2(dx);
        }
        headings.push(heading);
    }
    headings.push(heading);
    headings
}

/// The corners of a plan's footprint at the end of its path, in the frame of the path; empty without a footprint.
pub fn footprint_at_end(plan: &Plan) -> Vec<[f64; 2]> {
    let (Some(&x), Some(&y)) = (plan.x.last(), plan.y.last()) else { return Vec::new() };
    let end = Planar { x, y, yaw: headings(plan).last().copied().unwrap_or_default() };
    plan.footprint_m.as_chunks::<2>().0.iter().map(|&[x, y]| end.apply(x, y).into()).collect()
}

/// What is drawn of a plan, as straight lines in the frame of its path: the path, the footprint at its end, and a cross
/// at the goal.
pub fn lines(plan: &Plan) -> Vec<[[f64; 2]; 2]> {
    let path: Vec<_> = plan.x.iter().zip(&plan.y).map(|(&x, &y)| [x, y]).collect();
    let mut corners = footprint_at_end(plan);
    corners.extend(corners.first().copied());
    let mut lines: Vec<_> =
        [path, corners].iter().flat_map(|of| of.windows(2).map(|ends| [ends[0], ends[1]])).collect();
    if let Some(PlanGoal { x, y }) = plan.goal {
        lines.extend([-GOAL_M, GOAL_M].map(|m| [[x - GOAL_M, y - m], [x + GOAL_M, y + m]]));
    }
    lines
}

/// A rigid motion in the ground plane.
#[derive(Clone, Copy, Debug, Default)]
struct Planar {
    x: f64,
    y: f64,
    yaw: f64,
}

impl Planar {
    fn of(pose: &Pose) -> Self {
        let Pose { x, y, qx, qy, qz, qw, .. } = *pose;
        let yaw = (2.0 * (qw * qz + qx * qy)).atan2(1.0 - 2.0 * (qy * qy + qz * qz));
        Self { x, y, yaw }
    }

    fn apply(self, x: f64, y: f64) -> (f64, f64) {
        let (sin, cos) = self.yaw.sin_cos();
        (self.x + cos * x - sin * y, self.y + sin * x + cos * y)
    }

    /// This motion after the inverse of `other`.
    fn seen_from(self, other: Self) -> Self {
        let (sin, cos) = other.yaw.sin_cos();
        let (dx, dy) = (self.x - other.x, self.y - other.y);
        Self { x: cos * dx + sin * dy, y: cos * dy - sin * dx, yaw: self.yaw - other.yaw }
    }
}

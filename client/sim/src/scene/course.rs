//! A course, made of straights and arcs, and a drive along it.
//!
//! Out: place and heading in the world frame as functions of the time, in closed form, so that any time can be computed
//! by itself.

use std::f64::consts::TAU;
use std::sync::Arc;

/// Bend, in rad, below which the chord is as long as the arc: the difference of two sines has too few digits there, and
/// none at all on an arc of 1e16 m.
const BEND_MIN: f64 = 1e-6;

/// One stretch of constant curvature.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Stretch {
    station: f64,
    x: f64,
    y: f64,
    heading: f64,
    curvature: f64,
}

/// A line on the ground, made of straights and arcs that join without a bend; closed courses repeat for ever.
#[derive(Clone, Debug, PartialEq)]
pub struct Course {
    stretches: Vec<Stretch>,
    length: f64,
    closed: bool,
}

impl Course {
    /// A course that begins at (x, y) with this heading (rad, counter-clockwise from x) and has no length yet.
    pub fn from(x: f64, y: f64, heading: f64) -> Self {
        let start = Stretch { station: 0.0, x, y, heading, curvature: 0.0 };
        Self { stretches: vec![start], length: 0.0, closed: false }
    }

    /// Goes straight on for `length` metres.
    pub fn straight(self, length: f64) -> Self {
        self.go(length, 0.0)
    }

    /// Turns by `angle` (rad, left positive) along an arc of `radius` metres.
    pub fn arc(self, radius: f64, angle: f64) -> Self {
        self.go(radius * angle.abs(), angle.signum() / radius)
    }

    /// Joins the end to the beginning; they must meet within a millimetre.
    pub fn close(mut self) -> Self {
        let ((x, y, _), first) = (self.at(self.length, 0.0), self.stretches[0]);
        assert!((x - first.x).hypot(y - first.y) < 1e-3, "the course ends at ({x}, {y}), not where it began");
        self.closed = true;
        self
    }

    fn go(mut self, length: f64, curvature: f64) -> Self {
        let (x, y, heading) = self.at(self.length, 0.0);
        if self.length == 0.0 {
            self.stretches.clear();
        }
        self.stretches.push(Stretch { station: self.length, x, y, heading, curvature });
        self.length += length;
        self
    }

    /// Length of the course, in metres.
    pub fn length(&self) -> f64 {
        self.length
    }

    /// x, y (metres) and heading (rad) at `station` metres from the beginning, `left` metres beside the line.
    ///
    /// A closed course wraps; an open one goes straight on, or round its last arc, beyond its ends.
    pub fn at(&self, station: f64, left: f64) -> (f64, f64, f64) {
        let station = if self.closed { station.rem_euclid(self.length) } else { station };
        let index = self.stretches.partition_point(|stretch| stretch.station <= station).max(1) - 1;
        let Stretch { station: start, x, y, heading, curvature } = self.stretches[index];
        let run = station - start;
        let bend = curvature * run;
        let end = heading + bend;
        let (dx, dy) = if bend.abs() < BEND_MIN {
            let middle = heading + bend / 2.0;
            (run * middle.cos(), run * middle.sin())
        } else {
            ((end.sin() - heading.sin()) / curvature, (heading.cos() - end.cos()) / curvature)
        };
        (x + dx - left * end.sin(), y + dy + left * end.cos(), end)
    }
}

/// A drive along a course: its direction, speed and start.
#[derive(Clone, Debug, PartialEq)]
pub struct Drive {
    /// Line on the ground that the vehicle follows.
    pub course: Arc<Course>,
    /// Metres along the line at time 0.
    pub start: f64,
    /// Metres left of the line.
    pub left: f64,
    /// Mean speed, m/s; negative drives the course backwards, facing that way.
    pub speed: f64,
    /// The speed swings about its mean by this much, m/s; less than the mean.
    pub swing: f64,
    /// Period of the swing, s.
    pub swing_s: f64,
}

impl Drive {
    /// Drives `course` from `start` metres on at a steady `speed` m/s.
    pub fn steady(course: Arc<Course>, start: f64, left: f64, speed: f64) -> Self {
        Self { course, start, left, speed, swing: 0.0, swing_s: 20.0 }
    }

    /// Metres along the course at `time` s.
    pub fn station(&self, time: f64) -> f64 {
        let rate = TAU / self.swing_s;
        self.start + self.speed * time + self.swing / rate * (1.0 - (rate * time).cos())
    }

    /// Speed at `time` s, m/s, never negative.
    pub fn speed_at(&self, time: f64) -> f64 {
        (self.speed + self.swing * (TAU / self.swing_s * time).sin()).abs()
    }

    /// x, y (metres) and heading (rad) at `time` s.
    pub fn at(&self, time: f64) -> (f64, f64, f64) {
        let (x, y, heading) = self.course.at(self.station(time), self.left);
        (x, y, if self.speed < 0.0 { heading + TAU / 2.0 } else { heading })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_arc_that_hardly_bends_is_as_long_as_a_straight() {
        for radius_m in [1e3, 1e6, 1e7, 1e12, 1e17, 1e300] {
            let (x, y, _) = Course::from(1.0, 2.0, 0.3).arc(radius_m, 1e-3).at(0.8, 0.0);
            let (dx, dy) = (x - 1.0 - 0.8 * 0.3_f64.cos(), y - 2.0 - 0.8 * 0.3_f64.sin());
            assert!(dx.hypot(dy) < 0.5 / radius_m + 1e-9, "{radius_m} m: off by {dx}, {dy}");
        }
    }

    #[test]
    fn a_closed_course_is_continuous_and_repeats() {
        let quarter = TAU / 4.0;
        let mut course = Course::from(10.0, 0.0, 0.0);
        for _ in 0..2 {
            course = course.straight(60.0).arc(20.0, quarter).straight(30.0).arc(20.0, quarter);
        }
        let course = course.close();
        let drive = Drive { swing: 2.0, ..Drive::steady(Arc::new(course.clone()), 3.0, -1.5, 8.0) };
        let mut before = drive.at(0.0);
        for step in 1..100_000 {
            let now = drive.at(f64::from(step) * 1e-3);
            let moved = (now.0 - before.0).hypot(now.1 - before.1);
            assert!(moved < 0.012, "{moved} m in a millisecond at {step} ms");
            before = now;
        }
        let (a, b) = (course.at(5.0, 0.0), course.at(5.0 + course.length(), 0.0));
        assert!((a.0 - b.0).abs() + (a.1 - b.1).abs() < 1e-9);
    }
}

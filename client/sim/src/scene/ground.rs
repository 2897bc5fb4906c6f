//! The ground: its height at every place, and the point where a ray meets it, both exact.
//!
//! In: profiles along x and across y (metres, world frame) and raised terraces. Out: heights, slopes, ray distances.
//! Every patch between two breakpoints is a plane and every terrace a prism, so no ray is marched or sampled.

/// The heights along one axis: linear between the breakpoints and level beyond the ends.
///
/// Two breakpoints at the same place are a vertical step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Profile {
    /// Place and height of each breakpoint, in metres, by ascending place.
    points: Vec<(f64, f64)>,
}

impl Profile {
    /// A profile through these places and heights, in metres. Places must ascend.
    pub fn through(points: &[(f64, f64)]) -> Self {
        assert!(points.windows(2).all(|pair| pair[0].0 <= pair[1].0), "a profile's places ascend: {points:?}");
        Self { points: points.to_vec() }
    }

    /// Continues level from the last breakpoint to `from`, then rises by `rise` until `to` along half a cosine.
    ///
    /// The half cosine consists of straight pieces, so that rays meet planes.
    pub fn ramp(mut self, from: f64, to: f64, rise: f64) -> Self {
        const PIECES: usize = 12;
        let last = self.points.last().copied();
        assert!(last.is_none_or(|(place, _)| place <= from) && from < to, "a ramp follows what lies before it");
        let start = last.map_or(0.0, |(_, height)| height);
        for piece in 0..=PIECES {
            let part = piece as f64 / PIECES as f64;
            let lift = 0.5 - 0.5 * (part * std::f64::consts::PI).cos();
            self.points.push((from + part * (to - from), start + lift * rise));
        }
        self
    }

    /// The same profile `lift` metres higher.
    pub fn raised(mut self, lift: f64) -> Self {
        self.points.iter_mut().for_each(|point| point.1 += lift);
        self
    }

    /// The sum of two profiles, which must not have a step at the same place.
    pub fn plus(&self, other: &Self) -> Self {
        let own = self.points.iter().map(|&(place, height)| (place, height + other.height(place)));
        let added = other.points.iter().map(|&(place, height)| (place, height + self.height(place)));
        let mut points: Vec<(f64, f64)> = own.chain(added).collect();
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        Self { points }
    }

    fn patch(&self, place: f64) -> usize {
        self.points.partition_point(|point| point.0 <= place)
    }

    /// Height at place 0 and slope of the line that a patch is part of.
    fn line(&self, patch: usize) -> (f64, f64) {
        let Some(last) = self.points.len().checked_sub(1) else { return (0.0, 0.0) };
        if patch == 0 {
            return (self.points[0].1, 0.0);
        }
        if patch > last {
            return (self.points[last].1, 0.0);
        }
        let ((x0, z0), (x1, z1)) = (self.points[patch - 1], self.points[patch]);
        if x1 == x0 {
            return (z1, 0.0);
        }
        let slope = (z1 - z0) / (x1 - x0);
        (z0 - slope * x0, slope)
    }

    fn height(&self, place: f64) -> f64 {
        let (height, slope) = self.line(self.patch(place));
        height + slope * place
    }

    fn slope(&self, place: f64) -> f64 {
        self.line(self.patch(place)).1
    }

    /// The place at which a ray in direction `toward` leaves the patch, or infinity.
    fn border(&self, patch: usize, toward: f64) -> f64 {
        if toward > 0.0 {
            self.points.get(patch).map_or(f64::INFINITY, |point| point.0)
        } else {
            patch.checked_sub(1).map_or(f64::NEG_INFINITY, |before| self.points[before].0)
        }
    }

    fn highest(&self) -> f64 {
        self.points.iter().map(|point| point.1).fold(f64::NEG_INFINITY, f64::max).max(0.0)
    }
}

/// A part of the ground that is raised (or lowered) by a vertical step on all sides: an island with kerbs, a pavement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Terrace {
    /// Centre (x, y), in metres.
    pub centre: [f64; 2],
    /// Half extents along x and y with the corners, in metres.
    pub half: [f64; 2],
    /// Radius of the corners, in metres.
    pub corner: f64,
    /// True if the ground outside the rounded rectangle is raised instead of the inside.
    pub outside: bool,
    /// Height of the step, in metres.
    pub rise: f64,
    /// Reflectivity, 0 to 255.
    pub reflectivity: u8,
}

impl Terrace {
    fn holds(&self, x: f64, y: f64) -> bool {
        let dx = ((x - self.centre[0]).abs() - self.half[0] + self.corner).max(0.0);
        let dy = ((y - self.centre[1]).abs() - self.half[1] + self.corner).max(0.0);
        let inside = if dx > 0.0 && dy > 0.0 { dx.hypot(dy) <= self.corner } else { dx.max(dy) <= self.corner };
        inside != self.outside
    }

    /// True if the outline may be between two places. It is not if both are inside it, because it is convex, or if both
    /// are beyond one side.
    fn may_be_crossed(&self, ends: [[f64; 2]; 2]) -> bool {
        let inside = |[x, y]: [f64; 2]| self.holds(x, y) != self.outside;
        let beyond = (0..2).any(|axis| {
            let [a, b] = ends.map(|end| end[axis] - self.centre[axis]);
            a.min(b) > self.half[axis] || a.max(b) < -self.half[axis]
        });
        !beyond && !ends.into_iter().all(inside)
    }

    /// Distances along a line at which it enters and leaves the outline.
    fn crossings(&self, origin: [f64; 2], direction: [f64; 2]) -> Option<(f64, f64)> {
        let o = [origin[0] - self.centre[0], origin[1] - self.centre[1]];
        let (mut enter, mut leave) = (f64::INFINITY, f64::NEG_INFINITY);
        let mut join = |part: Option<(f64, f64)>| {
            if let Some((from, to)) = part {
                enter = enter.min(from);
                leave = leave.max(to);
            }
        };
        let inner = [self.half[0] - self.corner, self.half[1] - self.corner];
        join(slab(o, direction, [self.half[0], inner[1]]));
        join(slab(o, direction, [inner[0], self.half[1]]));
        for (sx, sy) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
            join(disc([o[0] - sx * inner[0], o[1] - sy * inner[1]], direction, self.corner));
        }
        (enter < leave).then_some((enter, leave))
    }
}

/// Distances along a line at which it enters and leaves a rectangle around the origin.
pub(crate) fn slab(origin: [f64; 2], direction: [f64; 2], half: [f64; 2]) -> Option<(f64, f64)> {
    let (mut from, mut to) = (f64::NEG_INFINITY, f64::INFINITY);
    for axis in 0..2 {
        if direction[axis].abs() < 1e-12 {
            if origin[axis].abs() > half[axis] {
                return None;
            }
            continue;
        }
        let a = (-half[axis] - origin[axis]) / direction[axis];
        let b = (half[axis] - origin[axis]) / direction[axis];
        from = from.max(a.min(b));
        to = to.min(a.max(b));
    }
    (from < to).then_some((from, to))
}

/// Distances along a line at which it enters and leaves a circle around the origin.
pub(crate) fn disc(origin: [f64; 2], direction: [f64; 2], radius: f64) -> Option<(f64, f64)> {
    let a = direction[0] * direction[0] + direction[1] * direction[1];
    let half_b = origin[0] * direction[0] + origin[1] * direction[1];
    let root = half_b * half_b - a * (origin[0] * origin[0] + origin[1] * origin[1] - radius * radius);
    (root > 0.0 && a > 0.0).then(|| ((-half_b - root.sqrt()) / a, (-half_b + root.sqrt()) / a))
}

/// The ground: its height is `along(x) + across(y)` plus the rises of all terraces that contain (x, y).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Ground {
    /// Height as a function of x.
    pub along: Profile,
    /// Height as a function of y. Steps are the kerbs of a straight road.
    pub across: Profile,
    /// Raised parts of the ground.
    pub terraces: Vec<Terrace>,
    /// Reflectivity of the ground outside of terraces, 0 to 255.
    pub reflectivity: u8,
}

impl Ground {
    /// Height at (x, y), in metres.
    pub fn height(&self, x: f64, y: f64) -> f64 {
        self.along.height(x) + self.across.height(y) + self.rise(x, y)
    }

    /// Slope at (x, y), as rise over run, without steps.
    pub fn slope(&self, x: f64, y: f64) -> f64 {
        self.along.slope(x).hypot(self.across.slope(y))
    }

    /// Reflectivity at (x, y), 0 to 255: of the terrace, else of the ground.
    pub fn reflectivity(&self, x: f64, y: f64) -> u8 {
        let terrace = self.terraces.iter().rfind(|terrace| terrace.holds(x, y));
        terrace.map_or(self.reflectivity, |terrace| terrace.reflectivity)
    }

    fn rise(&self, x: f64, y: f64) -> f64 {
        self.terraces.iter().filter(|terrace| terrace.holds(x, y)).map(|terrace| terrace.rise).sum()
    }

    /// Upper bound of the height of the ground, in metres.
    fn highest(&self) -> f64 {
        self.along.highest() + self.across.highest() + self.highest_rise()
    }

    fn highest_rise(&self) -> f64 {
        self.terraces.iter().map(|terrace| terrace.rise.max(0.0)).sum()
    }

    /// Distance along the ray at which it meets the ground, if within `range`; `direction` has length 1.
    pub fn meets(&self, origin: [f64; 3], direction: [f64; 3], range: f64) -> Option<f64> {
        let highest = self.highest();
        if origin[2] > highest && origin[2] + direction[2] * range > highest {
            return None;
        }
        let highest_rise = self.highest_rise();
        let (mut ix, mut iy) = (self.along.patch(origin[0]), self.across.patch(origin[1]));
        let mut from = 0.0;
        loop {
            // The patch's plane: the ray's height over it is linear in the distance.
            let ((ax, bx), (ay, by)) = (self.along.line(ix), self.across.line(iy));
            let over = origin[2] - ax - bx * origin[0] - ay - by * origin[1];
            let climb = direction[2] - bx * direction[0] - by * direction[1];
            let border = |profile: &Profile, patch: usize, axis: usize| {
                let place = profile.border(patch, direction[axis]);
                if direction[axis] == 0.0 || place.is_infinite() {
                    f64::INFINITY
                } else {
                    ((place - origin[axis]) / direction[axis]).max(from)
                }
            };
            let (next_x, next_y) = (border(&self.along, ix, 0), border(&self.across, iy, 1));
            let to = next_x.min(next_y).min(range);
            if let Some(hit) = self.meets_patch(origin, direction, (from, to), (over, climb), highest_rise) {
                return Some(hit);
            }
            if to >= range {
                return None;
            }
            from = to;
            if next_x <= next_y {
                ix = if direction[0] > 0.0 { ix + 1 } else { ix - 1 };
            } else {
                iy = if direction[1] > 0.0 { iy + 1 } else { iy - 1 };
            }
        }
    }

    /// Distance along the ray at which it meets one plane, which is `over + climb * t` below the ray.
    fn meets_patch(
        &self,
        origin: [f64; 3],
        direction: [f64; 3],
        (from, to): (f64, f64),
        (over, climb): (f64, f64),
        highest_rise: f64,
    ) -> Option<f64> {
        if (over + climb * from).min(over + climb * to) > highest_rise {
            return None;
        }
        // Above the highest rise no outline matters.
        let from = if climb < 0.0 { from.max(((highest_rise - over) / climb).min(to)) } else { from };
        // Outlines of terraces cut the way through the patch into stretches of equal rise.
        let mut cuts = [to; 34];
        let mut count = 0;
        let ends = [from, to].map(|t| [origin[0] + t * direction[0], origin[1] + t * direction[1]]);
        for terrace in self.terraces.iter().filter(|terrace| terrace.may_be_crossed(ends)) {
            let Some((enter, leave)) = terrace.crossings([origin[0], origin[1]], [direction[0], direction[1]]) else {
                continue;
            };
            for cut in [enter, leave] {
                if cut > from && cut < to && count < 33 {
                    cuts[count] = cut;
                    count += 1;
                }
            }
        }
        cuts[..count].sort_unstable_by(f64::total_cmp);
        let mut start = from;
        for &stop in &cuts[..=count] {
            let middle = 0.5 * (start + stop);
            let rise = self.rise(origin[0] + middle * direction[0], origin[1] + middle * direction[1]);
            if over + climb * start <= rise {
                return Some(start);
            }
            if over + climb * stop <= rise {
                return Some((rise - over) / climb);
            }
            start = stop;
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ray_meets_level_ground_where_trigonometry_says() {
        let ground = Ground::default();
        let down: f64 = -0.1;
        let hit = ground.meets([0.0, 0.0, 2.0], [down.cos(), 0.0, down.sin()], 100.0).unwrap();
        assert!((hit - 2.0 / 0.1_f64.sin()).abs() < 1e-9);
        assert_eq!(ground.meets([0.0, 0.0, 2.0], [0.1_f64.cos(), 0.0, 0.1_f64.sin()], 100.0), None);
    }

    #[test]
    fn the_height_of_a_sum_is_the_sum_of_the_heights() {
        let slope = Profile::through(&[(-10.0, -1.0), (4.0, 0.4), (10.0, 0.0)]);
        let kerbs = Profile::through(&[(-3.0, 0.15), (-3.0, 0.0), (3.0, 0.0), (3.0, 0.4)]);
        let sum = slope.plus(&kerbs);
        for step in -1200..1200 {
            let place = f64::from(step) * 0.01 + 0.005;
            assert!((sum.height(place) - slope.height(place) - kerbs.height(place)).abs() < 1e-12, "{place}");
        }
    }

    #[test]
    fn what_a_ray_meets_lies_on_the_ground_or_on_a_step() {
        let ground = Ground {
            along: Profile::default().ramp(10.0, 30.0, 2.0).ramp(35.0, 50.0, -3.0),
            across: Profile::through(&[(-8.0, -0.4), (-6.0, 0.15), (-4.0, 0.15), (-4.0, 0.0), (4.0, 0.1), (4.0, 0.25)]),
            terraces: vec![Terrace {
                centre: [20.0, 10.0],
                half: [6.0, 3.0],
                corner: 1.0,
                outside: false,
                rise: 0.5,
                reflectivity: 40,
            }],
            reflectivity: 10,
        };
        let mut met = 0;
        for step in 0..20_000 {
            let azimuth = f64::from(step) * 0.0147;
            let elevation = -0.4 + 0.42 * f64::from(step % 64) / 64.0;
            let direction = [elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin()];
            let Some(range) = ground.meets([0.0, 0.0, 1.9], direction, 100.0) else { continue };
            let at = |range: f64| [range * direction[0], range * direction[1], 1.9 + range * direction[2]];
            let (before, behind) = (at(range - 1e-6), at(range + 1e-6));
            assert!(before[2] > ground.height(before[0], before[1]), "above before: {before:?}");
            assert!(behind[2] < ground.height(behind[0], behind[1]) + 1e-9, "below behind: {behind:?}");
            // Nothing of the ground stands in between.
            for part in 1..200 {
                let [x, y, z] = at(range * f64::from(part) / 200.0 - 1e-6);
                assert!(z > ground.height(x, y) - 1e-9, "{range} at {part}: {x} {y} {z}");
            }
            met += 1;
        }
        assert!(met > 10_000, "{met}");
    }
}

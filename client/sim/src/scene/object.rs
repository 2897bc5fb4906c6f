//! The things that stand or drive on the ground, each a shape a ray meets exactly.
//!
//! In: a ray in the world frame (metres, direction of length 1). Out: the distance at which it meets the shape.

use super::course::Drive;
use super::ground::{Ground, disc, slab};
use crate::noise::mixed;

/// What an object is to a driver.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Kind {
    /// A house or another solid block.
    House,
    /// A free-standing wall.
    Wall,
    /// A parked car.
    ParkedCar,
    /// A car that drives.
    MovingCar,
    /// A fence, closed or of slats.
    Fence,
    /// A pole.
    Pole,
    /// A tree's trunk.
    Trunk,
    /// A tree's leaves.
    Leaves,
    /// A beam over the road.
    Beam,
}

/// A shape in the world frame, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// An upright box.
    Block {
        /// Centre.
        x: f64,
        /// Centre.
        y: f64,
        /// Cosine and sine of the heading.
        facing: (f64, f64),
        /// Half extents along and across the heading.
        half: [f64; 2],
        /// Bottom and top.
        z: (f64, f64),
    },
    /// A thin upright panel between two places; a ray passes between its slats.
    Panel {
        /// One foot.
        from: [f64; 2],
        /// Direction to the other foot, length 1.
        along: [f64; 2],
        /// Length.
        length: f64,
        /// Height of the lower edge at the first foot, and its rise a metre.
        base: (f64, f64),
        /// Height over the lower edge.
        height: f64,
        /// Distance from slat to slat, and the width of one; equal for a closed panel.
        slats: (f64, f64),
    },
    /// An upright cylinder.
    Post {
        /// Axis.
        x: f64,
        /// Axis.
        y: f64,
        /// Radius.
        radius: f64,
        /// Bottom and top.
        z: (f64, f64),
    },
    /// An upright ellipsoid of leaves, cut off level below; a ray is stopped somewhere inside, or passes.
    Crown {
        /// Centre.
        x: f64,
        /// Centre.
        y: f64,
        /// Centre.
        z: f64,
        /// Horizontal radius.
        radius: f64,
        /// Vertical radius.
        rise: f64,
        /// No leaf is lower.
        underside: f64,
        /// Leaves met a metre of way, on average.
        density: f64,
    },
}

impl Shape {
    /// Distance at which the ray meets the shape; `draw` decides where leaves stop it.
    pub fn meets(&self, origin: [f64; 3], direction: [f64; 3], draw: u64) -> Option<f64> {
        match *self {
            Shape::Block { x, y, facing: (cos, sin), half, z } => {
                let (ox, oy) = (origin[0] - x, origin[1] - y);
                let local = [ox * cos + oy * sin, oy * cos - ox * sin];
                let heading = [direction[0] * cos + direction[1] * sin, direction[1] * cos - direction[0] * sin];
                let (from, to) = within(slab(local, heading, half)?, origin[2], direction[2], z)?;
                entry(from, to)
            }
            Shape::Panel { from, along, length, base, height, slats } => {
                let across = direction[0] * along[1] - direction[1] * along[0];
                if across.abs() < 1e-12 {
                    return None;
                }
                let (ox, oy) = (from[0] - origin[0], from[1] - origin[1]);
                let range = (ox * along[1] - oy * along[0]) / across;
                let place = (range * direction[0] - ox) * along[0] + (range * direction[1] - oy) * along[1];
                let over = origin[2] + range * direction[2] - base.0 - base.1 * place;
                let stopped = range > 0.0
                    && (0.0..=length).contains(&place)
                    && (0.0..=height).contains(&over)
                    && place.rem_euclid(slats.0) <= slats.1;
                stopped.then_some(range)
            }
            Shape::Post { x, y, radius, z } => {
                let inside = disc([origin[0] - x, origin[1] - y], [direction[0], direction[1]], radius)?;
                let (from, to) = within(inside, origin[2], direction[2], z)?;
                entry(from, to)
            }
            Shape::Crown { x, y, z, radius, rise, underside, density } => {
                let flat = radius / rise;
                let o = [origin[0] - x, origin[1] - y, (origin[2] - z) * flat];
                let d = [direction[0], direction[1], direction[2] * flat];
                let a = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
                let half_b = o[0] * d[0] + o[1] * d[1] + o[2] * d[2];
                let root = half_b * half_b - a * (o[0] * o[0] + o[1] * o[1] + o[2] * o[2] - radius * radius);
                if root <= 0.0 {
                    return None;
                }
                let inside = ((-half_b - root.sqrt()) / a, (-half_b + root.sqrt()) / a);
                let (from, to) = within(inside, origin[2], direction[2], (underside, f64::INFINITY))?;
                // Beer's law: the way to the first leaf is exponentially distributed.
                let chance = ((mixed(draw) >> 11) as f64 + 0.5) / (1_u64 << 53) as f64;
                let way = -chance.ln() / density;
                (to > 0.0 && from.max(0.0) + way < to).then(|| from.max(0.0) + way)
            }
        }
    }

    /// Bottom and top over (x, y), grown sideways by `margin`; `None` beside the shape.
    pub fn column(&self, x: f64, y: f64, margin: f64) -> Option<(f64, f64)> {
        match *self {
            Shape::Block { x: cx, y: cy, facing: (cos, sin), half, z } => {
                let (ox, oy) = (x - cx, y - cy);
                let along = (ox * cos + oy * sin).abs() <= half[0] + margin;
                (along && (oy * cos - ox * sin).abs() <= half[1] + margin).then_some(z)
            }
            Shape::Panel { from, along, length, base, height, .. } => {
                let (ox, oy) = (x - from[0], y - from[1]);
                let place = ox * along[0] + oy * along[1];
                let beside = (oy * along[0] - ox * along[1]).abs() <= margin;
                let low = base.0 + base.1 * place.clamp(0.0, length);
                (beside && place >= -margin && place <= length + margin).then_some((low, low + height))
            }
            Shape::Post { x: cx, y: cy, radius, z } => ((x - cx).hypot(y - cy) <= radius + margin).then_some(z),
            Shape::Crown { x: cx, y: cy, z, radius, rise, underside, .. } => {
                let off = ((x - cx).hypot(y - cy) - margin).max(0.0) / radius;
                let half = rise * (1.0 - off * off).max(0.0).sqrt();
                (off < 1.0 && z + half > underside).then_some(((z - half).max(underside), z + half))
            }
        }
    }

    /// Corners of the footprint, and a radius: every part of it lies between the corners, or within the radius of one.
    pub(crate) fn outline(&self) -> ([[f64; 2]; 4], f64) {
        match *self {
            Shape::Block { x, y, facing: (cos, sin), half: [l, w], .. } => {
                let corner = |l: f64, w: f64| [x + l * cos - w * sin, y + l * sin + w * cos];
                ([corner(l, w), corner(l, -w), corner(-l, w), corner(-l, -w)], 0.0)
            }
            Shape::Panel { from, along, length, .. } => {
                let to = [from[0] + along[0] * length, from[1] + along[1] * length];
                ([from, to, from, to], 0.0)
            }
            Shape::Post { x, y, radius, .. } | Shape::Crown { x, y, radius, .. } => ([[x, y]; 4], radius),
        }
    }
}

/// The part of a stretch of a ray that lies between two heights.
fn within((from, to): (f64, f64), height: f64, climb: f64, z: (f64, f64)) -> Option<(f64, f64)> {
    if climb.abs() < 1e-12 {
        return (height >= z.0 && height <= z.1).then_some((from, to));
    }
    let (a, b) = ((z.0 - height) / climb, (z.1 - height) / climb);
    let (from, to) = (from.max(a.min(b)), to.min(a.max(b)));
    (from < to).then_some((from, to))
}

/// A ray enters a solid in front of it; one that begins inside sees nothing of it.
fn entry(from: f64, to: f64) -> Option<f64> {
    (from > 0.0 && to > from).then_some(from)
}

/// One thing of the world.
#[derive(Clone, Debug, PartialEq)]
pub struct Object {
    /// What it is.
    pub kind: Kind,
    /// Its shape: in the world frame, or for one that drives in the driver's frame (x forward, y left, z over the
    /// ground).
    pub shape: Shape,
    /// What a return from it weighs, 0 to 255.
    pub reflectivity: u8,
    /// How it drives; `None` stands.
    pub drive: Option<Drive>,
}

impl Object {
    /// Its shape in the world frame at `time` s.
    pub fn at(&self, time: f64, ground: &Ground) -> Shape {
        let (Some(drive), Shape::Block { x, y, facing: (cos, sin), half, z }) = (&self.drive, self.shape) else {
            return self.shape;
        };
        let (car_x, car_y, heading) = drive.at(time);
        let (ch, sh) = (heading.cos(), heading.sin());
        let base = ground.height(car_x, car_y);
        Shape::Block {
            x: car_x + x * ch - y * sh,
            y: car_y + x * sh + y * ch,
            facing: (cos * ch - sin * sh, sin * ch + cos * sh),
            half,
            z: (z.0 + base, z.1 + base),
        }
    }
}

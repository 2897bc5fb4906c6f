//! The objects that stand or drive on the ground, each with a shape that a ray meets exactly.
//!
//! In: a ray in the world frame (metres, direction of length 1). Out: the distance at which it meets the shape.

use super::course::Drive;
use super::ground::{Ground, disc, slab};
use crate::noise::mixed;

/// Kind of an object.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Kind {
    /// A building, or another solid block.
    Building,
    /// A wall that stands free on both sides.
    Wall,
    /// A car that is parked.
    ParkedCar,
    /// A car that drives.
    MovingCar,
    /// A fence, closed or of slats.
    Fence,
    /// A thin upright pole, such as a lamp post.
    Pole,
    /// The trunk of a tree.
    Trunk,
    /// The leaves of a tree.
    Leaves,
    /// A beam over the road.
    Beam,
}

/// A shape in the world frame, in metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// An upright box, turned about the vertical.
    Block {
        /// Coordinate x of the centre.
        x: f64,
        /// Coordinate y of the centre.
        y: f64,
        /// Cosine and sine of the heading.
        facing: (f64, f64),
        /// Half extents along and across the heading.
        half: [f64; 2],
        /// Heights of bottom and top.
        z: (f64, f64),
    },
    /// A thin upright panel between two places; a ray passes between its slats.
    Panel {
        /// Place (x, y) of one end.
        from: [f64; 2],
        /// Direction to the other end, as a vector of length 1.
        along: [f64; 2],
        /// Length of the panel.
        length: f64,
        /// Height of the lower edge at the first end, and its slope.
        base: (f64, f64),
        /// Height of the upper edge over the lower edge.
        height: f64,
        /// Distance from slat to slat, and width of a slat. They are equal for a closed panel.
        slats: (f64, f64),
    },
    /// An upright cylinder, such as a pole or a trunk.
    Post {
        /// Coordinate x of the axis.
        x: f64,
        /// Coordinate y of the axis.
        y: f64,
        /// Radius of the cylinder.
        radius: f64,
        /// Heights of bottom and top.
        z: (f64, f64),
    },
    /// An upright ellipsoid of leaves with a level underside. A leaf stops the ray at a random place inside, or none
    /// does.
    Crown {
        /// Coordinate x of the centre.
        x: f64,
        /// Coordinate y of the centre.
        y: f64,
        /// Coordinate z of the centre.
        z: f64,
        /// Radius of the ellipsoid in the horizontal, in metres.
        radius: f64,
        /// Radius of the ellipsoid in the vertical, in metres.
        rise: f64,
        /// Height of the underside.
        underside: f64,
        /// Mean number of leaves that a ray meets per metre.
        density: f64,
    },
}

impl Shape {
    /// Distance at which the ray meets the shape. `draw`, a random number, decides where leaves stop it.
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

    /// Heights of bottom and top at (x, y) of the shape, widened by `margin` on all sides; `None` beside the shape.
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

    /// Corners of the footprint, and a radius. Every part of the footprint is between the corners or within the radius
    /// of a corner.
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

/// The part of an interval of a ray that is between two heights.
fn within((from, to): (f64, f64), height: f64, climb: f64, z: (f64, f64)) -> Option<(f64, f64)> {
    if climb.abs() < 1e-12 {
        return (height >= z.0 && height <= z.1).then_some((from, to));
    }
    let (a, b) = ((z.0 - height) / climb, (z.1 - height) / climb);
    let (from, to) = (from.max(a.min(b)), to.min(a.max(b)));
    (from < to).then_some((from, to))
}

/// Distance at which a ray enters a solid; `None` if the ray begins inside it.
fn entry(from: f64, to: f64) -> Option<f64> {
    (from > 0.0 && to > from).then_some(from)
}

/// One object of the world.
#[derive(Clone, Debug, PartialEq)]
pub struct Object {
    /// Kind of the object.
    pub kind: Kind,
    /// Shape of the object, in the world frame. The shape of a driving object is in its own frame (x forward, y left, z
    /// over the ground).
    pub shape: Shape,
    /// Reflectivity, 0 to 255.
    pub reflectivity: u8,
    /// Drive of the object; `None` if it stands.
    pub drive: Option<Drive>,
}

impl Object {
    /// Shape in the world frame at `time` s.
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

//! A world: the ground, and the objects that stand, hang or drive over it.
//!
//! Frame: world ("map"), x east, y north, z up, metres; time in seconds from the scene's beginning. Feet of objects
//! follow the ground.

use super::course::Drive;
use super::ground::Ground;
use super::object::{Kind, Object, Shape};

/// A world: its ground and objects.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct World {
    /// Ground of the world.
    pub ground: Ground,
    /// Objects on the ground.
    pub objects: Vec<Object>,
}

/// Distance from slat to slat, and width of a slat, of an open fence, in metres.
pub const SLATS: (f64, f64) = (0.15, 0.09);

impl World {
    /// A world without objects.
    pub fn on(ground: Ground) -> Self {
        Self { ground, objects: Vec::new() }
    }

    fn with(mut self, kind: Kind, reflectivity: u8, shape: Shape) -> Self {
        self.objects.push(Object { kind, shape, reflectivity, drive: None });
        self
    }

    /// A building of `size` metres (along, across its heading) and `height`, its foot sunk into sloping ground.
    pub fn building(self, x: f64, y: f64, heading: f64, size: [f64; 2], height: f64) -> Self {
        let base = self.ground.height(x, y);
        let half = [size[0] / 2.0, size[1] / 2.0];
        let facing = (heading.cos(), heading.sin());
        self.with(Kind::Building, 90, Shape::Block { x, y, facing, half, z: (base - 3.0, base + height) })
    }

    /// A wall along these places, 0.3 m thick.
    pub fn wall(mut self, along: &[[f64; 2]], height: f64) -> Self {
        for pair in along.windows(2) {
            let (dx, dy) = (pair[1][0] - pair[0][0], pair[1][1] - pair[0][1]);
            let (x, y) = (pair[0][0] + dx / 2.0, pair[0][1] + dy / 2.0);
            let (length, base) = (dx.hypot(dy), self.ground.height(x, y));
            let facing = (dx / length, dy / length);
            let half = [length / 2.0 + 0.15, 0.15];
            self = self.with(Kind::Wall, 80, Shape::Block { x, y, facing, half, z: (base - 1.5, base + height) });
        }
        self
    }

    /// A guard rail along these places, between `underside` and `top` metres over the ground, without its posts.
    pub fn rail(mut self, along: &[[f64; 2]], underside: f64, top: f64) -> Self {
        let fences = Self { ground: std::mem::take(&mut self.ground), objects: Vec::new() }.fence(along, top, None);
        self.ground = fences.ground;
        for mut object in fences.objects {
            if let Shape::Panel { base, height, .. } = &mut object.shape {
                base.0 += underside;
                *height -= underside;
            }
            self.objects.push(object);
        }
        self
    }

    /// A bush: leaves down to the ground, so dense that hardly a ray passes, `radius` wide to each side.
    pub fn bush(self, x: f64, y: f64, radius: f64, height: f64) -> Self {
        let base = self.ground.height(x, y);
        let rise = 0.7 * height;
        let z = base + height - rise;
        self.with(Kind::Leaves, 60, Shape::Crown { x, y, z, radius, rise, underside: base - 0.5, density: 6.0 })
    }

    /// A fence along these places; `slats` as in [`SLATS`], or `None` for a closed one.
    pub fn fence(mut self, along: &[[f64; 2]], height: f64, slats: Option<(f64, f64)>) -> Self {
        for pair in along.windows(2) {
            let (dx, dy) = (pair[1][0] - pair[0][0], pair[1][1] - pair[0][1]);
            // Short panels follow the ground.
            let length = dx.hypot(dy);
            let panels = (length / 4.0).ceil().max(1.0);
            for panel in 0..panels as usize {
                let at = |part: f64| [pair[0][0] + dx * part / panels, pair[0][1] + dy * part / panels];
                let (from, to) = (at(panel as f64), at(panel as f64 + 1.0));
                let (low, high) = (self.ground.height(from[0], from[1]), self.ground.height(to[0], to[1]));
                let width = length / panels;
                let shape = Shape::Panel {
                    from,
                    along: [dx / length, dy / length],
                    length: width,
                    base: (low, (high - low) / width),
                    height,
                    slats: slats.unwrap_or((1.0, 1.0)),
                };
                self = self.with(Kind::Fence, 60, shape);
            }
        }
        self
    }

    /// Adds an upright pole at (x, y), with radius and height over the ground, in metres.
    pub fn pole(self, x: f64, y: f64, radius: f64, height: f64) -> Self {
        let base = self.ground.height(x, y);
        self.with(Kind::Pole, 120, Shape::Post { x, y, radius, z: (base - 0.5, base + height) })
    }

    /// A tree: a trunk of 0.2 m radius and a crown of `radius` whose leaves begin `underside` metres over its foot.
    pub fn tree(self, x: f64, y: f64, radius: f64, underside: f64) -> Self {
        let base = self.ground.height(x, y);
        let trunk = Shape::Post { x, y, radius: 0.2, z: (base - 0.5, base + underside + 1.0) };
        self.with(Kind::Trunk, 50, trunk).canopy(x, y, radius, underside)
    }

    /// Leaves without a trunk: a flattened ball of `radius` around (x, y), whose level underside is `underside` metres
    /// over the ground.
    pub fn canopy(self, x: f64, y: f64, radius: f64, underside: f64) -> Self {
        let rise = 0.7 * radius;
        let underside = self.ground.height(x, y) + underside;
        let shape = Shape::Crown { x, y, z: underside + 0.5 * rise, radius, rise, underside, density: 0.6 };
        self.with(Kind::Leaves, 70, shape)
    }

    /// A horizontal beam between two places, 0.4 m wide, from `underside` to `top` metres over the ground.
    pub fn beam(self, from: [f64; 2], to: [f64; 2], underside: f64, top: f64) -> Self {
        let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
        let (x, y) = (from[0] + dx / 2.0, from[1] + dy / 2.0);
        let (length, base) = (dx.hypot(dy), self.ground.height(x, y));
        let facing = (dx / length, dy / length);
        let half = [length / 2.0, 0.2];
        self.with(Kind::Beam, 100, Shape::Block { x, y, facing, half, z: (base + underside, base + top) })
    }

    /// A car that stands at (x, y) with this heading.
    pub fn parked_car(mut self, x: f64, y: f64, heading: f64) -> Self {
        let (cos, sin) = (heading.cos(), heading.sin());
        for (ahead, half, z) in car() {
            let base = self.ground.height(x, y);
            let shape = Shape::Block {
                x: x + ahead * cos,
                y: y + ahead * sin,
                facing: (cos, sin),
                half,
                z: (z.0 + base, z.1 + base),
            };
            self = self.with(Kind::ParkedCar, 110, shape);
        }
        self
    }

    /// A car that follows a drive.
    pub fn moving_car(mut self, drive: Drive) -> Self {
        for (ahead, half, z) in car() {
            let shape = Shape::Block { x: ahead, y: 0.0, facing: (1.0, 0.0), half, z };
            self.objects.push(Object { kind: Kind::MovingCar, shape, reflectivity: 110, drive: Some(drive.clone()) });
        }
        self
    }

    /// The shapes of all objects at `time` s, in their order.
    pub fn shapes_at(&self, time: f64) -> Vec<Shape> {
        self.objects.iter().map(|object| object.at(time, &self.ground)).collect()
    }
}

/// A car of 4.4 m by 1.8 m, as body and cabin: distance ahead of the middle, half extents, bottom and top, in metres.
fn car() -> [(f64, [f64; 2], (f64, f64)); 2] {
    [(0.0, [2.2, 0.9], (0.18, 0.85)), (-0.25, [1.15, 0.78], (0.85, 1.45))]
}

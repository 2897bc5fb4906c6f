//! Rays against a world: the nearest thing met, exactly.
//!
//! In: a world, where the sensor is and when. Out: for each ray the distance and what was met. Objects are sorted into
//! sectors of azimuth about the sensor, nearest first, so that a ray looks only at the few it can meet.

use std::f64::consts::{PI, TAU};
use std::ops::Deref;

use crate::scene::object::{Kind, Shape};
use crate::scene::world::World;

/// Sectors about the sensor.
const SECTORS: usize = 720;
/// Distance that the sensor and the moving objects may move before the sectors are made again, metres.
const SLACK_M: f64 = 0.5;

/// The point at which a ray met the world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Distance along the ray, metres.
    pub range_m: f64,
    /// The object's index in [`World::objects`]; `None` is the ground.
    pub object: Option<usize>,
    /// Reflectivity of what was met, 0 to 255.
    pub reflectivity: u8,
}

/// Casts rays into a world at one time from about one place; `W` is a `&World` or an `Arc<World>`.
#[derive(Clone, Debug)]
pub struct Caster<W> {
    world: W,
    range_m_max: f64,
    shapes: Vec<Shape>,
    moving: Vec<usize>,
    /// In each sector the objects in it and their nearest horizontal distances, nearest first.
    sectors: Vec<Vec<(f64, usize)>>,
    centre: [f64; 2],
    time: f64,
}

impl<W: Deref<Target = World>> Caster<W> {
    /// A caster at `origin` (metres, world) and `time` s; rays end at `range_m_max`.
    pub fn new(world: W, origin: [f64; 3], time: f64, range_m_max: f64) -> Self {
        let moving = (0..world.objects.len()).filter(|&index| world.objects[index].drive.is_some()).collect();
        let mut caster = Self {
            shapes: world.shapes_at(time),
            world,
            range_m_max,
            moving,
            sectors: vec![Vec::new(); SECTORS],
            centre: [origin[0], origin[1]],
            time,
        };
        caster.sort();
        caster
    }

    /// Moves on to another place and time; cheap when both are near the last.
    pub fn move_to(&mut self, origin: [f64; 3], time: f64) {
        for &index in &self.moving {
            self.shapes[index] = self.world.objects[index].at(time, &self.world.ground);
        }
        let moved = (origin[0] - self.centre[0]).hypot(origin[1] - self.centre[1]);
        let fastest = self.moving.iter().filter_map(|&index| self.world.objects[index].drive.as_ref());
        let fastest = fastest.map(|drive| drive.speed.abs() + drive.swing).fold(0.0, f64::max);
        if moved + fastest * (time - self.time).abs() > SLACK_M {
            self.centre = [origin[0], origin[1]];
            self.time = time;
            self.sort();
        }
    }

    fn sort(&mut self) {
        let mut near: Vec<(f64, usize)> = Vec::with_capacity(self.shapes.len());
        for (index, shape) in self.shapes.iter().enumerate() {
            let distance = distance(self.centre, shape);
            if distance < self.range_m_max + SLACK_M {
                near.push((distance, index));
            }
        }
        near.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        self.sectors.iter_mut().for_each(Vec::clear);
        for (distance, index) in near {
            let (corners, radius) = self.shapes[index].outline();
            let margin = radius + SLACK_M;
            if distance <= SLACK_M {
                self.sectors.iter_mut().for_each(|sector| sector.push((0.0, index)));
                continue;
            }
            let bearing = |corner: [f64; 2]| (corner[1] - self.centre[1]).atan2(corner[0] - self.centre[0]);
            let first = bearing(corners[0]);
            let (mut low, mut high) = (0.0_f64, 0.0_f64);
            for &corner in &corners[1..] {
                let offset = (bearing(corner) - first + PI).rem_euclid(TAU) - PI;
                low = low.min(offset);
                high = high.max(offset);
            }
            let reach = if radius > 0.0 { distance + radius } else { distance };
            let spread = (margin / reach).min(1.0).asin();
            let from = ((first + low - spread) / TAU * SECTORS as f64).floor() as i64;
            let to = ((first + high + spread) / TAU * SECTORS as f64).floor() as i64;
            for sector in from..=to.min(from + SECTORS as i64 - 1) {
                self.sectors[sector.rem_euclid(SECTORS as i64) as usize].push((distance - SLACK_M, index));
            }
        }
    }

    /// The nearest thing a ray from `origin` in `direction` (length 1) meets; `draw` is the ray's own chance, for
    /// leaves.
    pub fn cast(&self, origin: [f64; 3], direction: [f64; 3], draw: u64) -> Option<Hit> {
        self.cast_through(origin, direction, Some(draw))
    }

    /// The same without leaves: the point that the rest of a ray meets behind them.
    pub fn cast_behind_leaves(&self, origin: [f64; 3], direction: [f64; 3]) -> Option<Hit> {
        self.cast_through(origin, direction, None)
    }

    /// True if the ground at (x, y) is visible from `origin` (metres, world frame). Leaves do not hide it.
    pub fn sees_ground(&self, origin: [f64; 3], x: f64, y: f64) -> bool {
        const TOLERANCE_M: f64 = 0.05;
        let way = [x - origin[0], y - origin[1], self.world.ground.height(x, y) - origin[2]];
        let range = way.iter().map(|part| part * part).sum::<f64>().sqrt();
        let met = self.cast_behind_leaves(origin, way.map(|part| part / range));
        range <= self.range_m_max && met.is_none_or(|hit| hit.range_m > range - TOLERANCE_M)
    }

    fn cast_through(&self, origin: [f64; 3], direction: [f64; 3], draw: Option<u64>) -> Option<Hit> {
        let flat = direction[0].hypot(direction[1]);
        let bearing = direction[1].atan2(direction[0]);
        let sector = (bearing / TAU * SECTORS as f64).floor() as i64;
        let mut nearest = None;
        let mut range = self.world.ground.meets(origin, direction, self.range_m_max);
        for &(distance, index) in &self.sectors[sector.rem_euclid(SECTORS as i64) as usize] {
            if range.is_some_and(|range| distance > range * flat) {
                break;
            }
            let object = &self.world.objects[index];
            if draw.is_none() && object.kind == Kind::Leaves {
                continue;
            }
            let key = draw.unwrap_or(0) ^ (index as u64).rotate_left(40);
            if let Some(met) = self.shapes[index].meets(origin, direction, key)
                && met <= self.range_m_max
                && range.is_none_or(|range| met < range)
            {
                range = Some(met);
                nearest = Some(index);
            }
        }
        let range_m = range?;
        let reflectivity = match nearest {
            Some(index) => self.world.objects[index].reflectivity,
            None => {
                let at = [0, 1].map(|axis| origin[axis] + range_m * direction[axis]);
                self.world.ground.reflectivity(at[0], at[1])
            }
        };
        Some(Hit { range_m, object: nearest, reflectivity })
    }
}

/// Horizontal distance from a place to a shape's footprint, 0 inside.
fn distance(from: [f64; 2], shape: &Shape) -> f64 {
    match *shape {
        Shape::Block { x, y, facing: (cos, sin), half, .. } => {
            let (ox, oy) = (from[0] - x, from[1] - y);
            let along = ((ox * cos + oy * sin).abs() - half[0]).max(0.0);
            along.hypot(((oy * cos - ox * sin).abs() - half[1]).max(0.0))
        }
        Shape::Panel { from: foot, along, length, .. } => {
            let (ox, oy) = (from[0] - foot[0], from[1] - foot[1]);
            let place = (ox * along[0] + oy * along[1]).clamp(0.0, length);
            (ox - place * along[0]).hypot(oy - place * along[1])
        }
        Shape::Post { x, y, radius, .. } | Shape::Crown { x, y, radius, .. } => {
            ((from[0] - x).hypot(from[1] - y) - radius).max(0.0)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::scenes;

    #[test]
    fn sectors_change_nothing_but_the_time() {
        let scene = scenes::town();
        let world: &World = &scene.world;
        let mut caster = Caster::new(world, [0.0; 3], 0.0, 120.0);
        for step in 0..6_000_u64 {
            // Along the drive, so that the sectors are sometimes fresh and sometimes near their slack.
            let time = step as f64 * 0.004;
            let (x, y, _) = scene.drive.at(time);
            let origin = [x, y, 1.9];
            caster.move_to(origin, time);
            let (azimuth, elevation) = (step as f64 * 0.7, -0.4 + 0.5 * crate::noise::uniform(step));
            let direction = [elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin()];
            let objects = world.shapes_at(time).into_iter().enumerate();
            let met = objects
                .filter_map(|(index, shape)| shape.meets(origin, direction, step ^ (index as u64).rotate_left(40)));
            let nearest = met.chain(world.ground.meets(origin, direction, 120.0)).fold(f64::INFINITY, f64::min);
            let cast = caster.cast(origin, direction, step).map_or(f64::INFINITY, |hit| hit.range_m);
            assert!(cast == nearest || (cast.is_infinite() && nearest > 120.0), "step {step}: {cast} for {nearest}");
        }
    }

    #[test]
    fn ground_behind_a_building_is_not_visible() {
        let world = World::default().building(10.0, 0.0, 0.0, [4.0, 8.0], 5.0).canopy(0.0, 10.0, 3.0, 1.0);
        let (caster, eye) = (Caster::new(&world, [0.0, 0.0, 1.9], 0.0, 120.0), [0.0, 0.0, 1.9]);
        assert!(caster.sees_ground(eye, 7.5, 0.0));
        assert!(!caster.sees_ground(eye, 20.0, 0.0));
        assert!(caster.sees_ground(eye, 0.0, 20.0), "leaves hide nothing for certain");
    }
}

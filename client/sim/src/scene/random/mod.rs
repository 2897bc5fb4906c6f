//! Random worlds: what a seed gives is a scene whose vehicle stands on a road, and a description of it.
//!
//! In: a seed. Out: a [`RandomWorld`]: ground of one [`Form`], objects of one [`Theme`], a few other objects, and the
//! mount of a sensor. The same seed gives the same world. Seeds 0 to 155 have every form with every theme once in the
//! even seeds and once in the odd seeds.
//!
//! Parameters are tuned on even seeds only; figures of odd seeds are then figures of worlds that were not tuned on.
//!
//! | file | in -> out |
//! |---|---|
//! | `draw.rs` | seed -> random numbers |
//! | `form.rs` | random numbers -> the ground without kerbs and ditches |
//! | `theme.rs` | random numbers -> kerbs and ditches, and the objects |
//! | `barrier.rs` | a line with openings -> fences, walls, rails |

mod barrier;
mod draw;
mod form;
mod theme;

use std::f64::consts::PI;
use std::sync::Arc;

use nalgebra::Isometry3;

pub use form::Form;
pub use theme::Theme;

use super::course::{Course, Drive};
use super::ground::Ground;
use super::scenes::Scene;
use super::world::World;
use draw::Draw;

/// A world made from a seed: a theme on a form, with objects.
#[derive(Clone, Debug, PartialEq)]
pub struct RandomWorld {
    /// Seed of the world.
    pub seed: u64,
    /// Form of the ground.
    pub form: Form,
    /// Theme: the kind of objects in the world.
    pub theme: Theme,
    /// The drawn ground and objects in words, with their measures.
    pub description: String,
    /// The world, in which the vehicle stands still. Its name is the theme's name.
    pub scene: Scene,
    /// Mount of the sensor: 1.6 to 2.2 m over the ground, up to 1.5 m ahead of the ego frame's origin and up to 0.3 m
    /// beside it.
    pub ego_from_sensor: Isometry3<f64>,
}

/// The world of a seed.
pub fn random_world(seed: u64) -> RandomWorld {
    let draw = &mut Draw::new(seed);
    // Even and odd seeds alike have every pair of form and theme: 6 and 13 have no common divisor.
    let pair = (seed / 2) as usize;
    let (form, theme) = (Form::ALL[pair % Form::ALL.len()], Theme::ALL[pair % Theme::ALL.len()]);
    let (along, across, ground_text) = form.draw(draw);
    let (edges, edges_text) = theme.edges(draw);
    let reflectivity = draw.whole(10, 60) as u8;
    let ground = Ground { along, across: across.plus(&edges), terraces: Vec::new(), reflectivity };
    let (world, theme_text) = theme.furnish(World::on(ground), draw);
    let world = theme::scatter(world, draw);
    let heading = draw.between(-0.15, 0.15) + if draw.chance(0.5) { PI } else { 0.0 };
    let course = Arc::new(Course::from(0.0, draw.between(-1.0, 1.0), heading).straight(1.0));
    let drive = Drive::steady(course, 0.0, 0.0, 0.0);
    let (ahead, left, up) = (draw.between(-0.5, 1.5), draw.between(-0.3, 0.3), draw.between(1.6, 2.2));
    let parts = [ground_text, edges_text, theme_text].into_iter().filter(|text| !text.is_empty());
    let parts = parts.chain([format!("sensor {ahead:.1} m ahead, {up:.1} m up")]);
    RandomWorld {
        seed,
        form,
        theme,
        description: parts.collect::<Vec<_>>().join("; "),
        scene: Scene { name: theme.name(), world: Arc::new(world), drive, paper_share: None },
        ego_from_sensor: Isometry3::translation(ahead, left, up),
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::scene::contact::Hull;
    use crate::scene::truth::{Limits, Truth, TruthGrid};

    fn truth(world: &RandomWorld) -> TruthGrid {
        let pose = world.scene.pose_at(0.0);
        TruthGrid::about(&world.scene.world, &pose, 0.0, (30.0, 0.2), &Limits::default())
    }

    #[test]
    fn even_and_odd_seeds_have_every_form_with_every_theme() {
        for parity in [0, 1] {
            let pairs: BTreeSet<_> = (0..78)
                .map(|number| random_world(2 * number + parity))
                .map(|world| (world.form, world.theme))
                .collect();
            assert_eq!(pairs.len(), Form::ALL.len() * Theme::ALL.len());
        }
        assert_eq!(random_world(7), random_world(7));
        assert_ne!(random_world(7).scene, random_world(7 + 156).scene);
    }

    #[test]
    fn every_vehicle_stands_free_on_drivable_ground() {
        for seed in 0..312 {
            let world = random_world(seed);
            let (x, y, heading) = world.scene.drive.at(0.0);
            let hull = Hull { x, y, heading, size: [4.6, 2.0, 1.6] };
            assert_eq!(world.scene.world.touched(&hull, 0.0), None, "seed {seed}: {}", world.description);
            let ground = &world.scene.world.ground;
            assert!(ground.slope(x, y) < 0.17, "seed {seed}: {}", world.description);
        }
    }

    #[test]
    fn the_truth_of_a_barrier_depends_on_its_opening() {
        for seed in 0..156 {
            let world = random_world(seed);
            let closes = match world.theme {
                Theme::ClosedFence | Theme::NarrowOpening => true,
                Theme::WideOpening => false,
                _ => continue,
            };
            let truth = truth(&world);
            let share = |class: Truth| {
                truth.classes.iter().filter(|&&other| other == class).count() as f64 / truth.classes.len() as f64
            };
            let (drivable, unreachable) = (share(Truth::Drivable), share(Truth::Unreachable));
            println!("seed {seed}: {drivable:.2} {unreachable:.2} {}", world.description);
            assert!(drivable > 0.02, "seed {seed}: {}", world.description);
            assert_eq!(closes, unreachable > 0.1, "seed {seed}: {unreachable:.3}: {}", world.description);
        }
    }
}

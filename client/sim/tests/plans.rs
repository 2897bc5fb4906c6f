//! The scenes seen from above, for a reviewer to judge as a driver would.
//!
//! `.` drivable, `:` tight, `-` out of reach, `/` steep, `#` obstacle, `^` the vehicle, which looks up the page.

use clearway_sim::plan::plan;
use clearway_sim::random::random_world;
use clearway_sim::scenes::{self, Scene};
use clearway_sim::truth::{Limits, TruthGrid};

fn seen_from_above(scene: &Scene, half_m: f64) -> String {
    let truth = TruthGrid::about(&scene.world, &scene.pose_at(0.0), 0.0, (half_m, 0.2), &Limits::default());
    plan(&truth, (half_m, half_m), (40, 80))
}

#[test]
fn the_thesis_scenes_look_as_its_figures_say() {
    for scene in scenes::of_the_thesis() {
        insta::assert_snapshot!(scene.name.replace(' ', "_"), seen_from_above(&scene, 40.0));
    }
}

#[test]
fn the_town_looks_like_a_town() {
    insta::assert_snapshot!("town", seen_from_above(&scenes::town(), 60.0));
}

/// A narrow opening, a closed fence, a wide opening, a ditch and a low overhang.
#[test]
fn random_worlds_look_as_their_descriptions_say() {
    for seed in [6, 10, 8, 28, 46] {
        let world = random_world(seed);
        let (form, theme) = (world.form.name(), world.theme.name());
        let seen = seen_from_above(&world.scene, 40.0);
        let text = format!("seed {seed}: {theme}, {form}\n{}\n{seen}", world.description);
        insta::assert_snapshot!(format!("random_{seed}"), text);
    }
}

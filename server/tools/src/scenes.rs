//! The simulated scenes by name.

use clearway_sim::scenes::{self, Scene};
use clearway_sim::traffic;

/// Speed of the vehicle in the scene `street`, in m/s.
const STREET_MPS: f64 = 8.0;

/// A scene that subcommands know by its name.
pub struct NamedScene {
    /// Name of the scene on the command line.
    pub name: &'static str,
    /// What the scene shows, in words.
    pub description: &'static str,
    /// Number of revolutions by which maps are judged: one where nothing moves.
    pub revolutions: u64,
    /// Function that builds the scene.
    pub make: fn() -> Scene,
}

/// All scenes, in the order in which `--help` lists them.
pub const SCENES: [NamedScene; 7] = [
    NamedScene {
        name: "town",
        description: "a street round a block of buildings, with traffic; the vehicle drives",
        revolutions: 10,
        make: scenes::town,
    },
    NamedScene {
        name: "street",
        description: "a straight street with traffic in both directions; the vehicle drives",
        revolutions: 10,
        make: street,
    },
    NamedScene {
        name: "flat",
        description: "flat ground with few obstacles; the vehicle stands",
        revolutions: 1,
        make: scenes::flat,
    },
    NamedScene {
        name: "slopes",
        description: "a road that falls and rises between banks and cars; the vehicle stands",
        revolutions: 1,
        make: scenes::slopes_with_obstacles,
    },
    NamedScene {
        name: "canopy",
        description: "a fenced road under branches; the vehicle stands",
        revolutions: 1,
        make: scenes::fenced_road_under_canopy,
    },
    NamedScene {
        name: "overhang",
        description: "the same road under a beam that is too low; the vehicle stands",
        revolutions: 1,
        make: scenes::fenced_road_with_low_overhang,
    },
    NamedScene {
        name: "track",
        description: "a dirt track between ploughed fields; the vehicle stands",
        revolutions: 1,
        make: scenes::dirt_track_between_fields,
    },
];

/// A straight street with traffic.
pub fn street() -> Scene {
    traffic::street(STREET_MPS)
}

/// The scene of this name; `None` if there is none.
pub fn find(name: &str) -> Option<&'static NamedScene> {
    SCENES.iter().find(|scene| scene.name == name)
}

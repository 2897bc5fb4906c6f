//! The table `[vehicle.maps.ground]`.

use serde::{Deserialize, Serialize};

/// How the height of a point over the ground is found.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GroundConfig {
    /// What heights are taken over. `local` is ours, because the world bends; the papers have `plane`.
    pub variant: Variant,
}

/// What heights are taken over.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Variant {
    /// The local ground, estimated once for each map and shared by all layers. Ground is free only where the vehicle
    /// can reach it.
    #[default]
    Local,
    /// The plane z = 0 under the vehicle, as in the four papers.
    Plane,
}

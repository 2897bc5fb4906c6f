//! The simulated world, the scenes in it, and the truth about them.

pub mod contact;
pub mod course;
pub mod ground;
pub mod object;
pub mod plan;
pub mod pose;
pub mod random;
pub mod scenes;
pub mod truth;
pub mod world;

//! A simulated vehicle: a world, a ray caster, and the inverse of the Velodyne decoder.
//!
//! In: a scene described object by object. Out: the datagrams its sensor would send, and the truth about the ground
//!
//! The files, in the order the data flows:
//!
//! | file | in -> out |
//! |---|---|
//! | [`ground`], [`object`], [`course`] | the parts a world is made of |
//! | [`world`] | a description -> [`world::World`] |
//! | [`scenes`] | the thesis' four scenes and a town |
//! | [`truth`] | world, pose, time -> which ground is drivable |
//! | [`plan`] | the same as text, seen from above |
//! | [`pose`] | scene, time -> where the vehicle is |
//! | [`raycast`] | world, rays -> what they meet |
//! | [`telemetry`] | place, speed, time -> 512-byte telemetry datagrams |
pub mod course;
pub mod ground;
pub mod noise;
pub mod object;
pub mod plan;
pub mod pose;
pub mod raycast;
pub mod scenes;
pub mod telemetry;
pub mod truth;
pub mod world;

//! A simulated vehicle: a world, a ray caster, and the inverse of the Velodyne decoder.
//!
//! In: a scene, described object by object. Out: the datagrams that its sensor would send, and the truth about the
//! ground around the vehicle. Everything is a pure function of the scene, the seed and the time, except [`real_time`]
//! and [`send`], which follow a clock.
//!
//! The files, in the order of the data:
//!
//! | file | in -> out |
//! |---|---|
//! | [`ground`], [`object`], [`course`] (`scene/`) | the parts of a world |
//! | [`world`] (`scene/`) | a description -> [`world::World`] |
//! | [`scenes`] (`scene/`) | the four scenes of the UT Austin thesis, a dirt track and a town |
//! | [`random`] (`scene/random/`) | seed -> a random world: its ground, its objects, the mount of its sensor |
//! | [`truth`] (`scene/`) | world, pose, time -> drivable ground |
//! | [`plan`] (`scene/`) | the same as text, seen from above |
//! | [`pose`] (`scene/`) | scene, time -> the vehicle's pose |
//! | [`contact`] (`scene/`) | world, a vehicle's place and size -> the object that it touches |
//! | [`raycast`] (`sensor/`) | world, rays -> the points that they meet |
//! | [`scanner`] (`sensor/`) | world, poses, properties of one sensor -> firings of raw returns |
//! | [`planes`] (`sensor/`) | world, poses, a unit of a few planes -> whole scans, with the rays without a return |
//! | [`encode`] (`sensor/`) | firings -> data packets of 1206 bytes |
//! | [`telemetry`] (`sensor/`) | place, speed, time -> telemetry datagrams of 512 bytes |
//! | [`traffic`] | six units of a few planes on a car in traffic, and the ground that each object covers |
//! | [`vehicle`] | a scene and a sensor -> an endless stream of datagrams |
//! | [`real_time`] | a vehicle and a clock -> its datagrams, except datagrams that a slow machine skips |
//! | [`impair`] | datagrams -> the datagrams that arrive through a bad network |
//! | [`send`] | datagrams -> UDP, paced by the clock |
//! | [`noise`] | key -> random number |

pub mod impair;
pub mod noise;
pub mod real_time;
mod scene;
pub mod send;
mod sensor;
pub mod traffic;
pub mod vehicle;

pub use scene::{contact, course, ground, object, plan, pose, random, scenes, truth, world};
pub use sensor::{encode, planes, raycast, scanner, telemetry};

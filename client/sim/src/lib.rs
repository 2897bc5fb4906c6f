//! A simulated vehicle: a world, a ray caster, and the inverse of the Velodyne decoder.
//!
//! In: a scene described object by object. Out: the datagrams its sensor would send, and the truth about the ground
//! around the vehicle. Everything but [`send`] is a pure function of the scene, the seed and the time.
//!
//! The files, in the order of the data. Those from `ground` to `pose` and `contact` are in `scene/`, those from `raycast`
//! to `planes`, `encode` and `telemetry` are in `sensor/`:
//!
//! | file | in -> out |
//! |---|---|
//! | [`ground`], [`object`], [`course`] | the parts a world is made of |
//! | [`world`] | a description -> [`world::World`] |
//! | [`scenes`] | the thesis' four scenes, a dirt track and a town |
//! | [`truth`] | world, pose, time -> which ground is drivable |
//! | [`plan`] | the same as text, seen from above |
//! | [`pose`] | scene, time -> where the vehicle is |
//! | [`raycast`] | world, rays -> what they meet |
//! | [`scanner`] | world, poses, one sensor's figures -> firings of raw returns |
//! | [`planes`] | world, poses, a unit of a few planes -> whole scans, with the rays that met nothing |
//! | [`traffic`] | six such units on a car in traffic, and the ground each object covers |
//! | [`contact`] | world, a vehicle's place and size -> what it touches |
//! | [`encode`] | firings -> 1206-byte data packets |
//! | [`telemetry`] | place, speed, time -> 512-byte telemetry datagrams |
//! | [`vehicle`] | all of the above: datagrams without end |
//! | [`impair`] | datagrams -> what a bad network leaves of them |
//! | [`send`] | datagrams -> UDP, paced by the clock |
//! | [`noise`] | chance by key, for all of them |

pub mod impair;
pub mod noise;
mod scene;
pub mod send;
mod sensor;
pub mod traffic;
pub mod vehicle;

pub use scene::{contact, course, ground, object, plan, pose, scenes, truth, world};
pub use sensor::{encode, planes, raycast, scanner, telemetry};

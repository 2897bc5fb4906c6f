//! A simulated vehicle: a world, a ray caster, and the inverse of the Velodyne decoder.
//!
//! In: a scene described object by object. Out: the datagrams its sensor would send, and the truth about the ground
//! around the vehicle. Everything but [`send`] is a pure function of the scene, the seed and the time.
//!
//! The files, in the order the data flows:
//!
//! | file | in -> out |
//! |---|---|
//! | [`ground`], [`object`], [`course`] | the parts a world is made of |
//! | [`world`] | a description -> [`world::World`] |
//! | [`scenes`] | the four scenes of the UT Austin thesis, a dirt track and a town |
//! | [`truth`] | world, pose, time -> drivable ground |
//! | [`plan`] | the same as text, seen from above |
//! | [`pose`] | scene, time -> the vehicle's pose |
//! | [`raycast`] | world, rays -> the points that they meet |
//! | [`scanner`] | world, poses, one sensor's constants -> firings of raw returns |
//! | [`planes`] | world, poses, a unit of a few planes -> whole scans, with the rays without a return |
//! | [`traffic`] | six such units on a car in traffic, and the ground each object covers |
//! | [`contact`] | world, a vehicle's place and size -> the object that it touches |
//! | [`encode`] | firings -> 1206-byte data packets |
//! | [`telemetry`] | place, speed, time -> 512-byte telemetry datagrams |
//! | [`vehicle`] | all of the above: datagrams without end |
//! | [`real_time`] | a vehicle and a clock -> its datagrams, but for what a slow machine skips |
//! | [`impair`] | datagrams -> those that arrive through a bad network |
//! | [`send`] | datagrams -> UDP, paced by the clock |
//! | [`noise`] | key -> random number |

pub mod contact;
pub mod course;
pub mod encode;
pub mod ground;
pub mod impair;
pub mod noise;
pub mod object;
pub mod plan;
pub mod planes;
pub mod pose;
pub mod raycast;
pub mod real_time;
pub mod scanner;
pub mod scenes;
pub mod send;
pub mod telemetry;
pub mod traffic;
pub mod truth;
pub mod vehicle;
pub mod world;

//! The state of vehicles for people.

pub mod servers;
pub mod table;

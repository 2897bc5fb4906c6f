//! The one command `clearway`. What runs on a vehicle is `clearway-daemon`.

pub mod cli;

//! What the decoder does with streams made here, sound and damaged.

mod bad_datagrams;
mod blocked;
mod calibration;
mod capture;
mod clock_scripts;
mod clocks;
mod corpora;
mod models;
mod order;
mod properties;
mod stream;
mod telemetry;
mod turns;
mod unit_table;

//! What the decoder does with streams made here, sound and damaged.

mod calibration;
mod capture;
mod clocks;
mod corpora;
mod models;
mod properties;
mod stream;
mod telemetry;
mod turns;
mod unit_table;
mod velodyne_scan;

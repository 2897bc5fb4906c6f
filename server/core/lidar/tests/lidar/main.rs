//! Tests of the decoder with generated streams, valid and damaged.

mod bad_datagrams;
mod blocked;
mod calibration;
mod capture;
mod clock;
mod clock_scripts;
mod corpora;
mod cut;
mod models;
mod order;
mod properties;
mod status_table;
mod stream;
mod telemetry;

//! Tests of the decoder with generated streams, valid and damaged, and with packets recorded all over the world.

mod calibration;
mod capture;
mod clock;
mod corpora;
mod properties;
mod revolutions;
mod stream;
mod telemetry;
mod world;

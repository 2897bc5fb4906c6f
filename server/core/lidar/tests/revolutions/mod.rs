//! From datagrams to revolutions: order, cuts, models, faults of the sensor.

mod bad_datagrams;
mod blocked;
mod cut;
mod models;
mod order;
mod status_table;

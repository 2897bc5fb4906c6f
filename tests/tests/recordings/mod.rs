//! Recordings: how they are made, damaged, read, and kept in a store.

mod black_box;
mod damage;
mod foreign;
mod recorder;
mod recording;
mod sizes;
mod store;

//! Each layer by its paper, and what every layer guarantees.

mod contract;
mod criteria;
mod freespace;
mod occupancy;
mod own_outline;
mod properties;
mod safe_path;
mod scenes;
mod speed;
mod terrain;

//! Simulated vehicles that drive by the maps, and the whole system under faults.

mod drive;
mod simulation;

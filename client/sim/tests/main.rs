//! Tests of the simulator: its worlds, its sensors, its vehicles, and the faults it can inject.

mod decoder_agrees;
mod drive;
mod impair;
mod plans;

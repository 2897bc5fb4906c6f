//! Drives as people record them: bags and captures with the faults that drivers and recorders have.

mod bags;
mod believed;
mod captures;
mod exported;
mod folders;
mod manufacturers;
mod scene;

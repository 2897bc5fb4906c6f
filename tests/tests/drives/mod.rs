//! Drives as people record them: bags and captures with the faults that drivers and recorders have.

mod bags;
mod captures;
mod folders;
mod manufacturers;
mod scene;

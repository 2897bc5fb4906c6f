//! Tests of the command `clearway`, run as a user runs it.

mod command;
mod common;
mod corpus;
mod export;
mod get;
mod replayed;
mod send;
mod stalls;
mod verify;

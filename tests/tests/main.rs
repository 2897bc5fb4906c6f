//! Tests of the whole system, in one binary: `cargo test --workspace --test system`, with a folder or a name behind it.
//!
//! | folder | what it tests |
//! |---|---|
//! | `drives` | bags, captures and scans with the faults that drivers and recorders have; other manufacturers |
//! | `ingest` | what comes in: datagrams, observations, ROS 2, many sensors |
//! | `readers` | what goes out: gRPC, zenoh, ROS 2, Foxglove, Python |
//! | `listeners` | who may do what: certificates, roles, attacks |
//! | `network` | several servers and vehicles, routers, links that fail |
//! | `recordings` | the recorder, damage, sizes, files of other programs, stores |
//! | `replays` | recorded drives, a replay that is controlled, `evaluate` |
//! | `simulated` | drives in the simulated town, and the whole system under drawn faults |
//! | `page` | the page in a browser |
//! | `operation` | status, metrics, traces, packages, guides |
//! | `repository` | the README's commands, and the rules that no compiler holds |

mod drives;
mod fixture;
mod ingest;
mod listeners;
mod network;
mod operation;
mod page;
mod readers;
mod recordings;
mod replays;
mod repository;
mod simulated;

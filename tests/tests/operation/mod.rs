//! What an operator has: status, metrics, traces, packages and guides.

mod deploy;
mod status;
mod traces;

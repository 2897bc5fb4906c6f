//! Several servers and vehicles in one network.

mod fleet;
mod machines;
mod routers;
mod servers;

//! Files -> observations, with their stamps -> a server.

mod items;
mod packets;
pub mod plan;
pub mod sender;

//! The options that name a server -> a client, and its maps.

mod maps;
#[cfg(feature = "tools")]
mod newest;
mod server;

pub use maps::MapOptions;
#[cfg(feature = "tools")]
pub use newest::newest;
pub use server::{ServerOptions, explain};

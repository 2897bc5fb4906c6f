//! Tests that need one thing of the machine for themselves run one at a time; all others run beside them.

use std::sync::{Mutex, MutexGuard, PoisonError};

/// A group of tests that run one at a time.
pub struct SerialGroup(Mutex<()>);

/// A browser without a graphics card draws with all processors: beside a second one it answers a click after half a
/// minute or never.
pub static BROWSER: SerialGroup = SerialGroup(Mutex::new(()));
/// The machines of a simulated network have the processors and the clocks of the host.
pub static NAMESPACES: SerialGroup = SerialGroup(Mutex::new(()));
/// Packages, images and their guides: each builds and unpacks a system.
pub static PACKAGES: SerialGroup = SerialGroup(Mutex::new(()));
/// The ports of the default configuration: the demo and a server without options use the same ports.
pub static DEFAULT_PORTS: SerialGroup = SerialGroup(Mutex::new(()));

impl SerialGroup {
    /// Waits until no other test of the group runs. The group is free again when the guard is dropped, also by a test
    /// that fails.
    pub fn enter(&self) -> MutexGuard<'_, ()> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

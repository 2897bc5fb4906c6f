//! The newest map of each vehicle -> whoever asks: gRPC, zenoh, ROS 2, Foxglove, the page. All of them look at the same
//! slots and send the same bytes, or what they decode from them; none of them can hold up an engine.

use std::sync::Arc;

use tokio::sync::watch;

use crate::directory::{UnknownNameError, find_vehicle};
use crate::newest::Newest;
use crate::status::VehicleStatus;

pub mod connections;
pub mod foxglove;
pub mod grpc;
pub mod page;
#[cfg(feature = "zenoh")]
mod ros;
#[cfg(feature = "zenoh")]
pub mod zenoh;

/// One vehicle, as publishers see it.
#[derive(Clone, Debug)]
pub struct Served {
    /// Ledger, rates, readers.
    pub status: Arc<VehicleStatus>,
    /// The newest map; closed when the vehicle's engine stops.
    pub newest: watch::Receiver<Newest>,
}

/// All vehicles, in the order of the configuration.
#[derive(Clone, Debug, Default)]
pub struct Vehicles(pub Arc<[Served]>);

impl Vehicles {
    /// The vehicle of this name; the only one where `name` is empty.
    ///
    /// # Errors
    /// [`UnknownNameError::Vehicle`], listing the known ones.
    pub fn find(&self, name: &str) -> Result<&Served, UnknownNameError> {
        find_vehicle(&self.0, name, |served| &served.status.name)
    }

    /// The status of every vehicle.
    pub fn statuses(&self) -> Vec<Arc<VehicleStatus>> {
        self.0.iter().map(|served| served.status.clone()).collect()
    }
}

impl Served {
    /// Whether the vehicle's maps have all these layers.
    ///
    /// # Errors
    /// [`UnknownNameError::Layer`] for the first that they have not, listing the known ones.
    pub fn check_layers(&self, layers: &[String]) -> Result<(), UnknownNameError> {
        let known = &self.status.layers;
        match layers.iter().find(|layer| !known.contains(&layer.as_str())) {
            None => Ok(()),
            Some(name) => Err(UnknownNameError::Layer {
                name: name.clone(),
                vehicle: self.status.name.to_string(),
                known: known.join(", "),
            }),
        }
    }
}

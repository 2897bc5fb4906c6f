//! The newest map of each vehicle -> whoever asks: gRPC, zenoh, ROS 2, Foxglove, the page. All of them look at the same
//! slots and send the same bytes, or what they decode from them; none of them can hold up an engine.

use std::sync::Arc;

use tokio::sync::watch;

use crate::engine::Newest;
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

/// A reader asked for something that is not there.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Unknown {
    /// No vehicle of this name, or none named where there are several.
    #[error("vehicle {name:?} is not known; known: {known}")]
    Vehicle {
        /// What was asked for.
        name: String,
        /// What there is.
        known: String,
    },
    /// No sensor of this name, or none named where there are several.
    #[error("sensor {name:?} is not known; vehicle {vehicle} has: {known}")]
    Sensor {
        /// What was named.
        name: String,
        /// Whose.
        vehicle: String,
        /// What there is.
        known: String,
    },
    /// No layer of this name.
    #[error("layer {name:?} is not known; vehicle {vehicle} has: {known}")]
    Layer {
        /// What was asked for.
        name: String,
        /// Whose.
        vehicle: String,
        /// What there is.
        known: String,
    },
}

impl Vehicles {
    /// The vehicle of this name; the only one where `name` is empty.
    ///
    /// # Errors
    /// [`Unknown::Vehicle`], listing the known ones.
    pub fn find(&self, name: &str) -> Result<&Served, Unknown> {
        if let ("", [only]) = (name, &self.0[..]) {
            return Ok(only);
        }
        self.0.iter().find(|served| &*served.status.name == name).ok_or_else(|| {
            let known: Vec<&str> = self.0.iter().map(|served| &*served.status.name).collect();
            Unknown::Vehicle { name: name.to_owned(), known: known.join(", ") }
        })
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
    /// [`Unknown::Layer`] for the first that they have not, listing the known ones.
    pub fn check_layers(&self, layers: &[String]) -> Result<(), Unknown> {
        let known = &self.status.layers;
        match layers.iter().find(|layer| !known.contains(&layer.as_str())) {
            None => Ok(()),
            Some(name) => Err(Unknown::Layer {
                name: name.clone(),
                vehicle: self.status.name.to_string(),
                known: known.join(", "),
            }),
        }
    }
}

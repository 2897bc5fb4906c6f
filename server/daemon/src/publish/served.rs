//! The vehicles that are served: status and newest map of each.

use std::sync::Arc;

use tokio::sync::watch;

use crate::base::directory::{UnknownNameError, find_vehicle, shortened};
use crate::config::Ros;
use crate::engine::newest::Newest;
use crate::engine::wires::Wires;
use crate::publish::listen::access::Caller;
use crate::status::VehicleStatus;
use crate::viewer::FrameNames;

/// One vehicle, as publishers use it.
#[derive(Clone, Debug)]
pub struct Served {
    /// Status: ledger, rates, readers.
    pub status: Arc<VehicleStatus>,
    /// The newest map; the channel closes when the vehicle's engine stops.
    pub newest: watch::Receiver<Newest>,
    /// The other channels to the vehicle's engine.
    pub wires: Wires,
    /// The vehicle's frames in ROS 2.
    pub frames: FrameNames,
}

/// All vehicles, in the order of the configuration.
#[derive(Clone, Debug, Default)]
pub struct Vehicles(pub Arc<[Served]>);

impl Vehicles {
    /// The vehicle with this name; the only vehicle if `name` is empty.
    ///
    /// # Errors
    /// [`UnknownNameError::Vehicle`] with the known names if there is no such vehicle, or several and `name` is empty.
    pub fn find(&self, name: &str) -> Result<&Served, UnknownNameError> {
        find_vehicle(&self.0, name, |served| &served.status.name)
    }

    /// True if a fresh map of at least one vehicle is made: the fault of one vehicle must not cost the planners of the
    /// others their server.
    pub fn are_ready(&self) -> bool {
        is_any_ready(&self.reasons())
    }

    /// What [`Vehicles::are_ready`] tells, and a line for each vehicle in error that a client may reach, with the worst
    /// reason. Each vehicle is asked once, so that no vehicle makes the server ready and stands among those in error.
    pub fn readiness(&self, caller: &Caller) -> (bool, String) {
        let reasons = self.reasons();
        let is_ready = is_any_ready(&reasons);
        let reachable = reasons.into_iter().filter(|(name, _)| caller.may_reach(name));
        let line = |(name, reason): (&str, Option<String>)| Some(format!("vehicle {name}: {}\n", reason?));
        (is_ready, reachable.filter_map(line).collect())
    }

    /// Each vehicle's name, and why it is not ready; `None` if it is.
    fn reasons(&self) -> Vec<(&str, Option<String>)> {
        self.0.iter().map(|served| (&*served.status.name, served.status.not_ready())).collect()
    }

    /// The status of every vehicle.
    pub fn statuses(&self) -> Vec<Arc<VehicleStatus>> {
        self.0.iter().map(|served| served.status.clone()).collect()
    }
}

/// True if one of these vehicles is ready, or there is none.
fn is_any_ready(reasons: &[(&str, Option<String>)]) -> bool {
    reasons.is_empty() || reasons.iter().any(|(_, reason)| reason.is_none())
}

impl Served {
    /// A vehicle with the frames of its table `[vehicle.ros]`, if it has one.
    pub fn new(status: Arc<VehicleStatus>, newest: watch::Receiver<Newest>, wires: Wires, ros: Option<&Ros>) -> Self {
        let frames = FrameNames::new(&status.name, ros);
        Self { status, newest, wires, frames }
    }

    /// Checks that the vehicle's maps have all these layers.
    ///
    /// # Errors
    /// [`UnknownNameError::Layer`] for the first layer that the maps do not have, with the known layers.
    pub fn check_layers(&self, layers: &[String]) -> Result<(), UnknownNameError> {
        let known = &self.status.layers;
        match layers.iter().find(|layer| !known.contains(&layer.as_str())) {
            None => Ok(()),
            Some(name) => Err(UnknownNameError::Layer {
                name: shortened(name),
                vehicle: self.status.name.to_string(),
                known: known.join(", "),
            }),
        }
    }
}

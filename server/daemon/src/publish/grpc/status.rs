//! The updates of `WatchStatus`: the state of vehicles at once, then once a second and at each change of a state.

use std::sync::Arc;
use std::time::Duration;

use clearway_proto::v1;
use futures::{Stream, stream};
use tokio::time::MissedTickBehavior;
use tonic::Status;

use crate::base::clock::now_ns;
use crate::publish::listen::access::Caller;
use crate::publish::served::Vehicles;
use crate::status::{VehicleStatus, state_changed};

/// Time between two updates without a change of a state.
const PERIOD: Duration = Duration::from_secs(1);

/// The vehicles with these names that a client may reach, in the order of the configuration; all of them if `names` is
/// empty.
///
/// # Errors
/// `NotFound` for an unknown name, `PermissionDenied` for a vehicle that the client may not reach.
pub(super) fn selected(
    vehicles: &Vehicles,
    caller: &Caller,
    names: &[String],
) -> Result<Vec<Arc<VehicleStatus>>, Status> {
    for name in names {
        caller.check_vehicle(&vehicles.find(name)?.status.name)?;
    }
    let is_selected = |status: &Arc<VehicleStatus>| {
        caller.may_reach(&status.name) && (names.is_empty() || names.iter().any(|name| **name == *status.name))
    };
    Ok(vehicles.statuses().into_iter().filter(is_selected).collect())
}

/// The updates. The transport polls the stream when it has room for one, so a late reader gets the newest state.
pub(super) fn watch(
    statuses: Vec<Arc<VehicleStatus>>,
) -> impl Stream<Item = Result<v1::WatchStatusResponse, Status>> + Send {
    let mut every = tokio::time::interval(PERIOD);
    every.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let states: Vec<_> = statuses.iter().map(|status| status.states()).collect();
    stream::unfold((statuses, states, every), |(statuses, mut states, mut every)| async move {
        tokio::select! {
            _ = every.tick() => {}
            () = state_changed(&mut states) => {}
        }
        let vehicles = statuses.iter().map(|status| status.to_proto()).collect();
        let update = v1::WatchStatusResponse { vehicles, sent_ns: now_ns() };
        Some((Ok(update), (statuses, states, every)))
    })
}

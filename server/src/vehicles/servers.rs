//! Vehicles of several servers -> the name of the server of each.

use std::collections::BTreeSet;

use clearway_client::v1;
use clearway_daemon::status::run_text;

/// True if the vehicles belong to several runs of servers.
pub fn is_of_several_servers(vehicles: &[v1::Vehicle]) -> bool {
    vehicles.iter().map(|vehicle| vehicle.boot_id).collect::<BTreeSet<_>>().len() > 1
}

/// The server of a vehicle: its host, and its address or, if it announces none, its run. Two servers on one host have
/// different texts.
pub fn server_text(vehicle: &v1::Vehicle) -> String {
    let host = if vehicle.server.is_empty() { "unknown host" } else { &vehicle.server };
    match vehicle.grpc.is_empty() {
        true => format!("{host} ({})", run_text(vehicle.boot_id)),
        false => format!("{host} ({})", vehicle.grpc),
    }
}

//! Access control of every listener: the names of a client -> its roles -> the RPCs and paths it may use, and the
//! vehicles and layers it may reach.
//!
//! Without `grpc.tls.client_ca` every client may use everything. With it, every call is denied that [`RPCS`], [`PATHS`]
//! and `[grpc.access]` do not allow; a test holds [`RPCS`] equal to the wire contract.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use axum::http::Response;
use tonic::{Code, Status};

use crate::config::{self, Only};

/// Role of a client.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Role {
    /// May read maps and status.
    Reader,
    /// May send scans, poses, roads, packets and plans.
    Ingester,
    /// May do both, and control the recorder and a replay.
    Operator,
}

impl Role {
    /// The name in the configuration's keys and in errors.
    fn as_str(self) -> &'static str {
        match self {
            Self::Reader => "reader",
            Self::Ingester => "ingester",
            Self::Operator => "operator",
        }
    }
}

/// Every RPC, and the roles that may call it; operators may call all. Every role may call health and reflection.
pub const RPCS: &[(&str, &[Role])] = &[
    ("/clearway.v1.MapService/Watch", &[Role::Reader]),
    ("/clearway.v1.MapService/GetMap", &[Role::Reader]),
    ("/clearway.v1.MapService/ListVehicles", &[Role::Reader, Role::Ingester]),
    ("/clearway.v1.MapService/WatchStatus", &[Role::Reader, Role::Ingester]),
    ("/clearway.v1.IngestService/Stream", &[Role::Ingester]),
    ("/clearway.v1.PlanService/Send", &[Role::Ingester]),
    ("/clearway.v1.RecordingService/Start", &[Role::Operator]),
    ("/clearway.v1.RecordingService/Stop", &[Role::Operator]),
    ("/clearway.v1.RecordingService/Split", &[Role::Operator]),
    ("/clearway.v1.RecordingService/Save", &[Role::Operator]),
    ("/clearway.v1.RecordingService/List", &[Role::Operator]),
    ("/clearway.v1.RecordingService/Status", &[Role::Operator]),
    ("/clearway.v1.ReplayService/Control", &[Role::Operator]),
    ("/clearway.v1.ReplayService/WatchState", &[Role::Reader]),
    ("/grpc.health.v1.Health/Check", &[Role::Reader, Role::Ingester]),
    ("/grpc.health.v1.Health/Watch", &[Role::Reader, Role::Ingester]),
    ("/grpc.reflection.v1.ServerReflection/ServerReflectionInfo", &[Role::Reader, Role::Ingester]),
];

/// How the RPCs of the recorder begin.
const RECORDING: &str = "/clearway.v1.RecordingService/";

/// The paths of the page, the metrics and Foxglove, and the roles that may use them; operators may use all. Every
/// client may use a path without roles. Every other path is a file of the page.
pub const PATHS: &[(&str, &[Role])] = &[
    ("/healthz", &[]),
    ("/readyz", &[]),
    ("/metrics", &[Role::Reader, Role::Ingester]),
    ("/vehicles", &[Role::Reader, Role::Ingester]),
    ("/history", &[Role::Reader, Role::Ingester]),
    ("/live", &[Role::Reader]),
    (FILES, &[Role::Reader]),
];
/// Stands in [`PATHS`] for the files of the page, and for Foxglove's WebSocket.
const FILES: &str = "/";

/// The roles of the names in certificates and of the names of tokens, and what the names are limited to.
#[derive(Clone, Debug, Default)]
pub struct Access {
    roles: BTreeMap<String, BTreeSet<Role>>,
    only: BTreeMap<String, Only>,
}

/// What the client of one call may reach. The default may reach nothing.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Caller {
    limits: Arc<[Only]>,
    is_operator: bool,
}

/// What the client of a request may reach.
pub fn caller<T>(request: &tonic::Request<T>) -> Caller {
    request.extensions().get().cloned().unwrap_or_default()
}

impl Caller {
    /// A client that may do and reach everything.
    pub fn unlimited() -> Self {
        Self { limits: [Only::default()].into(), is_operator: true }
    }

    /// True if the client may do what only operators may.
    pub fn is_operator(&self) -> bool {
        self.is_operator
    }

    /// True if the client may reach every vehicle and every layer.
    fn is_unlimited(&self) -> bool {
        self.limits.iter().any(|only| only.vehicles.is_empty() && only.layers.is_empty())
    }

    /// True if the client may control the recorder: a recording holds every vehicle and every layer.
    pub fn may_record(&self) -> bool {
        self.is_operator && self.is_unlimited()
    }

    fn limits_for(&self, vehicle: &str) -> impl Iterator<Item = &Only> {
        let is_for = move |only: &&Only| only.vehicles.is_empty() || only.vehicles.iter().any(|name| name == vehicle);
        self.limits.iter().filter(is_for)
    }

    /// True if the client may reach this vehicle.
    pub fn may_reach(&self, vehicle: &str) -> bool {
        self.limits_for(vehicle).next().is_some()
    }

    /// True if the client may read this layer of this vehicle.
    pub fn may_read(&self, vehicle: &str, layer: &str) -> bool {
        self.limits_for(vehicle).any(|only| only.layers.is_empty() || only.layers.iter().any(|name| name == layer))
    }

    /// Checks that the client may reach this vehicle.
    ///
    /// # Errors
    /// `PermissionDenied` with the vehicle.
    pub fn check_vehicle(&self, vehicle: &str) -> Result<(), Status> {
        match self.may_reach(vehicle) {
            true => Ok(()),
            false => Err(Status::permission_denied(format!("vehicle {vehicle}: not allowed by grpc.access.only"))),
        }
    }

    /// The layers of a vehicle that a client gets which wants `wanted` (empty: all that it may read). Empty again if
    /// these are all the vehicle's layers.
    ///
    /// # Errors
    /// `PermissionDenied` with the first wanted layer that the client may not read, or if it may read none.
    pub fn layers(&self, vehicle: &str, wanted: Vec<String>, all: &[&'static str]) -> Result<Vec<String>, Status> {
        self.check_vehicle(vehicle)?;
        let denied =
            |what: &str| Status::permission_denied(format!("{what} of {vehicle}: not allowed by grpc.access.only"));
        if !wanted.is_empty() {
            let refused = wanted.iter().find(|layer| !self.may_read(vehicle, layer));
            return refused.map_or(Ok(wanted.clone()), |layer| Err(denied(&format!("layer {layer}"))));
        }
        let readable: Vec<String> =
            all.iter().filter(|layer| self.may_read(vehicle, layer)).map(|&layer| layer.to_owned()).collect();
        match readable.len() {
            0 if !all.is_empty() => Err(denied("every layer")),
            count if count == all.len() => Ok(Vec::new()),
            _ => Ok(readable),
        }
    }
}

impl Access {
    /// The configured roles; a name may stand in several lists.
    pub fn new(config: &config::Access) -> Self {
        let lists =
            [(Role::Reader, &config.readers), (Role::Ingester, &config.ingesters), (Role::Operator, &config.operators)];
        let mut roles: BTreeMap<String, BTreeSet<Role>> = BTreeMap::new();
        for (role, names) in lists {
            for name in names {
                roles.entry(name.clone()).or_default().insert(role);
            }
        }
        Self { roles, only: config.only.clone() }
    }

    /// True if one of these names has a role.
    pub fn knows(&self, names: &[String]) -> bool {
        names.iter().any(|name| self.roles.contains_key(name))
    }

    /// Checks that a client with these names may call the RPC `path`; returns what it may reach.
    ///
    /// # Errors
    /// `PermissionDenied` with the names, their roles and the roles that are allowed, if none of its roles is allowed;
    /// or if the recorder is asked for and the client is limited to some vehicles or layers.
    pub fn check(&self, path: &str, names: &[String]) -> Result<Caller, Status> {
        let allowed = RPCS.iter().find(|(rpc, _)| *rpc == path).map_or(&[][..], |(_, allowed)| allowed);
        let caller = self.check_roles(path, allowed, names)?;
        match caller.may_record() || !path.starts_with(RECORDING) {
            true => Ok(caller),
            false => Err(Status::permission_denied(format!(
                "{path}: a recording holds every vehicle and layer, and grpc.access.only limits [{}]",
                names.join(", ")
            ))),
        }
    }

    /// As [`check`](Self::check), for a path of the page, the metrics and Foxglove.
    ///
    /// # Errors
    /// As [`check`](Self::check).
    pub fn check_path(&self, path: &str, names: &[String]) -> Result<Caller, Status> {
        match roles_for(path) {
            // Every client is answered, with what its roles let it reach.
            [] => Ok(self.check_roles(path, &[Role::Reader, Role::Ingester], names).unwrap_or_default()),
            allowed => self.check_roles(path, allowed, names),
        }
    }

    fn check_roles(&self, path: &str, allowed: &[Role], names: &[String]) -> Result<Caller, Status> {
        let roles_of = |name: &String| self.roles.get(name).into_iter().flatten().copied();
        let is_allowed = |role: Role| !allowed.is_empty() && (role == Role::Operator || allowed.contains(&role));
        let admitted: Vec<_> = names.iter().filter(|name| roles_of(name).any(is_allowed)).collect();
        if !admitted.is_empty() {
            let is_operator = admitted.iter().any(|name| roles_of(name).any(|role| role == Role::Operator));
            let limits = admitted.into_iter().map(|name| self.only.get(name).cloned().unwrap_or_default());
            return Ok(Caller { limits: limits.collect(), is_operator });
        }
        let list = |roles: &mut dyn Iterator<Item = Role>| roles.map(Role::as_str).collect::<Vec<_>>().join(", ");
        let operator = (!allowed.is_empty() && !allowed.contains(&Role::Operator)).then_some(Role::Operator);
        let allowed = list(&mut allowed.iter().copied().chain(operator));
        let roles = list(&mut names.iter().flat_map(roles_of).collect::<BTreeSet<_>>().into_iter());
        let names = names.join(", ");
        Err(Status::permission_denied(format!(
            "{path}: certificate or token of [{names}] with the roles [{roles}]; allowed roles are [{allowed}]"
        )))
    }
}

/// The roles that may use a path of [`PATHS`]; none: every client may.
fn roles_for(path: &str) -> &'static [Role] {
    let listed = PATHS.iter().find(|(listed, _)| *listed == path);
    listed.or_else(|| PATHS.last()).map_or(&[], |(_, roles)| roles)
}

/// The word under which a call is counted that a gRPC service has answered with a refusal instead of a stream.
pub(super) fn refusal<B>(response: &Response<B>) -> Option<&'static str> {
    match Code::from_bytes(response.headers().get("grpc-status")?.as_bytes()) {
        Code::PermissionDenied => Some("denied"),
        Code::NotFound => Some("unknown_vehicle"),
        Code::DeadlineExceeded => Some("no_request"),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use clearway_proto::DESCRIPTORS;
    use prost::Message;
    use prost_types::FileDescriptorSet;

    use super::*;

    #[test]
    fn a_refused_call_is_counted_under_one_word_and_an_answered_call_under_none() {
        let word = |status: Status| refusal(&status.into_http::<()>());
        assert_eq!(word(Status::permission_denied("vehicle van")), Some("denied"));
        assert_eq!(word(Status::not_found("truck")), Some("unknown_vehicle"));
        assert_eq!(word(Status::deadline_exceeded("no selection")), Some("no_request"));
        assert_eq!(refusal(&Response::new(())), None);
    }

    #[test]
    fn the_list_of_rpcs_is_that_of_the_wire_contract() {
        let mut rpcs = BTreeSet::new();
        let sets = [DESCRIPTORS, tonic_health::pb::FILE_DESCRIPTOR_SET, tonic_reflection::pb::v1::FILE_DESCRIPTOR_SET];
        for set in sets {
            for file in FileDescriptorSet::decode(set).unwrap().file {
                for service in &file.service {
                    let methods = service.method.iter().map(|method| method.name());
                    rpcs.extend(methods.map(|method| format!("/{}.{}/{method}", file.package(), service.name())));
                }
            }
        }
        let listed: BTreeSet<_> = RPCS.iter().map(|(rpc, _)| (*rpc).to_owned()).collect();
        assert_eq!(listed, rpcs);
        assert_eq!(listed.len(), RPCS.len(), "each RPC once");
    }

    #[test]
    fn an_operator_who_is_limited_to_some_vehicles_or_layers_does_not_reach_the_recorder() {
        let only = |vehicle: &[&str], layers: &[&str]| Only {
            vehicles: vehicle.iter().map(|&name| name.to_owned()).collect(),
            layers: layers.iter().map(|&name| name.to_owned()).collect(),
        };
        let operators = ["workshop", "of-car", "of-speed"].map(str::to_owned);
        let limits = [("of-car", only(&["car"], &[])), ("of-speed", only(&[], &["speed"]))];
        let access = Access::new(&config::Access {
            operators: operators.into(),
            only: limits.into_iter().map(|(name, only)| (name.to_owned(), only)).collect(),
            ..config::Access::default()
        });
        for (path, _) in RPCS.iter().filter(|(path, _)| path.starts_with(RECORDING)) {
            assert!(access.check(path, &["workshop".into()]).unwrap().may_record(), "{path}");
            for limited in ["of-car", "of-speed"] {
                let denied = access.check(path, &[limited.into()]).unwrap_err();
                assert!(denied.message().contains(limited), "{path}: {}", denied.message());
            }
        }
        assert!(!access.check_path("/live", &["of-car".into()]).unwrap().may_record(), "the page shows no buttons");
        assert!(access.check("/clearway.v1.MapService/Watch", &["of-car".into()]).is_ok());
    }

    #[test]
    fn every_call_is_denied_that_is_not_allowed() {
        let config = config::Access {
            readers: vec!["planner".into()],
            ingesters: vec!["lidar-gateway".into()],
            operators: vec!["workshop".into()],
            ..config::Access::default()
        };
        let access = Access::new(&config);
        let may = |name: &str, path: &str| access.check(path, &[name.to_owned()]).is_ok();
        for (path, allowed) in RPCS {
            assert_eq!(may("planner", path), allowed.contains(&Role::Reader), "{path}");
            assert_eq!(may("lidar-gateway", path), allowed.contains(&Role::Ingester), "{path}");
            assert!(may("workshop", path) && !may("unknown", path), "{path}");
            assert!(access.check(path, &[]).is_err(), "{path}");
        }
        assert!(!may("workshop", "/clearway.v1.MapService/Erase"), "an unknown RPC");
        let denied = access.check("/clearway.v1.MapService/Watch", &["lidar-gateway".into()]).unwrap_err();
        assert_eq!(denied.code(), tonic::Code::PermissionDenied);
        assert_eq!(
            denied.message(),
            "/clearway.v1.MapService/Watch: certificate or token of [lidar-gateway] with the roles [ingester]; \
             allowed roles are [reader, operator]"
        );
    }
}

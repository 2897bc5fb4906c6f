//! Access control of gRPC: the names in a client's certificate -> its roles -> the RPCs it may call.
//!
//! Without `grpc.tls.client_ca` no client certificate is required, and every client may call everything. With it, every
//! call is denied that [`RPCS`] and `[grpc.access]` do not allow; a test holds [`RPCS`] equal to the wire contract.

use std::collections::{BTreeMap, BTreeSet};
use std::future::{Ready, ready};
use std::sync::Arc;
use std::task::{Context, Poll};

use futures::future::Either;
use tonic::Status;
use tonic::body::Body;
use tonic::codegen::http::{Request, Response};
use tonic::transport::server::TlsConnectInfo;
use tower_layer::Layer;
use tower_service::Service;
use x509_parser::extensions::GeneralName;
use x509_parser::prelude::{FromDer, X509Certificate};

use crate::config;
use crate::publish::connections::Admission;

/// Role of a client.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Role {
    /// May read maps and status.
    Reader,
    /// May send scans, poses, roads and packets.
    Ingester,
    /// May do both.
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
    ("/clearway.v1.IngestService/Stream", &[Role::Ingester]),
    ("/clearway.v1.ReplayService/Control", &[Role::Operator]),
    ("/clearway.v1.ReplayService/WatchState", &[Role::Reader]),
    ("/grpc.health.v1.Health/Check", &[Role::Reader, Role::Ingester]),
    ("/grpc.health.v1.Health/Watch", &[Role::Reader, Role::Ingester]),
    ("/grpc.reflection.v1.ServerReflection/ServerReflectionInfo", &[Role::Reader, Role::Ingester]),
    ("/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo", &[Role::Reader, Role::Ingester]),
];

/// The roles of the names in certificates.
#[derive(Clone, Debug, Default)]
pub struct Access {
    roles: BTreeMap<String, BTreeSet<Role>>,
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
        Self { roles }
    }

    /// Checks that a client with these names in its certificate may call `path`.
    ///
    /// # Errors
    /// `PermissionDenied` with the names, their roles and the roles that are allowed, if none of its roles is allowed.
    pub fn check(&self, path: &str, names: &[String]) -> Result<(), Status> {
        let roles: BTreeSet<Role> = names.iter().filter_map(|name| self.roles.get(name)).flatten().copied().collect();
        let allowed = RPCS.iter().find(|(rpc, _)| *rpc == path).map_or(&[][..], |(_, allowed)| allowed);
        let known = !allowed.is_empty();
        if known && (roles.contains(&Role::Operator) || allowed.iter().any(|role| roles.contains(role))) {
            return Ok(());
        }
        let list = |roles: &mut dyn Iterator<Item = Role>| roles.map(Role::as_str).collect::<Vec<_>>().join(", ");
        let allowed = list(
            &mut allowed.iter().copied().chain((known && !allowed.contains(&Role::Operator)).then_some(Role::Operator)),
        );
        let (names, roles) = (names.join(", "), list(&mut roles.into_iter()));
        Err(Status::permission_denied(format!(
            "{path}: certificate of [{names}] with the roles [{roles}]; allowed roles are [{allowed}]"
        )))
    }
}

/// A tower layer that lets through calls within the connection limit that [`Access`] allows; `None` allows every call.
#[derive(Clone, Debug)]
pub struct Guard(pub Option<Arc<Access>>);

impl<S> Layer<S> for Guard {
    type Service = Guarded<S>;

    fn layer(&self, inner: S) -> Guarded<S> {
        Guarded { inner, access: self.0.clone() }
    }
}

/// A service behind a [`Guard`].
#[derive(Clone, Debug)]
pub struct Guarded<S> {
    inner: S,
    access: Option<Arc<Access>>,
}

impl<S, B> Service<Request<B>> for Guarded<S>
where
    S: Service<Request<B>, Response = Response<Body>>,
{
    type Response = Response<Body>;
    type Error = S::Error;
    type Future = Either<S::Future, Ready<Result<Response<Body>, S::Error>>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), S::Error>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, request: Request<B>) -> Self::Future {
        let allowed =
            || self.access.as_ref().map_or(Ok(()), |access| access.check(request.uri().path(), &names(&request)));
        match check_admission(&request).and_then(|()| allowed()).err() {
            None => Either::Left(self.inner.call(request)),
            Some(status) => {
                tracing::info!(status = status.message(), "denied");
                Either::Right(ready(Ok(status.into_http())))
            }
        }
    }
}

fn check_admission<B>(request: &Request<B>) -> Result<(), Status> {
    let encrypted = request.extensions().get::<TlsConnectInfo<Admission>>().map(|tls| *tls.get_ref());
    match encrypted.or_else(|| request.extensions().get().copied()) {
        Some(Admission::OverLimit(connections_max)) => Err(Status::resource_exhausted(format!(
            "{connections_max} connections are open, which grpc.connections_max allows; try again when one is closed"
        ))),
        Some(Admission::Served) | None => Ok(()),
    }
}

/// The names in the client's own certificate, which the handshake has checked against `client_ca`: common name and DNS
/// names.
fn names<B>(request: &Request<B>) -> Vec<String> {
    let certificates = request.extensions().get::<TlsConnectInfo<Admission>>().and_then(TlsConnectInfo::peer_certs);
    let Some(certificate) = certificates.as_ref().and_then(|chain| chain.first()) else { return Vec::new() };
    // A certificate that does not parse has no name, and so no role.
    let Ok((_, certificate)) = X509Certificate::from_der(certificate) else { return Vec::new() };
    let common = certificate.subject().iter_common_name().filter_map(|name| name.as_str().ok());
    let mut names: Vec<String> = common.map(str::to_owned).collect();
    if let Ok(Some(alternatives)) = certificate.subject_alternative_name() {
        names.extend(alternatives.value.general_names.iter().filter_map(|name| match name {
            GeneralName::DNSName(name) => Some((*name).to_owned()),
            _ => None,
        }));
    }
    names.sort_unstable();
    names.dedup();
    names
}

#[cfg(test)]
mod tests {
    use clearway_proto::DESCRIPTORS;
    use prost::Message;
    use prost_types::FileDescriptorSet;

    use super::*;

    #[test]
    fn the_list_of_rpcs_is_that_of_the_wire_contract() {
        let mut rpcs = BTreeSet::new();
        let sets = [
            DESCRIPTORS,
            tonic_health::pb::FILE_DESCRIPTOR_SET,
            tonic_reflection::pb::v1::FILE_DESCRIPTOR_SET,
            tonic_reflection::pb::v1alpha::FILE_DESCRIPTOR_SET,
        ];
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
    fn every_call_is_denied_that_is_not_allowed() {
        let config = config::Access {
            readers: vec!["planner".into()],
            ingesters: vec!["lidar-gateway".into()],
            operators: vec!["workshop".into()],
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
            "/clearway.v1.MapService/Watch: certificate of [lidar-gateway] with the roles [ingester]; allowed roles are \
             [reader, operator]"
        );
    }
}

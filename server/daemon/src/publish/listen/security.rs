//! The certificates, roles and tokens that hold at present: they can be replaced while the server runs.

use std::net::{IpAddr, Ipv6Addr};
use std::sync::{Arc, RwLock};

use super::access::Access;
use super::tls::Tls;
use crate::config::{Certificates, Config};

/// The certificates, roles and tokens of all listeners.
#[derive(Clone)]
pub struct Security(Arc<RwLock<Arc<Current>>>);

/// What holds at one time.
#[derive(Clone, Default)]
pub struct Current {
    /// The certificates; without them all listeners are plain text.
    pub tls: Option<Tls>,
    /// The roles; without them every client may use everything.
    pub access: Option<Arc<Access>>,
    /// Name and token of each client without a certificate.
    tokens: Vec<(String, String)>,
    hosts: Vec<String>,
    /// Origins of other pages that may connect.
    pub origins: Vec<String>,
}

impl Current {
    /// What a configuration and its certificates say. It is never plain text if the configuration names certificates.
    ///
    /// # Errors
    /// A text that says which certificate is invalid.
    pub fn new(config: &Config, certificates: Option<&Certificates>) -> Result<Self, String> {
        let is_served = config.grpc.enabled || config.page.enabled || config.metrics.enabled || config.foxglove.enabled;
        if is_served && config.grpc.tls.is_some() && certificates.is_none() {
            return Err("its files were not read".into());
        }
        let has_roles = certificates.is_some_and(|certificates| certificates.client_ca.is_some());
        Ok(Self {
            tls: certificates.map(Tls::new).transpose()?,
            access: has_roles.then(|| Arc::new(Access::new(&config.grpc.access))),
            tokens: certificates.map(|certificates| certificates.tokens.clone()).unwrap_or_default(),
            hosts: config.connections.hosts.clone(),
            origins: config.connections.origins.clone(),
        })
    }

    /// The name of the client with this token.
    pub fn name_of(&self, token: &str) -> Option<String> {
        // All tokens are compared, each in a time that does not depend on where it differs.
        let equal = |own: &str| {
            own.len() == token.len() && own.bytes().zip(token.bytes()).fold(0, |d, (a, b)| d | (a ^ b)) == 0
        };
        let names: Vec<_> = self.tokens.iter().filter(|(_, own)| equal(own)).map(|(name, _)| name.clone()).collect();
        names.into_iter().next()
    }

    /// True if a browser may address the server by this host. Names have no case (RFC 9110, section 4.2.3).
    pub fn is_own_host(&self, host: &str) -> bool {
        let certified = self.tls.iter().flat_map(|tls| &tls.names);
        // Another page cannot make a browser send an address that is not the server's own. Behind `%` is its zone.
        host.split_once('%').map_or(host.parse::<IpAddr>().is_ok(), |(address, _)| address.parse::<Ipv6Addr>().is_ok())
            || host.eq_ignore_ascii_case("localhost")
            || self.hosts.iter().chain(certified).any(|own| own.eq_ignore_ascii_case(host))
    }
}

impl Security {
    /// What holds from now on.
    pub fn new(current: Current) -> Self {
        Self(Arc::new(RwLock::new(Arc::new(current))))
    }

    /// What holds now.
    pub fn current(&self) -> Arc<Current> {
        self.0.read().unwrap_or_else(std::sync::PoisonError::into_inner).clone()
    }

    /// From now on `current` holds for new connections and new requests; open connections stay.
    pub fn replace(&self, current: Current) {
        *self.0.write().unwrap_or_else(std::sync::PoisonError::into_inner) = Arc::new(current);
    }
}

//! The table `[connections]`: what the peers of every TCP listener may cost, and which addresses may be public.

use std::net::IpAddr;

use serde::{Deserialize, Serialize};

use super::Config;
use super::error::ValueError;

/// The table `[connections]`. It holds for gRPC, the page, the metrics and Foxglove.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Connections {
    /// Most connections of one address at once, at each listener.
    pub per_address_max: usize,
    /// Connections of each listener that only known peers may use.
    pub kept: usize,
    /// Addresses that are known peers; so are the names in certificates and tokens that have a role.
    pub known: Vec<IpAddr>,
    /// A connection without a request for this time is closed, in s.
    pub idle_s: u64,
    /// A connection that receives nothing of what waits for it for this time is closed, in s.
    pub stalled_s: u64,
    /// Most gRPC calls at once, of all readers and senders.
    pub calls_max: usize,
    /// Most gRPC calls of one address at once.
    pub calls_per_address_max: usize,
    /// Names by which a browser may address the page, beside addresses, `localhost` and the names in the certificate.
    pub hosts: Vec<String>,
    /// Origins of other web pages that may connect, such as `https://fleet.example`.
    pub origins: Vec<String>,
    /// Listeners that may serve other hosts without protection.
    pub unprotected: Vec<Service>,
}

impl Default for Connections {
    fn default() -> Self {
        Self {
            per_address_max: 64,
            kept: 16,
            known: Vec::new(),
            idle_s: 60,
            stalled_s: 10,
            calls_max: 1024,
            calls_per_address_max: 256,
            hosts: Vec::new(),
            origins: Vec::new(),
            unprotected: Vec::new(),
        }
    }
}

/// What listens on an address.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Service {
    /// gRPC.
    Grpc,
    /// The page and its WebSocket.
    Page,
    /// The listener of `/healthz`, `/readyz` and `/metrics` alone.
    Metrics,
    /// Foxglove's WebSocket.
    Foxglove,
    /// zenoh.
    Zenoh,
    /// Datagrams.
    Udp,
}

impl Service {
    fn as_str(self) -> &'static str {
        match self {
            Self::Grpc => "grpc",
            Self::Page => "page",
            Self::Metrics => "metrics",
            Self::Foxglove => "foxglove",
            Self::Zenoh => "zenoh",
            Self::Udp => "udp",
        }
    }
}

impl Connections {
    pub(super) fn check(&self) -> Result<(), ValueError> {
        let number = |key: &str, value: u64, most: u64| match (1..=most).contains(&value) {
            true => Ok(()),
            false => Err(ValueError::new(format!("connections.{key}"), value, format!("1 to {most}"))),
        };
        number("per_address_max", self.per_address_max as u64, 65_536)?;
        number("idle_s", self.idle_s, 86_400)?;
        number("stalled_s", self.stalled_s, 3600)?;
        number("calls_max", self.calls_max as u64, 1 << 20)?;
        number("calls_per_address_max", self.calls_per_address_max as u64, 1 << 20)?;
        if self.kept > 65_535 {
            return Err(ValueError::new("connections.kept", self.kept, "0 to 65535 connections"));
        }
        let is_wrong = |origin: &&String| !origin.contains("://") || origin.ends_with('/');
        if let Some(origin) = self.origins.iter().find(is_wrong) {
            let allowed = "origins such as \"https://fleet.example\", without a path";
            return Err(ValueError::new("connections.origins", origin, allowed));
        }
        Ok(())
    }
}

impl Config {
    /// The configuration with those of `old`'s values that a running server can replace: certificates, tokens, roles
    /// and limits. It equals `old` if nothing else differs.
    pub fn without_reloaded(mut self, old: &Self) -> Self {
        self.grpc.tls.clone_from(&old.grpc.tls);
        self.grpc.access.clone_from(&old.grpc.access);
        self.grpc.connections_max = old.grpc.connections_max;
        let (calls_max, per_address) = (self.connections.calls_max, self.connections.calls_per_address_max);
        self.connections = Connections { calls_max, calls_per_address_max: per_address, ..old.connections.clone() };
        self
    }

    /// Checks that nothing is served to other hosts without protection, unless the configuration names it in
    /// `connections.unprotected`. For a server that starts; the configuration of a recording is not served.
    ///
    /// # Errors
    /// [`ValueError`] with the first address that other hosts can reach without TLS, or from any sender.
    pub(super) fn check_exposed_values(&self) -> Result<(), ValueError> {
        let is_allowed = |service: Service| self.connections.unprotected.contains(&service);
        let refuse = |service: Service, key: String, value: String, protection: &str| {
            let name = service.as_str();
            let allowed = format!(
                "an address of this host, such as 127.0.0.1, or {protection}; connections.unprotected = [\"{name}\"] \
                 says that every host of the network may use it"
            );
            Err(ValueError::new(key, value, allowed))
        };
        let tcp = [
            (Service::Grpc, self.grpc.enabled, self.grpc.listen),
            (Service::Page, self.page.enabled, self.page.listen),
            (Service::Metrics, self.metrics.enabled, self.metrics.listen),
            (Service::Foxglove, self.foxglove.enabled, self.foxglove.listen),
        ];
        for (service, enabled, at) in tcp {
            if enabled && !at.ip().is_loopback() && self.grpc.tls.is_none() && !is_allowed(service) {
                let key = format!("{}.listen", service.as_str());
                return refuse(service, key, at.to_string(), "certificates in grpc.tls");
            }
        }
        let is_public = |endpoint: &&String| {
            let address = endpoint.split('/').nth(1).unwrap_or_default().split(['?', '#']).next().unwrap_or_default();
            let host = address.rsplit_once(':').map_or(address, |(host, _)| host).trim_matches(['[', ']']);
            host != "localhost" && !host.parse::<IpAddr>().is_ok_and(|ip| ip.is_loopback())
        };
        let endpoint = self.zenoh.listen.iter().find(is_public).filter(|_| self.zenoh.enabled);
        if let Some(endpoint) = endpoint.filter(|_| self.zenoh.file.as_os_str().is_empty())
            && !is_allowed(Service::Zenoh)
        {
            let protection = "TLS and access control in zenoh.file";
            return refuse(Service::Zenoh, "zenoh.listen".into(), endpoint.clone(), protection);
        }
        for listener in super::listeners(&self.vehicles) {
            let from_anyone = listener.routes.iter().find(|route| route.from.is_none());
            if let Some(route) = from_anyone.filter(|_| !listener.at.ip().is_loopback())
                && !is_allowed(Service::Udp)
            {
                let key = format!("vehicle.udp (of {})", self.vehicles[route.vehicle].name);
                let protection = "the address of each sensor in vehicle.udp.from";
                return refuse(Service::Udp, key, listener.at.to_string(), protection);
            }
        }
        Ok(())
    }
}

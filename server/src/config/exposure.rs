//! What other hosts can reach without protection, and what of the configuration can change while the server runs.

use std::net::IpAddr;

use super::Config;
use super::connections::{Connections, Service};
use super::error::ValueError;

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

//! The TCP listeners of a configuration, and what of them can be replaced while they serve.

use std::net::SocketAddr;

use tokio::net::TcpListener;

use super::setup::StartError;
use crate::base::held_sockets::HeldSockets;
use crate::config::Config;
use crate::publish::foxglove;
use crate::publish::listen::security::Security;
use crate::publish::listen::{AllSlots, Listener, ListenerHandle, Protocol};

/// The TCP listeners that the configuration enables.
pub(super) struct Listeners {
    pub grpc: Option<Listener>,
    pub page: Option<Listener>,
    pub metrics: Option<Listener>,
    pub foxglove: Option<Listener>,
    pub security: Security,
    pub handles: Vec<(&'static str, ListenerHandle)>,
    all: AllSlots,
    refused: Vec<(String, std::io::ErrorKind)>,
}

impl Listeners {
    /// Listens on all addresses that the configuration enables, at the held sockets where there are some.
    ///
    /// # Errors
    /// [`StartError::Listen`] with every address that cannot be listened on.
    pub async fn bind(config: &Config, security: &Security, held: &mut HeldSockets) -> Result<Self, StartError> {
        let (security, all, refused) = (security.clone(), AllSlots::default(), Vec::new());
        let mut listeners =
            Self { grpc: None, page: None, metrics: None, foxglove: None, security, handles: vec![], all, refused };
        let (grpc, page, metrics, foxglove) = (&config.grpc, &config.page, &config.metrics, &config.foxglove);
        let web = Protocol::Web(&[]);
        let for_foxglove = Protocol::Web(foxglove::ORIGINS);
        listeners.grpc = listeners.add("grpc", grpc.enabled, grpc.listen, Protocol::Grpc, config, held).await;
        listeners.page = listeners.add("page", page.enabled, page.listen, web, config, held).await;
        listeners.metrics = listeners.add("metrics", metrics.enabled, metrics.listen, web, config, held).await;
        let added = listeners.add("foxglove", foxglove.enabled, foxglove.listen, for_foxglove, config, held);
        listeners.foxglove = added.await;
        if listeners.refused.is_empty() {
            return Ok(listeners);
        }
        let is_in_use = listeners.refused.iter().any(|(_, kind)| *kind == std::io::ErrorKind::AddrInUse);
        Err(StartError::Listen { refused: listeners.refused.into_iter().map(|(text, _)| text).collect(), is_in_use })
    }

    /// The address on which gRPC listens.
    #[cfg(feature = "zenoh")]
    pub fn grpc_address(&self) -> Option<SocketAddr> {
        self.grpc.as_ref().and_then(Listener::address)
    }

    async fn add(
        &mut self,
        name: &'static str,
        is_enabled: bool,
        at: SocketAddr,
        protocol: Protocol,
        config: &Config,
        held: &mut HeldSockets,
    ) -> Option<Listener> {
        if !is_enabled {
            return None;
        }
        let socket = match held.take_tcp(at) {
            Some(socket) => socket.set_nonblocking(true).and_then(|()| TcpListener::from_std(socket)),
            None => TcpListener::bind(at).await,
        };
        let refuse = |error: &std::io::Error| {
            self.refused.push((format!("{name}.listen {at}: {error}"), error.kind()));
        };
        let socket = socket.inspect_err(refuse).ok()?;
        let (listener, handle) =
            Listener::new(socket, protocol, config.connections.clone(), self.security.clone(), &self.all);
        self.handles.push((name, handle));
        Some(listener)
    }
}

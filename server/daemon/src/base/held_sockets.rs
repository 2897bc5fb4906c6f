//! Sockets that a service manager holds while the server restarts: what arrives meanwhile waits in them.
//!
//! systemd passes them as file descriptors 3 and following (`LISTEN_FDS`), a socket unit such as
//! `deploy/systemd/clearway.socket` describes them. The configuration says which services there are: a service uses the
//! held socket that is bound to its configured address, and binds one itself if there is none.

use std::io;
use std::net::{SocketAddr, TcpListener, UdpSocket};

use listenfd::ListenFd;

/// Sockets that the service manager holds, with their addresses, and that no service uses yet.
#[derive(Debug, Default)]
pub struct HeldSockets {
    tcp: Vec<(SocketAddr, TcpListener)>,
    udp: Vec<(SocketAddr, UdpSocket)>,
}

impl HeldSockets {
    /// Takes the sockets that `LISTEN_FDS` counts; none without that variable. A second call finds none. To be called
    /// before the process has threads, because it removes the variable.
    ///
    /// # Errors
    /// [`io::Error`] if a passed descriptor is neither a TCP listener nor a UDP socket.
    pub fn from_environment() -> io::Result<Self> {
        let mut passed = ListenFd::from_env();
        let mut held = Self::default();
        for index in 0..passed.len() {
            if let Ok(Some(listener)) = passed.take_tcp_listener(index) {
                held.tcp.push((listener.local_addr()?, listener));
            } else if let Some(socket) = passed.take_udp_socket(index)? {
                held.udp.push((socket.local_addr()?, socket));
            }
        }
        Ok(held)
    }

    /// The TCP listener that is bound to this address, if one is held.
    pub(crate) fn take_tcp(&mut self, at: SocketAddr) -> Option<TcpListener> {
        let index = self.tcp.iter().position(|(bound, _)| *bound == at)?;
        Some(self.tcp.swap_remove(index).1)
    }

    /// The UDP socket that is bound to this address, if one is held.
    pub(crate) fn take_udp(&mut self, at: SocketAddr) -> Option<UdpSocket> {
        let index = self.udp.iter().position(|(bound, _)| *bound == at)?;
        Some(self.udp.swap_remove(index).1)
    }

    /// The addresses of the sockets that no service uses.
    pub(crate) fn unused(&self) -> impl Iterator<Item = String> {
        let tcp = self.tcp.iter().map(|(at, _)| format!("tcp {at}"));
        tcp.chain(self.udp.iter().map(|(at, _)| format!("udp {at}")))
    }
}

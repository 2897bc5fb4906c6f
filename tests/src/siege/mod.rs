//! Attacks on a running server, for the bench `siege`. Each runs until its time is over, and disturbs one listener.
//!
//! | file | listener |
//! |---|---|
//! | [`h2`] | gRPC: frames of HTTP/2 as no honest client sends them |
//! | [`sockets`] | every TCP listener: silence, single bytes, half headers, many connections |
//! | [`browsers`] | the page: WebSocket frames and requests without pause, frames that are too long |
//! | [`datagrams`] | UDP: floods of datagrams that are no packets, and of packets of another sender |
//! | [`peers`] | zenoh: junk, forged maps, large scans without pause, false answers |
//! | [`target`] | what they have in common |
//! | [`watch`] | the healthy readers and sender beside the attacks, and the server's memory |

pub mod browsers;
pub mod datagrams;
pub mod h2;
pub mod peers;
pub mod sockets;
pub mod target;
pub mod watch;

use target::Attack;

/// Every attack, in the order of the table.
pub fn attacks() -> Vec<Attack> {
    [sockets::ATTACKS, browsers::ATTACKS, h2::ATTACKS, datagrams::ATTACKS, peers::ATTACKS].concat()
}

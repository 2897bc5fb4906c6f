//! Attacks on the TCP listeners of a server, for tests and for measurements beside a healthy reader. Each function
//! attacks until its return value is dropped.
//!
//! | file | what it does |
//! |---|---|
//! | [`sockets`] | opens connections that send nothing, or never a whole request |
//! | [`http2`] | opens gRPC streams that are never read, resets streams |
//! | [`websocket`] | frames of a WebSocket |

pub mod http2;
pub mod sockets;
pub mod websocket;

//! What tonic says of a call -> the client's error.

use tonic::Status;

use crate::error::ClientError;

/// The error of a call that the server at this address refused, or that did not reach it.
pub(super) fn refused(address: &str, status: &Status) -> ClientError {
    if let Some(source) = std::error::Error::source(status) {
        return ClientError::Unreachable { address: address.into(), reason: innermost(source) };
    }
    ClientError::Refused {
        address: address.into(),
        reason: status.message().into(),
        code: format!("{:?}", status.code()),
    }
}

/// Message of the innermost cause: the outer one is only "transport error". The first bytes of an encrypted answer are
/// no frame of HTTP/2.
pub(super) fn innermost(error: &dyn std::error::Error) -> String {
    let mut error = error;
    while let Some(source) = error.source() {
        error = source;
    }
    match error.to_string() {
        text if text.contains("frame with invalid size") => {
            format!("what answers there encrypts, or is no gRPC server ({text})")
        }
        text => text,
    }
}

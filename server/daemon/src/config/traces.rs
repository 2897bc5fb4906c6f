//! The table `[traces]`.

use serde::{Deserialize, Serialize};

use super::error::ValueError;

/// The table `[traces]`: where the traces of revolutions go.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Traces {
    /// An OTLP collector over gRPC, such as `http://127.0.0.1:4317`; empty: no traces.
    pub endpoint: String,
}

impl Traces {
    pub(super) fn check(&self) -> Result<(), ValueError> {
        let is_address = self.endpoint.strip_prefix("http://").is_some_and(|host| !host.is_empty());
        if !self.endpoint.is_empty() && !is_address {
            let allowed = "http://HOST:PORT of an OTLP collector over gRPC";
            return Err(ValueError::new("traces.endpoint", &self.endpoint, allowed));
        }
        Ok(())
    }
}

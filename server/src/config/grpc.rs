//! The table `[grpc]`: where maps are served, with which certificates, and what each client may do.

use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::file_advice::advised;

use super::error::{ConfigError, ValueError, beside};

/// The table `[grpc]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Grpc {
    /// True if it is served.
    pub enabled: bool,
    /// Address and port to listen on; port 0 selects a free port.
    pub listen: SocketAddr,
    /// Most connections at once; further ones are refused with RESOURCE_EXHAUSTED.
    pub connections_max: usize,
    /// Certificates; without them gRPC is plain text.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tls: Option<Tls>,
    /// What each client may do, if client certificates are required.
    pub access: Access,
}

impl Default for Grpc {
    fn default() -> Self {
        let listen = SocketAddr::new(Ipv4Addr::LOCALHOST.into(), 50051);
        Self { enabled: true, listen, connections_max: 256, tls: None, access: Access::default() }
    }
}

/// The table `[grpc.tls]`: PEM files. Relative paths start at the configuration's folder.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tls {
    /// The server's certificate, and the intermediate ones between it and the CA.
    pub certificate: PathBuf,
    /// Its private key. A recording holds the path only.
    pub key: PathBuf,
    /// CA of the certificates that clients must show; without it no client certificate is required.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub client_ca: Option<PathBuf>,
}

/// The table `[grpc.access]`: names in client certificates (common name or DNS name), by role. A client in no list may
/// do nothing.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Access {
    /// Clients that may read maps and status.
    pub readers: Vec<String>,
    /// Clients that may send scans, poses, roads and packets.
    pub ingesters: Vec<String>,
    /// Clients that may do both.
    pub operators: Vec<String>,
}

/// The contents of the files of `[grpc.tls]`. The key is never logged or recorded.
#[derive(Clone)]
pub struct Certificates {
    /// Certificate of the server, PEM.
    pub certificate: String,
    /// Private key of the server, PEM.
    pub key: String,
    /// CA of the clients, PEM.
    pub client_ca: Option<String>,
}

impl Grpc {
    pub(super) fn check(&self) -> Result<(), ValueError> {
        let Access { readers, ingesters, operators } = &self.access;
        let required = self.tls.as_ref().is_some_and(|tls| tls.client_ca.is_some());
        if let Some(name) = readers.iter().chain(ingesters).chain(operators).next().filter(|_| !required) {
            let allowed = "no name without grpc.tls.client_ca, the CA of the clients' certificates";
            return Err(ValueError::new("grpc.access", name, allowed));
        }
        if !(1..=65_536).contains(&self.connections_max) {
            return Err(ValueError::new("grpc.connections_max", self.connections_max, "1 to 65536 connections"));
        }
        Ok(())
    }

    /// Reads the files of `[grpc.tls]`: [`Config::certificates`](super::Config::certificates).
    pub(super) fn certificates(&self, file: &Path) -> Result<Option<Certificates>, ConfigError> {
        let Some(tls) = &self.tls else { return Ok(None) };
        let read = |key: &str, path: &PathBuf| {
            let named = beside(file, path);
            let wrong = |reason: String| ConfigError::File {
                file: file.to_owned(),
                key: format!("grpc.tls.{key}"),
                named: named.clone(),
                reason,
            };
            let text = std::fs::read_to_string(&named).map_err(|error| wrong(advised(&named, error).to_string()))?;
            let what = if key == "key" { "PRIVATE KEY-----" } else { "BEGIN CERTIFICATE-----" };
            let found = text.contains(what);
            if found { Ok(text) } else { Err(wrong(format!("no PEM block \"{what}\" in it"))) }
        };
        let client_ca = tls.client_ca.as_ref().map(|path| read("client_ca", path)).transpose()?;
        let (certificate, key) = (read("certificate", &tls.certificate)?, read("key", &tls.key)?);
        Ok(Some(Certificates { certificate, key, client_ca }))
    }
}

//! `[grpc]`: where maps are served, with which certificates, and who may do what.

use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::{Config, ConfigError, Wrong, beside};

/// `[grpc]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Grpc {
    /// Whether it is served at all.
    pub enabled: bool,
    /// Address and port; port 0 takes a free one.
    pub listen: SocketAddr,
    /// Peers connected at once; more are told so.
    pub connections_max: usize,
    /// Certificates; plain text without.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tls: Option<Tls>,
    /// Who may do what, once client certificates are asked for.
    pub access: Access,
}

impl Default for Grpc {
    fn default() -> Self {
        let listen = SocketAddr::new(Ipv4Addr::LOCALHOST.into(), 50051);
        Self { enabled: true, listen, connections_max: 256, tls: None, access: Access::default() }
    }
}

/// `[grpc.tls]`: PEM files; relative paths start at the configuration's folder.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tls {
    /// The server's certificate, and those between it and the CA.
    pub certificate: PathBuf,
    /// Its private key. Only the path is ever recorded.
    pub key: PathBuf,
    /// Whose certificates clients must have; without, no client is asked who it is.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub client_ca: Option<PathBuf>,
}

/// `[grpc.access]`: names in client certificates (common name or DNS name), by what their bearers may do. Whoever is in
/// no list may do nothing.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Access {
    /// May read maps and status.
    pub readers: Vec<String>,
    /// May send scans, poses, roads and packets.
    pub ingesters: Vec<String>,
    /// May do both.
    pub operators: Vec<String>,
}

/// The files of `[grpc.tls]`, read. The key never leaves this value.
#[derive(Clone)]
pub struct Certificates {
    /// PEM.
    pub certificate: String,
    /// PEM.
    pub key: String,
    /// PEM.
    pub client_ca: Option<String>,
}

impl Grpc {
    pub(super) fn check(&self) -> Result<(), Wrong> {
        let Access { readers, ingesters, operators } = &self.access;
        let asked = self.tls.as_ref().is_some_and(|tls| tls.client_ca.is_some());
        if let Some(name) = readers.iter().chain(ingesters).chain(operators).next().filter(|_| !asked) {
            let allowed = "nobody, unless grpc.tls.client_ca says whose certificates to ask for";
            return Err(Wrong::new("grpc.access", name, allowed));
        }
        if !(1..=65_536).contains(&self.connections_max) {
            return Err(Wrong::new("grpc.connections_max", self.connections_max, "1 to 65536 connections"));
        }
        Ok(())
    }
}

impl Config {
    /// Reads the files of `[grpc.tls]`; `None` where there is no such table. Relative paths start at the
    /// configuration's folder, `file`'s parent.
    ///
    /// # Errors
    /// [`ConfigError::File`] with what is wrong.
    pub fn certificates(&self, file: &Path) -> Result<Option<Certificates>, ConfigError> {
        let Some(tls) = &self.grpc.tls else { return Ok(None) };
        let read = |key: &str, path: &PathBuf| {
            let named = beside(file, path);
            let wrong = |reason: String| ConfigError::File {
                file: file.to_owned(),
                key: format!("grpc.tls.{key}"),
                named: named.clone(),
                reason,
            };
            let text = std::fs::read_to_string(&named).map_err(|error| wrong(error.to_string()))?;
            let what = if key == "key" { "PRIVATE KEY-----" } else { "BEGIN CERTIFICATE-----" };
            let found = text.contains(what);
            if found { Ok(text) } else { Err(wrong(format!("no PEM block \"{what}\" in it"))) }
        };
        let client_ca = tls.client_ca.as_ref().map(|path| read("client_ca", path)).transpose()?;
        let (certificate, key) = (read("certificate", &tls.certificate)?, read("key", &tls.key)?);
        Ok(Some(Certificates { certificate, key, client_ca }))
    }
}

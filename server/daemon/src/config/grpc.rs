//! The table `[grpc]`: where maps are served, with which certificates, and what each client may do. The certificates
//! and the roles hold for the page, the metrics and Foxglove too.

use std::collections::BTreeMap;
use std::net::{Ipv4Addr, SocketAddr};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::base::file_advice::{advised, read_text};

use super::error::{ConfigError, ValueError, beside};

/// The table `[grpc]`: address, certificates and access rules of the gRPC server.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Grpc {
    /// True if gRPC is served.
    pub enabled: bool,
    /// Address and port to listen on; port 0 selects a free port.
    pub listen: SocketAddr,
    /// The host, with or without a port, at which other machines reach `listen`: other servers lead readers there.
    /// Empty: the address of `listen` itself, unless it is a wildcard or of this host alone.
    pub advertise: String,
    /// Certificates; without them gRPC is plain text.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tls: Option<Tls>,
    /// What each client may do, if client certificates are required.
    pub access: Access,
}

impl Default for Grpc {
    fn default() -> Self {
        let listen = SocketAddr::new(Ipv4Addr::LOCALHOST.into(), 50051);
        Self { enabled: true, listen, advertise: String::new(), tls: None, access: Access::default() }
    }
}

/// The table `[grpc.tls]`: PEM files. Relative paths start at the configuration's folder.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tls {
    /// The server's certificate, and the intermediate certificates between it and the CA.
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
    /// Files with the bearer tokens of clients that have no certificate (browsers, Prometheus), by the client's name.
    /// A recording holds the paths only.
    pub tokens: BTreeMap<String, PathBuf>,
    /// What a name is limited to; a name that is not here may reach every vehicle and layer.
    pub only: BTreeMap<String, Only>,
}

/// The vehicles and layers that a name is limited to.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Only {
    /// Names of vehicles; empty: every vehicle.
    pub vehicles: Vec<String>,
    /// Names of layers; empty: every layer.
    pub layers: Vec<String>,
}

/// Least length of a token, in characters. Ours: 128 bits in hexadecimal.
const TOKEN_CHARACTERS_MIN: usize = 32;

/// The contents of the files of `[grpc.tls]` and `[grpc.access.tokens]`. Keys and tokens are never logged or recorded.
#[derive(Clone)]
pub struct Certificates {
    /// Certificate of the server, PEM.
    pub certificate: String,
    /// Private key of the server, PEM.
    pub key: String,
    /// CA of the clients, PEM.
    pub client_ca: Option<String>,
    /// Name and token of each client without a certificate.
    pub tokens: Vec<(String, String)>,
}

impl Grpc {
    pub(super) fn check(&self) -> Result<(), ValueError> {
        let Access { readers, ingesters, operators, tokens, only } = &self.access;
        let required = self.tls.as_ref().is_some_and(|tls| tls.client_ca.is_some());
        let mut names = readers.iter().chain(ingesters).chain(operators).chain(tokens.keys()).chain(only.keys());
        if let Some(name) = names.next().filter(|_| !required) {
            let allowed = "no name without grpc.tls.client_ca, the CA of the clients' certificates";
            return Err(ValueError::new("grpc.access", name, allowed));
        }
        // A misspelt name would leave the client that was meant without a limit.
        let has_access = |name: &String| {
            readers.iter().chain(ingesters).chain(operators).chain(tokens.keys()).any(|other| other == name)
        };
        if let Some(name) = only.keys().find(|name| !has_access(name)) {
            let allowed = "a name of readers, ingesters, operators or tokens";
            return Err(ValueError::new("grpc.access.only", name, allowed));
        }
        if !Self::is_address(&self.advertise) {
            let allowed = "a host such as \"vehicle-7.example\", or host and port such as \"10.0.0.7:50051\"";
            return Err(ValueError::new("grpc.advertise", &self.advertise, allowed));
        }
        Ok(())
    }

    /// True if it may be the address of a server, with or without a port; empty: none.
    pub(crate) fn is_address(address: &str) -> bool {
        let (_, port) = host_and_port(address);
        !address.contains("//") && port.is_none_or(|port| port.parse::<u16>().is_ok())
    }

    /// The address, `HOST:PORT`, at which other machines reach gRPC when it listens on `bound`; `None` if they cannot.
    pub fn advertised(&self, bound: SocketAddr) -> Option<String> {
        match host_and_port(&self.advertise) {
            ("", _) if bound.ip().is_unspecified() || bound.ip().is_loopback() => None,
            ("", _) => Some(bound.to_string()),
            (host, None) => Some(format!("{host}:{}", bound.port())),
            (_, Some(_)) => Some(self.advertise.clone()),
        }
    }

    /// Reads the files of `[grpc.tls]`: [`Config::certificates`](super::Config::certificates).
    pub(super) fn certificates(&self, file: &Path) -> Result<Option<Certificates>, ConfigError> {
        let Some(tls) = &self.tls else { return Ok(None) };
        let pem = |key: &str, path: &Path, block: &str| {
            let (read, named) = (if key == "key" { secret } else { text }, beside(file, path));
            let found = read(&named).and_then(|text| match text.contains(block) {
                true => Ok(text),
                false => Err(format!("no PEM block \"{block}\" in it")),
            });
            found.map_err(|reason| wrong(file, format!("grpc.tls.{key}"), named, reason))
        };
        let certificate = |key, path: &Path| pem(key, path, "BEGIN CERTIFICATE-----");
        let token = |(name, path): (&String, &PathBuf)| {
            let named = beside(file, path);
            let token = secret(&named).and_then(|text| match text.trim() {
                token if token.len() >= TOKEN_CHARACTERS_MIN && token.chars().all(|c| c.is_ascii_graphic()) => {
                    Ok(token.to_owned())
                }
                _ => Err(format!("at least {TOKEN_CHARACTERS_MIN} printable ASCII characters on one line are allowed")),
            });
            let token = token.map_err(|reason| wrong(file, format!("grpc.access.tokens.{name}"), named, reason));
            Ok((name.clone(), token?))
        };
        Ok(Some(Certificates {
            client_ca: tls.client_ca.as_ref().map(|path| certificate("client_ca", path)).transpose()?,
            certificate: certificate("certificate", &tls.certificate)?,
            key: pem("key", &tls.key, "PRIVATE KEY-----")?,
            tokens: self.access.tokens.iter().map(token).collect::<Result<_, _>>()?,
        }))
    }
}

fn wrong(file: &Path, key: String, named: PathBuf, reason: String) -> ConfigError {
    ConfigError::File { file: file.to_owned(), key, named, reason }
}

fn text(file: &Path) -> Result<String, String> {
    read_text(file).map_err(|error| advised(file, error).to_string())
}

/// The parts of `HOST`, `HOST:PORT` or `[IPV6]:PORT`.
fn host_and_port(address: &str) -> (&str, Option<&str>) {
    match address.rsplit_once(':') {
        Some((host, port)) if !host.contains(':') || host.ends_with(']') => (host, Some(port)),
        _ => (address, None),
    }
}

/// The text of a file that only its owner and its group may read: of each key and each token.
///
/// # Errors
/// A text that says what is wrong, without the file's name, because the caller names it.
pub fn secret(file: &Path) -> Result<String, String> {
    let text = text(file)?;
    let mode = std::fs::metadata(file).map_err(|error| error.to_string())?.permissions().mode() & 0o777;
    match mode & 0o007 {
        0 => Ok(text),
        _ => Err(format!("every user of this host may use it (mode {mode:03o}); allowed: 600 or 640 (chmod 600)")),
    }
}

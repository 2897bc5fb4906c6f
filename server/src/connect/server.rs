//! The options that name a server and the certificates to reach it -> a connected client.

use std::ffi::OsString;
use std::path::Path;

use anyhow::{Error, Result};
use clap::Args;
use clearway_client::{Client, ClientError, Tls};

use crate::terminal::usage_error;
use clearway_daemon::base::files;

/// The gRPC address of a server with the default configuration.
const ADDRESS: &str = "localhost:50051";
/// The environment variables that name certificates.
#[cfg(feature = "zenoh")]
const VARIABLES: &str = "CLEARWAY_CA, CLEARWAY_CERT and CLEARWAY_KEY name PEM files";

/// The server of a client. `CLEARWAY_CA` names the PEM file of the CA certificate that signed the server's certificate,
/// and turns on encryption; `CLEARWAY_CERT` and `CLEARWAY_KEY` name this client's certificate and its private key.
#[derive(Args)]
pub struct ServerOptions {
    /// The server's gRPC address, by default $CLEARWAY_SERVER, else localhost:50051; the environment variables
    /// CLEARWAY_CA, CLEARWAY_CERT and CLEARWAY_KEY name PEM files of certificates, which encrypt the connection.
    #[arg(long = "server", global = true, value_name = "HOST:PORT", default_value_t = default_address())]
    pub address: String,
}

/// The address in `$CLEARWAY_SERVER`, else [`ADDRESS`]. For clap it is a default and not `env`: the variable
/// contradicts no option.
fn default_address() -> String {
    std::env::var("CLEARWAY_SERVER").unwrap_or_else(|_| ADDRESS.to_owned())
}

impl ServerOptions {
    /// Connects to the server, with certificates if `CLEARWAY_CA` names one.
    ///
    /// # Errors
    /// If a PEM file cannot be read, and as [`Client::connect`].
    pub async fn connect(&self) -> Result<Client> {
        match tls()? {
            None => Client::connect(&self.address).await.map_err(explain),
            Some(tls) => Client::connect_tls(&self.address, &tls).await.map_err(explain),
        }
    }

    /// Connects to a router or server over zenoh, with certificates if `CLEARWAY_CA` names one.
    ///
    /// # Errors
    /// If a PEM file cannot be read, and as [`ZenohClient::connect`](clearway_client::ZenohClient::connect).
    #[cfg(feature = "zenoh")]
    pub async fn connect_over_zenoh(&self, endpoint: &str) -> Result<clearway_client::ZenohClient> {
        let connected = match tls()? {
            None => clearway_client::ZenohClient::connect(endpoint).await,
            Some(tls) => clearway_client::ZenohClient::connect_tls(endpoint, &tls).await,
        };
        let advice = |error: ClientError| match endpoint.contains("tls/") && std::env::var_os("CLEARWAY_CERT").is_none()
        {
            true => Error::from(error).context(format!("a router of a fleet requires a certificate: {VARIABLES}")),
            false => Error::from(error),
        };
        connected.map_err(advice)
    }

    #[cfg(not(feature = "zenoh"))]
    pub async fn connect_over_zenoh(&self, endpoint: &str) -> Result<Client> {
        anyhow::bail!("--zenoh {endpoint}: this clearway was built without the feature zenoh")
    }
}

/// The certificates that the environment variables name; `None` without a CA: the connection is not encrypted then.
fn tls() -> Result<Option<Tls>> {
    let [ca, certificate, key] = ["CLEARWAY_CA", "CLEARWAY_CERT", "CLEARWAY_KEY"].map(std::env::var_os);
    let read = |file: OsString| files::read_text(Path::new(&file));
    let identity = match (certificate, key) {
        (Some(certificate), Some(key)) => Some((read(certificate)?, read(key)?)),
        (None, None) => None,
        _ => {
            return Err(usage_error(
                "CLEARWAY_CERT and CLEARWAY_KEY: a certificate needs its key, and a key its certificate",
            ));
        }
    };
    match ca {
        Some(ca) => Ok(Some(Tls { ca: read(ca)?, identity, server_name: String::new() })),
        None if identity.is_some() => Err(usage_error("CLEARWAY_CERT needs CLEARWAY_CA")),
        None => Ok(None),
    }
}

/// Adds to an error of the client what to do about it, if that is known.
pub fn explain(error: ClientError) -> Error {
    let advice = advice(&error.to_string());
    let error = Error::from(error);
    match advice {
        Some(advice) => error.context(advice),
        None => error,
    }
}

/// Parts of the texts of errors, and what to do about an error with one of them; the first that fits holds.
const ADVICE: [(&[&str], &str); 8] = [
    (
        &["invalid compression flag", "HTTP status code", "http2 error", "h2 protocol error"],
        "something answers at this address, but not a gRPC server: --server needs the address of [grpc] listen (port \
         50051 by default), not the one of the page ([page] listen, port 8080 by default)",
    ),
    (
        &["what answers there encrypts"],
        "if the server encrypts, CLEARWAY_CA names the PEM file of the CA certificate that signed its own",
    ),
    (&["UnknownIssuer"], "the CA certificate of CLEARWAY_CA has not signed the server's certificate"),
    (&["KeyMismatch"], "CLEARWAY_KEY is not the private key of the certificate of CLEARWAY_CERT"),
    (&["CertificateRequired"], "the server requires a certificate: CLEARWAY_CERT and CLEARWAY_KEY name it and its key"),
    (
        &["CertificateUnknown", "CertificateExpired", "UnknownCA", "BadCertificate"],
        "the server does not accept the certificate of CLEARWAY_CERT: its own CA must have signed it, and it must be \
         valid now",
    ),
    // A server that refuses a client may close the connection before the alert that says why arrives.
    (
        &["connection closed", "broken pipe", "operation was canceled", "transport error"],
        "the connection has ended: the server has stopped, encrypts (CLEARWAY_CA), requires a certificate \
         (CLEARWAY_CERT and CLEARWAY_KEY) or does not accept this one, or has another port for gRPC",
    ),
    (
        &["no map"],
        "the server has no map to give: no packet or scan has arrived since it started, or none arrives now; \
         `clearway status` says why, and `clearway get --wait` and `clearway watch` wait for the next map",
    ),
];

/// What to do about an error of this text; `None` if the text says all that is known.
fn advice(error: &str) -> Option<&'static str> {
    let fits = |parts: &[&str]| parts.iter().any(|part| error.contains(part));
    ADVICE.iter().find(|(parts, _)| fits(parts)).map(|(_, advice)| *advice)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_answer_over_http_is_explained_by_the_ports() {
        let error =
            "http://localhost:8080: protocol error: received message with invalid compression flag: 110 (Internal)";
        assert!(advice(error).unwrap().contains("[page] listen"));
        assert!(advice("no clearway server answers at http://localhost:1: Connection refused").is_none());
        let error = "no clearway server answers at https://localhost:1: received fatal alert: CertificateRequired";
        assert!(advice(error).unwrap().contains("CLEARWAY_CERT and CLEARWAY_KEY"));
        let error = "no clearway server answers at https://localhost:1: received fatal alert: CertificateUnknown";
        assert!(advice(error).unwrap().contains("does not accept the certificate"));
        let error = "no clearway server answers at https://localhost:1: connection closed";
        assert!(advice(error).unwrap().contains("does not accept this one"));
        let error = "no clearway server answers at https://localhost:1: invalid peer certificate: UnknownIssuer";
        assert!(advice(error).unwrap().contains("CA certificate of CLEARWAY_CA"));
        let error = "certificates for localhost:1: keys may not be consistent: KeyMismatch";
        assert!(advice(error).unwrap().contains("CLEARWAY_KEY is not the private key"));
        let error = "no clearway server answers at http://localhost:1: stream closed because of a broken pipe";
        assert!(advice(error).unwrap().contains("the server has stopped"));
    }
}

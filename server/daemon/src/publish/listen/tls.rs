//! Certificates -> the TLS of every listener, and the names in a client's certificate.

use std::sync::Arc;

use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::crypto::ring::default_provider;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::rustls::server::WebPkiClientVerifier;
use tokio_rustls::rustls::{RootCertStore, ServerConfig};
use x509_parser::extensions::GeneralName;
use x509_parser::prelude::{FromDer, X509Certificate};

use crate::config::Certificates;

/// The TLS of all listeners.
#[derive(Clone)]
pub struct Tls {
    /// For gRPC: every client needs a certificate, if there is a CA for clients.
    pub grpc: TlsAcceptor,
    /// For the page, the metrics and Foxglove: a client may show a certificate.
    pub web: TlsAcceptor,
    /// The names in the server's certificate.
    pub names: Vec<String>,
    /// When the certificates of the server and of the CA end, by their keys in the configuration, in seconds since the
    /// Unix epoch.
    pub ends_s: Vec<(&'static str, i64)>,
}

impl Tls {
    /// The TLS with these certificates.
    ///
    /// # Errors
    /// A text that names the invalid part: certificate, key or CA.
    pub fn new(certificates: &Certificates) -> Result<Self, String> {
        let Certificates { certificate, key, client_ca, .. } = certificates;
        let chain = parse_chain("certificate", certificate)?;
        let key = PrivateKeyDer::from_pem_slice(key.as_bytes()).map_err(|error| format!("key: {error}"))?;
        let names = chain.first().map(|own| names(own)).unwrap_or_default();
        let mut ends_s: Vec<_> = end_s(&chain).map(|end_s| ("grpc.tls.certificate", end_s)).into_iter().collect();
        let acceptor = |protocol: &str, is_required: bool| {
            let provider = Arc::new(default_provider());
            let builder = ServerConfig::builder_with_provider(provider.clone());
            let builder = builder.with_safe_default_protocol_versions().map_err(|error| error.to_string())?;
            let builder = match client_ca {
                None => builder.with_no_client_auth(),
                Some(client_ca) => {
                    let mut roots = RootCertStore::empty();
                    for ca in parse_chain("client_ca", client_ca)? {
                        roots.add(ca).map_err(|error| format!("client_ca: {error}"))?;
                    }
                    let verifier = WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider);
                    let verifier = if is_required { verifier } else { verifier.allow_unauthenticated() };
                    builder.with_client_cert_verifier(verifier.build().map_err(|error| format!("client_ca: {error}"))?)
                }
            };
            let made = builder.with_single_cert(chain.clone(), key.clone_key());
            let mut config = made.map_err(|error| format!("grpc.tls.certificate and grpc.tls.key: {error}"))?;
            config.alpn_protocols = vec![protocol.into()];
            Ok::<_, String>(TlsAcceptor::from(Arc::new(config)))
        };
        let (grpc, web) = (acceptor("h2", true)?, acceptor("http/1.1", false)?);
        if let Some(client_ca) = client_ca {
            ends_s.extend(end_s(&parse_chain("client_ca", client_ca)?).map(|end_s| ("grpc.tls.client_ca", end_s)));
        }
        Ok(Self { grpc, web, names, ends_s })
    }
}

fn parse_chain(what: &str, pem: &str) -> Result<Vec<CertificateDer<'static>>, String> {
    let chain: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(pem.as_bytes()).collect();
    match chain {
        Ok(chain) if !chain.is_empty() => Ok(chain),
        Ok(_) => Err(format!("{what}: no certificate")),
        Err(error) => Err(format!("{what}: {error}")),
    }
}

/// The earliest end of these certificates, in seconds since the Unix epoch; `None` if none of them parses.
pub fn end_s(chain: &[CertificateDer<'_>]) -> Option<i64> {
    let end = |der: &CertificateDer<'_>| Some(X509Certificate::from_der(der).ok()?.1.validity().not_after.timestamp());
    chain.iter().filter_map(end).min()
}

/// The names in a certificate: common name and DNS names. A certificate that does not parse has none, and so no role.
pub fn names(certificate: &[u8]) -> Vec<String> {
    let Ok((_, certificate)) = X509Certificate::from_der(certificate) else { return Vec::new() };
    let common = certificate.subject().iter_common_name().filter_map(|name| name.as_str().ok());
    let mut names: Vec<String> = common.map(str::to_owned).collect();
    if let Ok(Some(alternatives)) = certificate.subject_alternative_name() {
        names.extend(alternatives.value.general_names.iter().filter_map(|name| match name {
            GeneralName::DNSName(name) => Some((*name).to_owned()),
            _ => None,
        }));
    }
    names.sort_unstable();
    names.dedup();
    names
}

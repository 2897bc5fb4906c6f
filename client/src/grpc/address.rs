//! The text of a server's address -> a URL. Python's `over_grpc.py` reads the same texts, and
//! `client/golden/addresses.json` holds both to it.

use crate::error::ClientError;

/// The URL of a server at `HOST:PORT`, also written `http://HOST:PORT`, or with certificates `https://HOST:PORT`.
///
/// # Errors
/// [`ClientError::Address`] if the text is not such an address.
pub fn url(address: &str, with_certificates: bool) -> Result<String, ClientError> {
    let wrong = |reason: String| Err(ClientError::Address { address: address.into(), reason });
    let scheme = if with_certificates { "https://" } else { "http://" };
    let rest = address.strip_prefix(scheme).unwrap_or(address).trim_end_matches('/');
    if rest.starts_with("https://") {
        return wrong("https needs certificates".into());
    }
    if rest.contains("://") {
        return wrong(format!("another scheme than {scheme}"));
    }
    if rest.contains('/') {
        return wrong("a path, or an endpoint of zenoh".into());
    }
    match rest.rsplit_once(':') {
        None => wrong("no port".into()),
        Some(("", _)) => wrong("no host".into()),
        Some((_, port)) if port.parse::<u16>().is_err() => wrong("the port is no number up to 65535".into()),
        Some(_) => Ok(format!("{scheme}{}", with_zone_number(rest))),
    }
}

/// An address with the number of its IPv6 zone in place of the name, such as `[fe80::1%2]:50051`: URLs have no names.
fn with_zone_number(address: &str) -> String {
    let zone = address.split_once('%').and_then(|(_, rest)| Some(rest.split_once(']')?.0));
    let number = |zone: &str| std::fs::read_to_string(format!("/sys/class/net/{zone}/ifindex")).ok();
    match zone.and_then(|zone| Some((zone, number(zone)?))) {
        Some((zone, number)) => address.replacen(&format!("%{zone}]"), &format!("%{}]", number.trim()), 1),
        None => address.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_client_accepts_and_refuses_the_same_addresses() {
        let text = include_str!("../../golden/addresses.json");
        let cases: Vec<serde_json::Value> = serde_json::from_str(text).unwrap();
        assert!(cases.len() > 12);
        for case in cases {
            let (address, refused) = (case["address"].as_str().unwrap(), case["refused"].as_str());
            let found = url(address, case["certificates"].as_bool().unwrap());
            match (&found, refused) {
                (Ok(url), None) => assert!(url.parse::<tonic::transport::Uri>().is_ok(), "{url}"),
                (Err(ClientError::Address { reason, .. }), Some(refused)) => assert_eq!(reason, refused, "{address}"),
                _ => panic!("{address}: {found:?}, expected {refused:?}"),
            }
        }
    }
}

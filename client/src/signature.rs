//! Signatures of maps over zenoh: who published a map, where the transport cannot tell.
//!
//! zenoh vouches for the peer at the other end of one link. Behind a router, or in a network without access control,
//! any peer may have put a map on a key. So a server with `zenoh.signing_key` adds an Ed25519 signature to each map, as
//! the attachment of the sample (64 bytes). It signs [`signed_message`]: the key is part of it, so that a map of one
//! vehicle or layer is not valid on the key of another. Readers have the public key only, and cannot sign.
//!
//! ```sh
//! openssl genpkey -algorithm ed25519 -out maps.key        # the server's: zenoh.signing_key
//! openssl pkey -in maps.key -pubout -out maps.pub         # the readers'
//! ```

use ring::signature::{ED25519, Ed25519KeyPair, UnparsedPublicKey};
use rustls_pki_types::pem::PemObject;
use rustls_pki_types::{PrivatePkcs8KeyDer, SubjectPublicKeyInfoDer};

use crate::error::ClientError;

/// First bytes of everything that is signed, so that a signature made for another purpose is not one of a map.
const PURPOSE: &[u8] = b"clearway.v1.Map\0";
/// DER of an Ed25519 public key (RFC 8410) before its 32 bytes.
const SPKI_PREFIX: [u8; 12] = [0x30, 0x2a, 0x30, 0x05, 0x06, 0x03, 0x2b, 0x65, 0x70, 0x03, 0x21, 0x00];

/// The bytes that are signed: purpose, key expression, a zero byte, the encoded map.
fn signed_message(key: &str, map: &[u8]) -> Vec<u8> {
    [PURPOSE, key.as_bytes(), b"\0", map].concat()
}

/// The private key of a server.
#[derive(Debug)]
pub struct SigningKey(Ed25519KeyPair);

impl SigningKey {
    /// Reads a private key from PEM (PKCS #8), as `openssl genpkey -algorithm ed25519` makes it.
    ///
    /// # Errors
    /// [`ClientError::SigningKey`] if the text holds no such key.
    pub fn from_pem(text: &str) -> Result<Self, ClientError> {
        let wrong = |reason: String| ClientError::SigningKey {
            reason: format!("{reason}; a PEM block PRIVATE KEY as of `openssl genpkey -algorithm ed25519` is needed"),
        };
        let der = PrivatePkcs8KeyDer::from_pem_slice(text.as_bytes()).map_err(|error| wrong(error.to_string()))?;
        // openssl writes the private key alone; the public key follows from it.
        let pair = Ed25519KeyPair::from_pkcs8_maybe_unchecked(der.secret_pkcs8_der());
        pair.map(Self).map_err(|error| wrong(error.to_string()))
    }

    /// The signature of an encoded map on a key.
    pub fn sign(&self, key: &str, map: &[u8]) -> [u8; 64] {
        let mut signature = [0; 64];
        signature.copy_from_slice(self.0.sign(&signed_message(key, map)).as_ref());
        signature
    }
}

/// The public key by which readers know the maps of a server.
#[derive(Clone, Debug)]
pub struct PublicKey(UnparsedPublicKey<[u8; 32]>);

impl PublicKey {
    /// Reads a public key from PEM, as `openssl pkey -pubout` writes it.
    ///
    /// # Errors
    /// [`ClientError::SigningKey`] if the text holds no Ed25519 public key.
    pub fn from_pem(text: &str) -> Result<Self, ClientError> {
        let wrong = |reason: String| ClientError::SigningKey {
            reason: format!("{reason}; a PEM block PUBLIC KEY of an Ed25519 key is needed"),
        };
        let der = SubjectPublicKeyInfoDer::from_pem_slice(text.as_bytes()).map_err(|error| wrong(error.to_string()))?;
        let key = der.strip_prefix(&SPKI_PREFIX).and_then(|key| key.try_into().ok());
        let key: [u8; 32] = key.ok_or_else(|| wrong("the key is of another kind".into()))?;
        Ok(Self(UnparsedPublicKey::new(&ED25519, key)))
    }

    /// True if `signature` is the server's signature of this map on this key.
    pub fn verifies(&self, key: &str, map: &[u8], signature: &[u8]) -> bool {
        self.0.verify(&signed_message(key, map), signature).is_ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The key pair of RFC 8032, section 7.1, test 1, as openssl writes it.
    const PRIVATE: &str = "-----BEGIN PRIVATE KEY-----\n\
        MC4CAQAwBQYDK2VwBCIEIJ1hsZ3v/VpguoRK9JLsLMREScVpezJpGXA7rAMcrn9g\n-----END PRIVATE KEY-----\n";
    const PUBLIC: &str = "-----BEGIN PUBLIC KEY-----\n\
        MCowBQYDK2VwAyEA11qYAYKxCrfVS/7TyWQHOg7hcvPapiMlrwIaaPcHURo=\n-----END PUBLIC KEY-----\n";

    #[test]
    fn a_signature_holds_for_one_map_on_one_key() {
        let (private, public) = (SigningKey::from_pem(PRIVATE).unwrap(), PublicKey::from_pem(PUBLIC).unwrap());
        let signature = private.sign("clearway/car/map/terrain", b"a map");
        assert!(public.verifies("clearway/car/map/terrain", b"a map", &signature));
        assert!(!public.verifies("clearway/car/map/speed", b"a map", &signature), "another layer");
        assert!(!public.verifies("clearway/car/map/terrain", b"a mop", &signature), "another map");
        assert!(!public.verifies("clearway/car/map/terrain", b"a map", &signature[1..]), "cut");
        assert!(!public.verifies("clearway/car/map/terrain", b"a map", &[]), "absent");
    }

    #[test]
    fn a_text_without_an_ed25519_key_is_refused_with_what_is_needed() {
        for text in ["", "maps", PUBLIC] {
            let error = SigningKey::from_pem(text).unwrap_err().to_string();
            assert!(error.contains("openssl genpkey -algorithm ed25519"), "{error}");
        }
        let other = PUBLIC.replace("MCowBQYDK2Vw", "MCowBQYDK2Vu");
        for text in ["", PRIVATE, &other] {
            let error = PublicKey::from_pem(text).unwrap_err().to_string();
            assert!(error.contains("Ed25519 key is needed"), "{error}");
        }
    }
}

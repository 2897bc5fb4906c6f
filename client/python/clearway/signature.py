"""Signatures of maps over zenoh: who published a map, where the transport cannot tell. The Rust client's signature.rs
describes them."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

from .errors import ClearwayError

_PURPOSE = b"clearway.v1.Map\0"


class PublicKey:
    """The public key by which readers know the maps of a server: Ed25519, PEM."""

    def __init__(self, file: str | PathLike[str]) -> None:
        try:
            from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
            from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
            from cryptography.hazmat.primitives.serialization import load_pem_public_key
        except ImportError:
            needed = "signed_by needs cryptography: pip install 'clearway[zenoh,signed]'"
            raise ClearwayError("signing_key", needed) from None
        try:
            key = load_pem_public_key(Path(file).read_bytes())
        except (OSError, ValueError, UnsupportedAlgorithm) as error:
            raise ClearwayError("signing_key", f"{file}: {error}") from None
        if not isinstance(key, Ed25519PublicKey):
            raise ClearwayError("signing_key", f"{file}: a PEM block PUBLIC KEY of an Ed25519 key is needed")
        self._key, self._wrong = key, InvalidSignature

    def verifies(self, key: str, encoded: bytes, signature: bytes) -> bool:
        """True if `signature` is the server's signature of this encoded map on this key of zenoh."""
        try:
            self._key.verify(signature, b"".join([_PURPOSE, key.encode(), b"\0", encoded]))
        except self._wrong:
            return False
        return True

"""Certificates of an encrypted connection, as PEM files."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike, fspath
from pathlib import Path

from .errors import ClearwayError


@dataclass(frozen=True)
class Tls:
    """Certificates of an encrypted connection. `ca`: certificate of the authority that must have signed the server's
    certificate. `cert` and `key`: certificate and private key of the client, if the server requires them."""

    ca: str | PathLike[str]
    cert: str | PathLike[str] | None = None
    key: str | PathLike[str] | None = None

    def __post_init__(self) -> None:
        if (self.cert is None) != (self.key is None):
            raise ClearwayError("certificate", f"cert {self.cert!r} and key {self.key!r}: both or none are needed")

    def files(self) -> dict[str, str]:
        """Absolute path of each given file, by field. Raises `ClearwayError` if a file cannot be read."""
        named = {"ca": self.ca, "cert": self.cert, "key": self.key}
        files = {name: str(Path(fspath(path)).absolute()) for name, path in named.items() if path is not None}
        for name, path in files.items():
            try:
                open(path, "rb").close()
            except OSError as error:
                raise ClearwayError("certificate", f"{name}: {error}") from None
        return files

    def read(self) -> dict[str, bytes]:
        """Content of each given file, by field."""
        return {name: Path(path).read_bytes() for name, path in self.files().items()}

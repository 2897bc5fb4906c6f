"""Certificates: whom a client believes, and what it shows of itself. All of them PEM files."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike, fspath
from pathlib import Path

from .errors import ClearwayError


@dataclass(frozen=True)
class Tls:
    """The connection is encrypted: `ca` is the CA that the server's certificate must be of, `cert` and `key` are the client's
    own, where the server asks who is there."""

    ca: str | PathLike[str]
    cert: str | PathLike[str] | None = None
    key: str | PathLike[str] | None = None

    def __post_init__(self) -> None:
        if (self.cert is None) != (self.key is None):
            raise ClearwayError("certificate", f"cert {self.cert!r} and key {self.key!r}: one is of no use without the other")

    def files(self) -> dict[str, str]:
        """Absolute paths of those that there are, by field. Raises `ClearwayError` for one that cannot be read."""
        named = {"ca": self.ca, "cert": self.cert, "key": self.key}
        files = {name: str(Path(fspath(path)).absolute()) for name, path in named.items() if path is not None}
        for name, path in files.items():
            try:
                open(path, "rb").close()
            except OSError as error:
                raise ClearwayError("certificate", f"{name}: {error}") from None
        return files

    def read(self) -> dict[str, bytes]:
        """What is in them."""
        return {name: Path(path).read_bytes() for name, path in self.files().items()}

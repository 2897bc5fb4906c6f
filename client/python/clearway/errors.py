"""What can go wrong, each with what a person needs to mend it."""

from __future__ import annotations


class ClearwayError(Exception):
    """Base of all errors of this package. `reason` is a short name: a gRPC status (`NOT_FOUND`), or a fault's own."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class DecodeError(ClearwayError):
    """A map that is none; `reason` is the name in the golden vectors, the same in every client language."""

"""The errors of this package."""

from __future__ import annotations


class ClearwayError(Exception):
    """Base of all errors of this package. `reason` is a short name of the fault, such as the gRPC status
    `NOT_FOUND`."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class DecodeError(ClearwayError):
    """An invalid map. `reason` is the name in the golden vectors, the same in every client language."""

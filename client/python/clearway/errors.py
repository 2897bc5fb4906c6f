"""The errors of this package."""

from __future__ import annotations


class ClearwayError(Exception):
    """Base of all errors of this package. `reason` is a short name of the fault, such as the gRPC status
    `NOT_FOUND`."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class ReplayEnded(ClearwayError):
    """The replay that the server serves has reached its end, and its last map was returned. The stream goes on:
    further maps come if the replay is set back."""

    def __init__(self) -> None:
        super().__init__("replay_ended", "the replay has ended")


class DecodeError(ClearwayError):
    """An invalid map. `reason` is the name in the golden vectors, the same in every client language."""


def forked(what: str) -> ClearwayError:
    """The error of a forked process that uses `what`: its threads are in the process alone that opened it."""
    text = f"{what} was opened before this process was forked, and works in the process that opened it alone: open it"
    return ClearwayError("fork", f"{text} after the fork, or start processes with multiprocessing.get_context('spawn')")

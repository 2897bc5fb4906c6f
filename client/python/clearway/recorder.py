"""The recorder of a server, over gRPC. With roles, only an operator may call it."""

from __future__ import annotations

from typing import Any

import grpc

from .over_grpc import channel, refused
from .tls import Tls
from .v1 import Stub, service_pb2

#: Longest wait for an answer: `save` and `stop` write to a disk.
_TIMEOUT_S = 30.0


class Recorder:
    """The recorder of the server at HOST:PORT. A call returns the messages of service.proto, in which each field is
    described, or raises a `ClearwayError`. The state that `start`, `stop` and `split` return may be a moment
    old: `status` shows when the recorder has done it."""

    def __init__(self, address: str, tls: Tls | None = None) -> None:
        self._address, self._tls = address, tls

    def status(self) -> service_pb2.RecorderStatus:
        """The state of the recorder: its file, its state, what was written and lost."""
        return self._call("Status", service_pb2.RecordingStatusRequest()).status

    def start(self) -> service_pb2.RecorderStatus:
        """Begins to record again after `stop`."""
        return self._call("Start", service_pb2.StartRecordingRequest()).status

    def stop(self) -> service_pb2.RecorderStatus:
        """Ends the recording and closes its file."""
        return self._call("Stop", service_pb2.StopRecordingRequest()).status

    def split(self) -> service_pb2.RecorderStatus:
        """Ends the part that is being written, and begins the next one."""
        return self._call("Split", service_pb2.SplitRecordingRequest()).status

    def save(self, seconds: int = 0, reason: str = "") -> list[str]:
        """Keeps the parts with the last seconds (0: as many as configured); returns their files, by the server's
        paths. The reason becomes a part of their names: letters, digits and `-`."""
        return list(self._call("Save", service_pb2.SaveRecordingRequest(seconds=seconds, reason=reason)).files)

    def list(self) -> list[service_pb2.RecordedPart]:
        """The parts of this recorder, in the order in which they were begun."""
        found: service_pb2.ListRecordingsResponse = self._ask("List", service_pb2.ListRecordingsRequest())
        return [*found.parts]

    def _call(self, method: str, request: Any) -> service_pb2.RecordingResponse:
        response: service_pb2.RecordingResponse = self._ask(method, request)
        return response

    def _ask(self, method: str, request: Any) -> Any:
        with channel(self._address, self._tls) as opened:
            try:
                return getattr(Stub(opened, "RecordingService"), method)(request, timeout=_TIMEOUT_S)
            except grpc.RpcError as error:
                raise refused(self._address, error) from None

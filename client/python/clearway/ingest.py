"""Scans and poses of a vehicle -> a server, over gRPC, and the outcome of each; plans of a planner -> a server."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import grpc
import numpy as np
import numpy.typing as npt

from . import over_zenoh
from .errors import ClearwayError
from .map import Map
from .over_grpc import channel, refused
from .tls import Tls
from .v1 import Stub, ingest_pb2, journal_pb2, map_pb2

#: As in the Rust client's ingest.rs, which has the reasons.
_IN_FLIGHT_MAX = 16
_REPORT_TIMEOUT_S = 10.0
_REFUSALS_MAX = 4096
_ANSWER_TIMEOUT_S = 5.0


@dataclass(frozen=True, order=True)
class Refusal:
    """An observation that the server refused: no map contains it."""

    #: Number of the observation, as `Ingester.send` returned it.
    number: int
    #: Reason as a key, such as `stamp`, `points` or `queue`.
    reason: str
    #: What is wrong, with its value, and what is allowed.
    message: str
    #: Number of datagrams of the observation that were refused for this reason; else 1.
    count: int


class Ingester:
    """Sends the observations of one vehicle to a server at HOST:PORT, with the role `ingester` if it has roles.

        with clearway.Ingester("localhost:50051", vehicle="car") as car:
            car.send_pose(stamp_ns, (12.0, 3.0, 0.0), speed_mps=8.0)
            car.send_scan(stamp_ns, points, sensor="top")
            for refusal in car.settled():
                print(refusal.message)

    Its calls block, for a moment as a rule; from asyncio, call them by `asyncio.to_thread`.
    """

    def __init__(self, address: str, vehicle: str = "", tls: Tls | None = None) -> None:
        self._address, self._channel = address, channel(address, tls)
        self._requests: queue.SimpleQueue[ingest_pb2.Observation | None] = queue.SimpleQueue()
        self._requests.put(ingest_pb2.Observation(vehicle=vehicle))
        self._changed = threading.Condition()
        self._sent = self._acknowledged = 0
        self._refusals: list[Refusal] = []
        self._ended: ClearwayError | None = None
        self._reports: Any = Stub(self._channel, "IngestService").Stream(iter(self._requests.get, None))
        threading.Thread(target=self._read, name="clearway ingest", daemon=True).start()

    def send_scan(
        self,
        stamp_ns: int,
        points: npt.ArrayLike,
        *,
        sensor: str = "",
        intensity: npt.ArrayLike = (),
        ring: npt.ArrayLike = (),
        offset_ns: npt.ArrayLike = (),
        no_returns: npt.ArrayLike = (),
    ) -> int:
        """Sends one scan, and returns its number. `points`: x, y, z in the sensor's frame in metres, shape (n, 3).
        `stamp_ns`: the scan's end, ns since the Unix epoch. Per point, or empty: `intensity` 0 to 1; `ring`, the rank
        of its laser by elevation, 0 for the lowest; `offset_ns` after the stamp, 0 or less. `no_returns`: unit vectors
        of rays without a return, shape (n, 3). `sensor` may be empty if the vehicle has a single one."""
        xyz = np.asarray(points, "<f4")
        if xyz.ndim != 2 or xyz.shape[1] != 3:
            raise ClearwayError("points", f"points of shape {xyz.shape}: (n, 3) is allowed")
        x, y, z = (xyz[:, axis].tobytes() for axis in range(3))
        lists = {"intensity": (intensity, "<f4"), "ring": (ring, "<u2"), "offset_ns": (offset_ns, "<i4"),
                 "no_returns": (no_returns, "<f4")}  # fmt: skip
        packed = {name: np.asarray(values, dtype).tobytes() for name, (values, dtype) in lists.items()}
        scan = journal_pb2.Scan(stamp_ns=stamp_ns, x=x, y=y, z=z, **packed)
        return self.send(ingest_pb2.Observation(sensor=sensor, scan=scan))

    def send_pose(
        self,
        stamp_ns: int,
        position: Sequence[float],
        quaternion: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
        speed_mps: float = 0.0,
    ) -> int:
        """Sends the pose of the vehicle in the world frame: x, y, z in metres and a unit quaternion x, y, z, w, with
        the forward speed; returns its number."""
        (x, y, z), (qx, qy, qz, qw) = position, quaternion
        pose = map_pb2.Pose(x=x, y=y, z=z, qx=qx, qy=qy, qz=qz, qw=qw)
        ego = journal_pb2.EgoPose(stamp_ns=stamp_ns, map_from_ego=pose, speed_mps=speed_mps)
        return self.send(ingest_pb2.Observation(ego_pose=ego))

    def send(self, observation: ingest_pb2.Observation) -> int:
        """Sends any observation of ingest.proto, and returns its number. It waits while 16 are unacknowledged. Raises
        why the stream has ended: an unknown vehicle or sensor, no role, or no server."""
        with self._changed:
            number = self._sent + 1
            self._wait_acknowledged(number - _IN_FLIGHT_MAX)
            if self._ended:
                raise self._ended
            self._sent = observation.number = number
        self._requests.put(observation)
        return number

    def settled(self) -> list[Refusal]:
        """Waits until the outcome of all that was sent is known; returns the refusals that were not read before."""
        with self._changed:
            self._wait_acknowledged(self._sent)
        return self.refusals()

    def refusals(self) -> list[Refusal]:
        """The refusals known so far that were not read before, by number; at most the newest 4096."""
        with self._changed:
            refusals, self._refusals = self._refusals, []
        return sorted(refusals)

    def close(self) -> None:
        """Ends the stream. What is not settled may be lost."""
        self._requests.put(None)
        self._reports.cancel()
        self._channel.close()

    def __enter__(self) -> Ingester:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _wait_acknowledged(self, number: int) -> None:
        while self._acknowledged < number:
            if self._ended:
                raise self._ended
            before, until = self._acknowledged, time.monotonic() + _REPORT_TIMEOUT_S
            while self._acknowledged == before and not self._ended:
                if not self._changed.wait(max(until - time.monotonic(), 0.0)) and time.monotonic() >= until:
                    text = f"{self._address}: of {self._sent} observations {before} are acknowledged, and no report"
                    raise ClearwayError("silent", f"{text} came in {_REPORT_TIMEOUT_S:.0f} s")

    def _read(self) -> None:
        try:
            for report in self._reports:
                found = [Refusal(one.number, one.reason, one.message, one.count) for one in report.refused]
                with self._changed:
                    self._acknowledged = max(self._acknowledged, report.acknowledged)
                    self._refusals = (self._refusals + found)[-_REFUSALS_MAX:]
                    self._changed.notify_all()
            ended = ClearwayError("ended", f"{self._address}: the server has ended the stream")
        except grpc.RpcError as error:
            ended = refused(self._address, error)
        with self._changed:
            self._ended = ended
            self._changed.notify_all()


class PlanSender:
    """Sends what a planner did with maps to a server at HOST:PORT or zenoh:ENDPOINT, to be recorded and drawn over them;
    with the role `ingester` if clients have roles.

        with clearway.PlanSender("localhost:50051", planner="lattice") as plans:
            plans.send(m, path, footprint=[(2, 1), (-2, 1), (-2, -1), (2, -1)], goal=(30, 0), text="blocked by a car")

    Over zenoh a server does not answer: it counts a plan that it refuses as `plan` in its status.
    """

    def __init__(self, address: str, planner: str = "", tls: Tls | None = None) -> None:
        self._address, self._planner = address, planner
        self._session: Any = None
        self._channel: grpc.Channel | None = None
        if address.startswith("zenoh:"):
            self._session = over_zenoh._session(address.removeprefix("zenoh:"), tls)
        else:
            self._channel = channel(address, tls)
            self._send = Stub(self._channel, "PlanService").Send

    def send(
        self,
        m: Map,
        path: npt.ArrayLike,
        *,
        heading_rad: npt.ArrayLike = (),
        footprint: npt.ArrayLike = (),
        goal: Sequence[float] | None = None,
        text: str = "",
    ) -> None:
        """Sends the path that was planned on `m`: 1 to 4096 points (x, y) of its ego frame, in metres, in driving
        order, with the heading at each (empty: along the path), the corners (x, y) of the footprint that is kept free,
        the goal (x, y), and a text such as why the path ends. Raises ClearwayError with the value that is wrong."""
        xy, corners = np.asarray(path, "<f8"), np.asarray(footprint, "<f8")
        for name, points in (("path", xy), ("footprint", corners)):
            if points.size and (points.ndim != 2 or points.shape[1] != 2):
                raise ClearwayError("plan", f"{name} of shape {points.shape}: (n, 2) is allowed")
        xy = xy.reshape(-1, 2)
        plan = journal_pb2.Plan(
            vehicle=m.vehicle, planner=self._planner, stamp_ns=m.header.capture_end_ns, map_sequence=m.sequence,
            frame=journal_pb2.PLAN_FRAME_EGO, x=xy[:, 0], y=xy[:, 1], heading_rad=np.asarray(heading_rad, "<f8"),
            footprint_m=corners.ravel(), text=text,
        )  # fmt: skip
        if m.header.HasField("map_from_ego"):
            plan.map_from_ego.CopyFrom(m.header.map_from_ego)
        if goal is not None:
            plan.goal.x, plan.goal.y = goal
        self.send_plan(plan)

    def send_plan(self, plan: journal_pb2.Plan) -> None:
        """Sends any plan of journal.proto, such as one in the world frame."""
        if self._session is not None:
            over_zenoh.put(self._session, f"clearway/{plan.vehicle}/plan", plan.SerializeToString())
            return
        try:
            self._send(plan, timeout=_ANSWER_TIMEOUT_S)
        except grpc.RpcError as error:
            raise refused(self._address, error) from None

    def close(self) -> None:
        if self._session is not None:
            self._session.close()
        if self._channel is not None:
            self._channel.close()

    def __enter__(self) -> PlanSender:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

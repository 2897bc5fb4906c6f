"""For tests of planners: a recording is replayed as if live by a server of its own process.

With pytest, the fixture `clearway_replay` is there as soon as this package is installed:

    def test_the_street_ahead_is_free(clearway_replay):
        drive = clearway_replay()  # or clearway_replay("drive.mcap", "--speed", "0.5")
        with drive.watch(layers=["speed"]) as maps:
            assert next(maps)["speed"].is_free([(6, -1), (10, -1), (10, 1), (6, 1)])

The command `clearway` must be installed; the environment variable CLEARWAY names another one. The drive begins when the
first reader has subscribed; after its end the last map stays, and becomes stale. An iteration stops at the end of the
drive, and `next_or_stale` raises `clearway.ReplayEnded`.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import grpc

import clearway

from .over_grpc import channel, refused
from .v1 import Stub, replay_pb2

#: The golden recording: 0.9 s of a car with a VLP-16 in a simulated town, 10 maps.
TOWN = Path(__file__).resolve().parent / "golden" / "town.mcap"
#: Longest wait for the server, in seconds; ours, ten times what a loaded machine needs.
PATIENCE_S = 60.0
#: Longest seek, in seconds: stamps have 64 bits of nanoseconds.
_SEEK_S_MAX = 1e9


class ReplayState(NamedTuple):
    """What a replay does. Times are seconds after its first event."""

    #: "waiting" for readers, "playing", "paused" or "ended".
    phase: str
    position_s: float
    #: The end of the last event.
    end_s: float
    #: Speed relative to recorded time; infinity: as fast as possible.
    speed: float
    lockstep: bool
    #: In lockstep, the map that is not acknowledged yet and by whom, for people; empty if none.
    awaited: str
    #: Number of maps made so far, by vehicle: the sequence of its newest map is one less.
    maps: dict[str, int]


class Replay:
    """A recording that is replayed on free ports of this machine. `close`, the end of a `with`, or the end of this
    process, however it ends, ends the server.

    `options` are more options of `clearway replay`, such as "--speed", "0.5". A server that does not start is a
    `ClearwayError` with its message.
    """

    def __init__(self, recording: str | os.PathLike[str] = TOWN, *options: str) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="clearway-replay-")
        ready, log = Path(self._folder.name, "ready.json"), Path(self._folder.name, "log.txt")
        command = os.environ.get("CLEARWAY", "clearway")
        arguments = ["--serve", "--as-live", "--any-port", "--ready-file", str(ready)]
        if "--wait-readers" not in options:
            arguments += ["--wait-readers", "1"]
        try:
            with log.open("w") as stderr:
                self._server = subprocess.Popen(
                    [command, "replay", os.fspath(recording), *arguments, *options],
                    stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=stderr,
                )  # fmt: skip
        except OSError as error:
            self._folder.cleanup()
            raise clearway.ClearwayError("command", f"{command}: {error.strerror}; install clearway, or name its "
                                         "command in the environment variable CLEARWAY") from error  # fmt: skip
        #: The file of the log while the server runs, then its text.
        self._log: Path | str = log
        until = time.monotonic() + PATIENCE_S
        while not ready.exists():
            ended = self._server.poll() is not None
            if ended or time.monotonic() > until:
                said = log.read_text().strip()
                self.close()
                raise clearway.ClearwayError("ended" if ended else "late", f"clearway replay is not ready: {said}")
            time.sleep(0.005)
        addresses = json.loads(ready.read_text())
        #: Address of gRPC, HOST:PORT.
        self.grpc: str = addresses["grpc"]
        #: Address of the page, a URL; None if it is not served.
        self.page: str | None = addresses["page"]
        #: Address of zenoh for `clearway.watch`, zenoh:ENDPOINT; None if it is not served.
        self.zenoh: str | None = next((f"zenoh:{endpoint}" for endpoint in addresses["zenoh"]), None)

    def watch(self, **selection: Any) -> clearway.MapStream:
        """Streams the newest map; it has the arguments of `clearway.watch`."""
        return clearway.watch(self.grpc, **selection)

    def state(self) -> ReplayState:
        """What the replay does now."""
        return self._control()

    def pause(self) -> ReplayState:
        """Stops the drive until `play`. The newest map stays, and becomes stale."""
        return self._control(paused=True)

    def play(self) -> ReplayState:
        """Goes on."""
        return self._control(paused=False)

    def step(self, maps: int = 1) -> ReplayState:
        """Makes so many maps, and pauses; returns when they are made."""
        if not 0 <= maps < 1 << 32:
            raise clearway.ClearwayError("INVALID_ARGUMENT", f"step {maps} maps: 0 to {(1 << 32) - 1} are allowed")
        return self._control(step=maps)

    def seek(self, seconds: float) -> ReplayState:
        """Goes to a time after the first event; the newest map of that moment is published at once. A paused replay
        stays paused there, a finished replay plays on."""
        if not abs(seconds) < _SEEK_S_MAX:
            text = f"seek {seconds} s: a number under {_SEEK_S_MAX:.0e} is allowed"
            raise clearway.ClearwayError("INVALID_ARGUMENT", text)
        return self._control(seek_ns=self._begin_ns() + round(seconds * 1e9))

    def speed(self, factor: float) -> ReplayState:
        """Sets the speed relative to recorded time: 0.1 to 1000, or `math.inf` for as fast as possible."""
        return self._control(rate=factor)

    def lockstep(self, on: bool = True) -> ReplayState:
        """Makes the next map when every reader has asked for the one after the last."""
        return self._control(lockstep=on)

    def wait(self, timeout_s: float = PATIENCE_S) -> int:
        """Waits until the server has ended, which it does with the option "--exit-at-end"; returns its exit code. A
        server that has not ended by then is a `ClearwayError` of reason "late"."""
        try:
            return self._server.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise clearway.ClearwayError("late", f"clearway replay has not ended after {timeout_s} s") from None

    @property
    def exit_code(self) -> int | None:
        """Exit code of the server; None while it runs. Negative: the signal that ended it."""
        return self._server.poll()

    @property
    def log(self) -> str:
        """What the server has said until now."""
        return self._log.read_text() if isinstance(self._log, Path) else self._log

    def _begin_ns(self) -> int:
        return self._call(replay_pb2.ReplayControl()).begin_ns

    def _call(self, request: replay_pb2.ReplayControl) -> replay_pb2.ReplayState:
        with channel(self.grpc) as opened:
            try:
                state: replay_pb2.ReplayState = Stub(opened, "ReplayService").Control(request, timeout=PATIENCE_S)
            except grpc.RpcError as error:
                raise refused(self.grpc, error) from None
        return state

    def _control(self, **change: Any) -> ReplayState:
        state = self._call(replay_pb2.ReplayControl(**change))
        phase = replay_pb2.ReplayPhase.Name(state.phase).removeprefix("REPLAY_PHASE_").lower()
        position_s, end_s = ((ns - state.begin_ns) * 1e-9 for ns in (state.position_ns, state.end_ns))
        maps = dict(zip(state.vehicles, state.maps))
        return ReplayState(phase, position_s, end_s, state.rate, state.lockstep, state.awaited, maps)

    def close(self) -> None:
        """Stops the server as a crash would: without a word to its readers."""
        self._server.kill()
        self._server.wait()
        if self._server.stdin is not None:
            self._server.stdin.close()
        if isinstance(self._log, Path):
            self._log = self._log.read_text()
        self._folder.cleanup()

    def __enter__(self) -> Replay:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

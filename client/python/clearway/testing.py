"""For tests of planners: a recording is replayed as if live by a server of its own process.

With pytest, the fixture `clearway_replay` is there as soon as this package is installed:

    def test_the_street_ahead_is_free(clearway_replay):
        drive = clearway_replay()  # or clearway_replay("drive.mcap", "--speed", "0.5")
        with drive.watch(layers=["speed"]) as maps:
            assert next(maps)["speed"].is_free([(6, -1), (10, -1), (10, 1), (6, 1)])

The command `clearway` must be installed; the environment variable CLEARWAY names another one. The drive begins when the
first reader has subscribed; after its end the last map stays, and becomes stale.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import clearway

#: The golden recording: 0.9 s of a car with a VLP-16 in a simulated town, 10 maps.
TOWN = Path(__file__).resolve().parent / "golden" / "town.mcap"
#: Longest wait for the server, in seconds; ours, ten times what a loaded machine needs.
PATIENCE_S = 60.0


class Replay:
    """A recording that is replayed on free ports of this machine. `close`, or the end of a `with`, ends the server.

    `options` are more options of `clearway replay`, such as "--speed", "0.5". A server that does not start is a
    `ClearwayError` with its message.
    """

    def __init__(self, recording: str | os.PathLike[str] = TOWN, *options: str) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="clearway-replay-")
        ready, log = Path(self._folder.name, "ready.json"), Path(self._folder.name, "log.txt")
        command = os.environ.get("CLEARWAY", "clearway")
        arguments = ["--serve", "--as-live", "--any-port", "--wait-readers", "1", "--ready-file", str(ready)]
        try:
            with log.open("w") as stderr:
                self._server = subprocess.Popen(
                    [command, "replay", os.fspath(recording), *arguments, *options],
                    stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=stderr,
                )  # fmt: skip
        except OSError as error:
            self._folder.cleanup()
            raise clearway.ClearwayError("command", f"{command}: {error.strerror}; install clearway, or name its "
                                         "command in the environment variable CLEARWAY") from error  # fmt: skip
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
        """Streams the newest map; the arguments are those of `clearway.watch`."""
        return clearway.watch(self.grpc, **selection)

    def close(self) -> None:
        """Stops the server as a crash would: without a word to its readers."""
        self._server.kill()
        self._server.wait()
        self._folder.cleanup()

    def __enter__(self) -> Replay:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

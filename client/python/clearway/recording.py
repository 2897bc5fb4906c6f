"""The maps and plans of a recording (MCAP), in the order in which they were recorded. A file that cannot be read, or is
damaged, is a `ClearwayError` that names it, of reason "recording", or the reason of a map that is refused."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from os import PathLike
from typing import BinaryIO

from .errors import ClearwayError, DecodeError
from .map import Map
from .v1 import journal_pb2, map_pb2

#: The end of a file: where the summary starts, where its offsets start, and its CRC; then the magic bytes.
_FOOTER, _MAGIC_SIZE = struct.Struct("<Q8xI"), 8


def read(file: str | PathLike[str], layer: str, vehicle: str = "") -> Iterator[Map]:
    """Yields the recorded maps of one layer. `vehicle` may be empty if the recording has a single vehicle."""

    def selected(topics: set[str]) -> set[str]:
        names = {f"/{vehicle}/map/{layer}"} if vehicle else {t for t in topics if t.endswith(f"/map/{layer}")}
        if len(topics & names) != 1:
            text = f"{file}: {len(topics & names)} topics fit layer {layer!r}; the recording has {_maps(topics)}"
            raise ClearwayError("layer", text)
        return names

    with _naming(file):
        for _, message in _messages(file, selected):
            yield Map(message)


def read_all(file: str | PathLike[str], vehicle: str = "") -> Iterator[Map | journal_pb2.Plan]:
    """Yields the recorded maps with all their layers, and each plan behind the map before it. `vehicle` may be empty if
    the recording has a single vehicle."""

    def selected(topics: set[str]) -> set[str]:
        vehicles = {topic.split("/map/")[0] for topic in topics if "/map/" in topic}
        if vehicle or len(vehicles) != 1:
            vehicles &= {f"/{vehicle}"}
        if not vehicles:
            text = f"{file}: no maps of vehicle {vehicle!r}; the recording has {_maps(topics)}"
            raise ClearwayError("vehicle", text)
        return {topic for topic in topics for of in vehicles if topic.startswith((f"{of}/map/", f"{of}/journal"))}

    with _naming(file):
        yield from _whole(_messages(file, selected))


def _whole(messages: Iterator[tuple[str, bytes]]) -> Iterator[Map | journal_pb2.Plan]:
    whole, plans = map_pb2.Map(), list[journal_pb2.Plan]()
    for topic, message in messages:
        if "/map/" not in topic:
            event = journal_pb2.Event.FromString(message)
            plans += [event.plan] if event.HasField("plan") else []
            continue
        # Each layer has a topic of its own.
        part = map_pb2.Map.FromString(message)
        if (part.header.boot_id, part.header.sequence) == (whole.header.boot_id, whole.header.sequence):
            whole.layers.extend(part.layers)
            continue
        if whole.layers:
            yield Map(whole.SerializeToString())
        yield from plans
        whole, plans = part, []
    if whole.layers:
        yield Map(whole.SerializeToString())
    yield from plans


@contextmanager
def _naming(file: str | PathLike[str]) -> Iterator[None]:
    """Whatever is wrong inside is an error that names the file. Damage reaches every layer of the MCAP reader."""
    try:
        yield
    except DecodeError as error:
        raise DecodeError(error.reason, f"{file}: {error}") from None
    except ClearwayError:
        raise
    except OSError as error:
        raise ClearwayError("recording", f"{file}: {error.strerror or error}") from error
    except Exception as error:
        text = f"the recording is damaged ({type(error).__name__}: {error})"
        raise ClearwayError("recording", f"{file}: {text}: `clearway repair` saves what can be read of it") from error


def _check_summary(stream: BinaryIO) -> None:
    """Checks the CRC of the summary, which the MCAP reader does not; 0 means none."""
    stream.seek(-(_FOOTER.size + _MAGIC_SIZE), os.SEEK_END)
    start, crc = _FOOTER.unpack(stream.read(_FOOTER.size))
    stream.seek(start)
    if start and crc and zlib.crc32(stream.read()[: -(_MAGIC_SIZE + 4)]) != crc:
        raise ValueError("the CRC of its summary is wrong")


def _maps(topics: set[str]) -> str:
    return ", ".join(sorted(topic for topic in topics if "/map/" in topic)) or "none"


def _messages(file: str | PathLike[str], selected: Callable[[set[str]], set[str]]) -> Iterator[tuple[str, bytes]]:
    """The topics and contents of the messages on the topics that are selected of all."""
    try:
        from mcap.exceptions import McapError
        from mcap.reader import make_reader
    except ImportError:
        raise ClearwayError("mcap", "mcap is not installed: pip install 'clearway[recording]'") from None
    with open(file, "rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        try:
            summary = reader.get_summary()
        except McapError as error:
            summary, why = None, str(error)
        else:
            why = "it has no summary"
        if summary is None:
            text = f"{file}: the recording is not whole ({why}): `clearway repair` saves what can be read of it"
            raise ClearwayError("recording", text)
        _check_summary(stream)
        topics = selected({channel.topic for channel in summary.channels.values()})
        for _, channel, message in reader.iter_messages(topics=topics):
            yield channel.topic, message.data

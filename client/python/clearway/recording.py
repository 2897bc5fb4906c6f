"""The maps and plans of a recording (MCAP), in the order in which they were recorded."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from os import PathLike

from .errors import ClearwayError
from .map import Map
from .v1 import journal_pb2, map_pb2


def read(file: str | PathLike[str], layer: str, vehicle: str = "") -> Iterator[Map]:
    """Yields the recorded maps of one layer. `vehicle` may be empty if the recording has a single vehicle."""

    def selected(topics: set[str]) -> set[str]:
        names = {f"/{vehicle}/map/{layer}"} if vehicle else {t for t in topics if t.endswith(f"/map/{layer}")}
        if len(topics & names) != 1:
            text = f"{file}: {len(topics & names)} topics fit layer {layer!r}; the recording has {_maps(topics)}"
            raise ClearwayError("layer", text)
        return names

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

    whole, plans = map_pb2.Map(), list[journal_pb2.Plan]()
    for topic, message in _messages(file, selected):
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
        reader = make_reader(stream)
        try:
            summary = reader.get_summary()
        except McapError as error:
            summary, why = None, str(error)
        else:
            why = "it has no summary"
        if summary is None:
            text = f"{file}: the recording is not whole ({why}): `clearway repair` saves what can be read of it"
            raise ClearwayError("recording", text)
        topics = selected({channel.topic for channel in summary.channels.values()})
        for _, channel, message in reader.iter_messages(topics=topics):
            yield channel.topic, message.data

"""The maps of a recording (MCAP), in the order in which they were made."""

from __future__ import annotations

from collections.abc import Iterator
from os import PathLike

from .errors import ClearwayError
from .map import Map


def read(file: str | PathLike[str], layer: str, vehicle: str = "") -> Iterator[Map]:
    """Yields the recorded maps of one layer. `vehicle` may be empty if the recording has a single vehicle."""
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
        topics = {channel.topic for channel in summary.channels.values()}
        names = {f"/{vehicle}/map/{layer}"} if vehicle else {t for t in topics if t.endswith(f"/map/{layer}")}
        selected = topics & names
        if len(selected) != 1:
            known = ", ".join(sorted(t for t in topics if "/map/" in t)) or "none"
            text = f"{file}: {len(selected)} topics fit layer {layer!r}; the recording has {known}"
            raise ClearwayError("layer", text)
        for _, _, message in reader.iter_messages(topics=selected):
            yield Map(message.data)

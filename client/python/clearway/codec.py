"""Decodes the cells of a channel, as `proto/src/channel` does; both read the same golden vectors.

In: a `Channel` message from any source, also a hostile one. Out: an array of raw cells, or a `DecodeError`. The claimed
number of cells is checked before memory is allocated; where it is large beside the payload, so are the lengths in the
payload, so that a false claim costs nothing. Only the Rust decoder checks that a payload is canonical; here
the CRC alone decides whether the cells are right. Format: `proto/clearway/v1/map.proto`, `Channel` and `Encoding`.
"""

import re
import zlib
from collections.abc import Callable

import numpy as np

from .errors import DecodeError
from .limits import CHANNEL_CELLS_MAX, NUMBER_BITS_MAX
from .v1 import map_pb2

_TYPES: dict[int, np.dtype] = {1: np.dtype("u1"), 2: np.dtype("i1"), 3: np.dtype("<u2")}
_RAW, _ROWS, _CHANGES = map_pb2.ENCODING_RAW, map_pb2.ENCODING_ROWS, map_pb2.ENCODING_CHANGES
# Claims of more cells for each byte of the payload are checked before memory is allocated for them.
_CELLS_PER_BYTE = 1024
_BUSY = re.compile(rb"[^\0]")


def decode(channel: map_pb2.Channel, columns: int, base: Callable[[np.dtype], np.ndarray] | None = None) -> np.ndarray:
    """Returns the cells, shape (rows, columns). `base` makes the base of changes for a type of cells; it is called
    after the counts are checked."""
    count, payload = channel.cell_count, channel.payload
    dtype = _TYPES.get(channel.cell_type)
    if count > CHANNEL_CELLS_MAX:
        raise DecodeError("too_many_cells", f"{count} cells; at most {CHANNEL_CELLS_MAX} are allowed")
    spare = count * dtype.itemsize - len(payload) if dtype else -1
    fits = {_RAW: spare == 0, _ROWS: spare > 0, _CHANGES: spare > 0 and base is not None}
    if dtype is None or not fits.get(channel.encoding):
        raise DecodeError("cells", f"{len(payload)} bytes of encoding {channel.encoding} for {count} {dtype} cells")
    if channel.encoding == _RAW:
        cells = np.frombuffer(payload, dtype).reshape(-1, columns)
    elif channel.encoding == _ROWS:
        if count > _CELLS_PER_BYTE * (len(payload) + 64):
            _check_lengths(_Bits(payload, dtype), count)
        cells = _rows(_Bits(payload, dtype), count // columns, columns, dtype)
    elif base is not None:
        cells = _changes(_Bits(payload, dtype), base(dtype))
    if zlib.crc32(cells.tobytes()) != channel.crc32:
        raise DecodeError("cells", f"CRC-32 of the cells is not {channel.crc32:08x}, as the channel states")
    return cells


class _Bits:
    """Reads numbers from bits, most significant bit first."""

    def __init__(self, payload: bytes, dtype: np.dtype) -> None:
        self.text, self.at, self.dtype = bin(int.from_bytes(b"\1" + payload, "big"))[3:], 0, dtype
        self.means: dict[object, int] = {}

    def bit(self) -> bool:
        self.at += 1
        return self.text[self.at - 1 : self.at] == "1"

    def number(self, order: int = 0) -> int:
        """Reads a number in exp-Golomb code of an order."""
        one = self.text.find("1", self.at, self.at + NUMBER_BITS_MAX + 1 - order)
        start, self.at = one, 2 * one + 1 - self.at + order
        if one < 0 or self.at > len(self.text):
            raise DecodeError("cells", f"the payload ends inside the cells, or a number exceeds {NUMBER_BITS_MAX} bits")
        return int(self.text[start : self.at], 2) - (1 << order)

    def adaptive(self, kind: object) -> int:
        """Reads a number in the order that follows from the mean of the numbers of this kind."""
        mean = self.means.get(kind, 0)
        number = self.number(max(mean.bit_length() - 1, 0))
        self.means[kind] = (mean + number + 1) // 2
        return number

    def cell(self, number: int) -> np.generic:
        signed = number >> 1 ^ -(number & 1) if self.dtype.kind == "i" else number
        cell: np.generic = np.int64(signed).astype(self.dtype)
        return cell


def _check_lengths(bits: _Bits, count: int) -> None:
    """Checks that the lengths of `ENCODING_ROWS` add up to the number of cells."""
    at = 0
    while at < count:
        at += bits.number()
        if at < count:
            if not bits.bit():
                bits.number()
            at += bits.number() + 1
    if at != count:
        raise DecodeError("cells", f"the payload has {at} cells, not {count}")


def _rows(bits: _Bits, rows: int, columns: int, dtype: np.dtype) -> np.ndarray:
    """Decodes `ENCODING_ROWS`: copies of the row before and runs of one value, in turn."""
    cells, at = np.zeros((rows + 1) * columns, dtype), columns
    while at < len(cells):
        end = min(at + bits.number(), len(cells))
        cells[at:end], at = np.resize(cells[at - columns : at], end - at), end
        if at < len(cells):
            value = cells[at - 1] if bits.bit() else bits.cell(bits.number())
            end = at + bits.number() + 1
            cells[at:end], at = value, end
    return cells[columns:].reshape(rows, columns)


def _changes(bits: _Bits, base: np.ndarray) -> np.ndarray:
    """Decodes `ENCODING_CHANGES`: differences from a base, whose flags are runs in each context."""
    #: Flag of each context's present run, and the flags left in it.
    runs: dict[int, tuple[bool, int]] = {}

    def read_flag(context: int) -> bool:
        changed, left = runs.get(context, (False, 0))
        if not left:
            changed = not changed if context in runs else bits.bit()
            left = bits.adaptive((context, changed)) + 1
        runs[context] = changed, left - 1
        return changed

    # One more row and column on each side, with the values of the border cells: outside the grid nothing differs.
    (rows, columns), around = base.shape, np.pad(base, 1, mode="edge")
    beside = {4: around[:-2, 1:-1], 8: around[1:-1, :-2], 16: around[2:, 1:-1], 32: around[1:-1, 2:]}
    borders = sum((cells != base) * np.uint8(bit) for bit, cells in beside.items())
    contexts = bytearray(borders.tobytes() + b"\1" * columns)
    at, width, cells = 0, columns + 2, around.reshape(-1)
    while at < base.size:
        step, (changed, left) = 1, runs.get(0, (True, 0))
        if not contexts[at] and left and not changed:
            # Unchanged cells of context 0 are skipped together.
            busy = _BUSY.search(contexts, at)
            step = min((busy.start() if busy else base.size) - at, left)
            runs[0] = changed, left - step
        elif read_flag(contexts[at]):
            here = (at // columns + 1) * width + at % columns + 1
            near = cells[[here - 1, here - width, here + 1, here + width]]
            predicted = near[near != cells[here]][:1]
            cells[here] = bits.cell(bits.adaptive("value")) if not len(predicted) or read_flag(64) else predicted[0]
            contexts[at + columns] |= 1
            contexts[at + 1] |= 2 if (at + 1) % columns else 0
        at += step
    return around[1:-1, 1:-1]


def by_class(channel: map_pb2.Channel, classes: np.ndarray, legend: int, dtype: np.dtype) -> np.ndarray:
    """The base of a channel with a class table: the table's value for the class of each cell. `legend`: number of
    classes."""
    if classes.dtype != np.uint8 or len(channel.by_class) != legend * dtype.itemsize or (classes >= legend).any():
        raise DecodeError("by_class", f"channel {channel.name!r}: {len(channel.by_class)} bytes, {legend} classes")
    table: np.ndarray = np.frombuffer(channel.by_class, dtype)
    return np.asarray(table[classes])


def shifted(before: np.ndarray, shape: tuple[int, int], by: tuple[int, int], unknown: int) -> np.ndarray:
    """The base of a delta: cell (row, column) + `by` of the base layer, `unknown` if there is no such cell."""
    cells = np.full(shape, np.int64(unknown).astype(before.dtype), before.dtype)
    spans = [(max(0, -by[i]), min(shape[i], before.shape[i] - by[i])) for i in (0, 1)]
    if all(start < end for start, end in spans):
        here, there = (tuple(slice(a + d, b + d) for (a, b), d in zip(spans, of)) for of in ((0, 0), by))
        cells[here] = before[there]
    return cells

"""A channel's payload back to its cells: the numpy twin of `proto/src/decode.rs`, held to the same golden vectors.

In: a `Channel` message from anywhere, hostile or not. Out: a one-dimensional array of raw cells, or a `DecodeError`.
Claimed counts are checked before any cell is made. In a delta the cells are differences from those predicted.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from .errors import DecodeError

if TYPE_CHECKING:
    from .v1 import map_pb2

#: Cells of one channel that are accepted: a 400 m square at 0.2 m.
CELLS_MAX = 4 << 20

_TYPES = {1: np.dtype("u1"), 2: np.dtype("i1"), 3: np.dtype("<u2")}
_DIGITS = bytes.maketrans(b"\0\1", b"01")
_RAW, _RUNS, _ROWS = 1, 2, 3
#: Columns of coded rows: what the server makes at most.
_COLUMNS_MAX = 1 << 14


def decode(
    channel: map_pb2.Channel, cells_max: int = CELLS_MAX, predict: Callable[[np.dtype], np.ndarray] | None = None
) -> np.ndarray:
    """Gives the cells in the order of the grid's cell index; raises `DecodeError` with the first thing found wrong.

    `predict`, for a delta, makes the cells that the differences are added to; it is asked when counts are checked.
    """
    count, payload = channel.cell_count, channel.payload
    if count > cells_max:
        raise DecodeError("too_many_cells", f"{count} cells; at most {cells_max} are allowed")
    dtype = _TYPES.get(channel.cell_type)
    if dtype is None:
        raise DecodeError("cell_type", f"cell type {channel.cell_type}; 1 (u8), 2 (i8) and 3 (u16) exist")
    raw_length = count * dtype.itemsize
    if channel.encoding == _RAW:
        if len(payload) != raw_length:
            raise DecodeError("raw_length", f"raw payload of {len(payload)} bytes; {count} cells take {raw_length}")
        cells = np.frombuffer(payload, dtype)
    elif channel.encoding in (_RUNS, _ROWS):
        if len(payload) >= raw_length:
            raise DecodeError("runs_not_smaller", f"runs of {len(payload)} bytes; under {raw_length} is needed")
        cells = (_runs if channel.encoding == _RUNS else _rows)(payload, count, dtype)
    else:
        raise DecodeError("encoding", f"encoding {channel.encoding}; 1 (raw), 2 (runs) and 3 (rows) exist")
    if predict is not None:
        # Differences of unsigned cells zigzag; all wrap.
        cells = predict(dtype) + (cells if dtype.kind == "i" else (cells >> 1) ^ -(cells & 1))
    computed = zlib.crc32(cells.tobytes())
    if computed != channel.crc32:
        raise DecodeError("crc", f"CRC-32 of the cells is {computed:08x}; the channel says {channel.crc32:08x}")
    return cells


def _runs(payload: bytes, count: int, dtype: np.dtype) -> np.ndarray:
    """Canonical runs: varint(value) varint(length - 1), signed values zigzag, neighbours differ."""
    top = (1 << (8 * dtype.itemsize)) - 1
    varints = _varints(payload)
    if varints is None or len(varints) % 2:
        raise _fault(payload, count, top)
    values, lengths = varints[0::2], varints[1::2] + 1
    canonical = (values <= top).all() and (values[1:] != values[:-1]).all()
    if not canonical or int(lengths.sum()) != count:
        raise _fault(payload, count, top)
    if dtype.kind == "i":
        values = (values >> 1) ^ -(values & 1)
    return np.repeat(values.astype(dtype), lengths)


def _rows(payload: bytes, count: int, dtype: np.dtype) -> np.ndarray:
    """Rows predicted by the rows before: cells as a row before, a run of another value, and so on."""
    top = (1 << (8 * dtype.itemsize)) - 1
    columns = at = 0
    while at == 0 or payload[at - 1] >= 0x80:
        if at == len(payload):
            raise DecodeError("truncated", f"payload ends at byte {at}, inside the number of columns")
        if at == 4 or (at > 0 and payload[at] == 0):
            raise DecodeError("overlong_varint", "overlong varint at byte 0")
        columns |= (payload[at] & 0x7F) << (7 * at)
        at += 1
    if not 1 <= columns <= min(_COLUMNS_MAX, count):
        raise DecodeError("columns", f"rows of {columns} columns; 1 to {min(_COLUMNS_MAX, count)} are allowed")
    bits, at = np.unpackbits(np.frombuffer(payload, np.uint8)).tobytes(), 8 * at

    def number() -> int:
        nonlocal at
        one = bits.find(b"\1", at, at + 33)
        if one < 0 and at + 33 <= len(bits):
            raise DecodeError("overlong_varint", f"overlong number at byte {at // 8}")
        end = 2 * one - at + 1
        if one < 0 or end > len(bits):
            raise DecodeError("truncated", f"payload ends at byte {len(payload)}, inside a run")
        value = int(bits[one:end].translate(_DIGITS), 2) - 1
        at = end
        return value

    def fits(length: int) -> int:
        if length > count - filled:
            raise DecodeError("run_too_long", f"{length} cells at cell {filled}; {count - filled} are left")
        return filled + length

    def above() -> int:
        return int(cells[filled - columns]) if filled >= columns else 0

    # On the wire, signed values zigzag.
    cells, filled, run = np.zeros(count, np.uint16 if top > 0xFF else np.uint8), 0, None
    while filled < count:
        end = fits(number())
        if filled < end and above() == run:
            raise DecodeError("equal_neighbours", f"the run before cell {filled} goes on")
        run = None if filled < end else run
        filled = max(filled, min(end, columns))
        while filled < end:
            stretch = min(columns, end - filled)
            cells[filled : filled + stretch] = cells[filled - columns : filled - columns + stretch]
            filled += stretch
        if filled == count:
            break
        if at == len(bits):
            raise DecodeError("truncated", f"payload ends at byte {len(payload)}, inside a run")
        before, same, at = int(cells[filled - 1]) if filled else None, bits[at], at + 1
        value = before if same else number()
        if value is None or value > top:
            raise DecodeError("value_too_large", f"value {value} at cell {filled}; at most {top} is allowed")
        if value in (above(), run) or (not same and value == before):
            raise DecodeError("equal_neighbours", f"value {value} at cell {filled} is the one before it or above")
        end = fits(number() + 1)
        cells[filled:end] = value
        filled, run = end, value
    if b"\1" in bits[at:] or len(bits) - at >= 8:
        raise DecodeError("trailing_bytes", f"{(len(bits) - at + 7) // 8} bytes follow the last cell")
    if dtype.kind == "i":
        return ((cells >> 1) ^ -(cells & 1)).astype(dtype)
    return cells.astype(dtype)


def _varints(payload: bytes) -> np.ndarray | None:
    """Every varint of the payload; `None` where the last is cut off or one is overlong."""
    data = np.frombuffer(payload, np.uint8)
    ends = np.flatnonzero(data < 0x80)
    if ends.size == 0 or ends[-1] != data.size - 1:
        return None if data.size else np.empty(0, np.int64)
    starts = np.concatenate(([0], ends[:-1] + 1))
    sizes = ends - starts + 1
    if sizes.max() > 5 or (data[ends][sizes > 1] == 0).any():
        return None
    values = np.zeros(ends.size, np.int64)
    for place in range(int(sizes.max())):
        here = sizes > place
        values[here] |= (data[starts[here] + place].astype(np.int64) & 0x7F) << (7 * place)
    return values


def _fault(payload: bytes, count: int, top: int) -> DecodeError:
    """The first thing wrong with runs that are not canonical, in the order of the bytes."""
    offset, left, previous = 0, count, None

    def varint() -> int:
        nonlocal offset
        start, value = offset, 0
        while True:
            if offset == len(payload):
                raise DecodeError("truncated", f"payload ends at byte {offset}, inside a run")
            byte = payload[offset]
            if offset - start == 5 or (offset > start and byte == 0):
                raise DecodeError("overlong_varint", f"overlong varint at byte {start}")
            value |= (byte & 0x7F) << (7 * (offset - start))
            offset += 1
            if byte < 0x80:
                return value

    try:
        while left:
            start = offset
            if offset == len(payload):
                return DecodeError("too_few_cells", f"the runs sum to {count - left} cells; {count} are claimed")
            value = varint()
            if value > top:
                return DecodeError("value_too_large", f"value {value} at byte {start}; at most {top} is allowed")
            length = varint() + 1
            if value == previous:
                return DecodeError("equal_neighbours", f"the run at byte {start} repeats the value {value}")
            if length > left:
                return DecodeError("run_too_long", f"the run at byte {start} has {length} cells; {left} are left")
            previous, left = value, left - length
    except DecodeError as fault:
        return fault
    return DecodeError("trailing_bytes", f"{len(payload) - offset} bytes follow the last run")

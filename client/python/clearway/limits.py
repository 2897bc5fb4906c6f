"""Limits of the map format: the values of `proto/src/limits.rs`. A test compares them with
`proto/golden/limits.json`."""

from __future__ import annotations

#: Most cells of one channel: a square of 400 m with cells of 0.2 m.
CHANNEL_CELLS_MAX = 4 << 20
#: Most cells of all channels of a map together.
MAP_CELLS_MAX = 16 << 20
#: Most bytes of an encoded map: what gRPC receives by default. The default grids need less than 64 KiB.
MAP_BYTES_MAX = 4 << 20
#: Most parts of a map, and most safe points of a layer.
MAP_PARTS_MAX = 1 << 16
#: Longest number in an encoded payload, in bits.
NUMBER_BITS_MAX = 32
#: Greatest coordinate of a safe point, in steps: single precision represents integers exactly up to here.
SAFE_POINT_STEPS_MAX = 1 << 24
#: Greatest colour of a class: 0xRRGGBB.
RGB_MAX = 0xFFFFFF
#: Latest major version of the wire that is read; 0 and 1 are the first one.
WIRE_VERSION = 1


def count_parts(message: bytes, is_map: bool = True) -> int:
    """Number of layers, channels, planes, sensors and names that an encoded map claims to have, counted before any is
    made: the length-delimited fields of the map, its header and its layers. Stops above `MAP_PARTS_MAX`, and where the
    bytes are no protobuf, which the decoder then names."""
    parts = at = 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while shift < 70:
            byte, at = message[at], at + 1
            value, shift = value | (byte & 127) << shift, shift + 7
            if byte < 128:
                break
        return value

    try:
        while at < len(message) and parts <= MAP_PARTS_MAX:
            tag, kind = divmod(varint(), 8)
            if kind == _LENGTH:
                length, parts = varint(), parts + 1
                if is_map and tag in (1, 2):
                    parts += count_parts(message[at : at + length], False)
                at += length
            elif kind == _VARINT:
                varint()
            else:
                at += _SIZES[kind]
    except LookupError:
        pass
    return parts


#: Wire types of protobuf, and the bytes of a field of the others. A group is passed through.
_VARINT, _LENGTH = 0, 2
_SIZES = {1: 8, 3: 0, 4: 0, 5: 4}

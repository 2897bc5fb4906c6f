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

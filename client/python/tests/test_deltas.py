"""How the client reacts to deltas without a base. The golden vectors (test_decoder.py) test the deltas themselves."""

import pytest

import clearway
from clearway.over_grpc import _receive_maps
from clearway.stream import LatestSlot
from clearway.v1 import map_pb2, service_pb2


def update(sequence, base_sequence=None):
    """An update with a map of one layer without a channel."""
    header = map_pb2.Header(vehicle="alpha", boot_id=7, sequence=sequence, valid_until_ns=1 << 62)
    grid = map_pb2.CartesianGrid(width=1, height=1, cell_m=1.0)
    layer = map_pb2.Layer(name="terrain", cartesian=grid, base_sequence=base_sequence)
    return service_pb2.MapUpdate(map=map_pb2.Map(header=header, layers=[layer]).SerializeToString())


def receive(*updates):
    slot, requests, returned = LatestSlot(), [], []

    def incoming():
        for update in updates:
            yield update
            if slot._is_unseen():
                returned.append(slot.next(report_stale=False))

    _receive_maps(slot, incoming(), requests.append, acknowledges=True)
    return [(m.sequence, m.skipped) for m in returned], [(r.acknowledged, r.request_keyframe) for r in requests]


def test_a_lost_update_requests_a_keyframe():
    returned, requests = receive(update(0), update(1, 0), update(3, 2), update(4, 3), update(5), update(6, 5))
    assert returned == [(0, 0), (1, 0), (5, 3), (6, 0)]
    assert requests == [(0, False), (1, False), (3, True), (4, False), (5, False), (6, False)]


def test_an_invalid_whole_map_ends_the_stream():
    with pytest.raises(clearway.DecodeError):
        receive(update(0), service_pb2.MapUpdate(), update(2))

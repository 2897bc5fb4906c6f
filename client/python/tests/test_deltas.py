"""What the client does about deltas that it cannot use; what deltas are is held by the golden vectors (test_decoder.py)."""

import pytest

import clearway
from clearway.over_grpc import _follow
from clearway.stream import MapStream
from clearway.v1 import map_pb2, service_pb2


def update(sequence, base_sequence=None):
    """A map of one layer without a channel: nothing has changed."""
    header = map_pb2.Header(vehicle="alpha", boot_id=7, sequence=sequence, valid_until_ns=1 << 62)
    grid = map_pb2.CartesianGrid(width=1, height=1, cell_m=1.0)
    layer = map_pb2.Layer(name="terrain", cartesian=grid, base_sequence=base_sequence)
    return service_pb2.MapUpdate(map=map_pb2.Map(header=header, layers=[layer]).SerializeToString())


def follow(*updates):
    stream, requests, shown = MapStream(), [], []

    def coming():
        for update in updates:
            yield update
            if stream._is_unseen():
                shown.append(next(stream))

    _follow(stream, coming(), requests.append, acknowledges=True)
    return [(m.sequence, m.skipped) for m in shown], [(r.acknowledged, r.request_keyframe) for r in requests]


def test_a_lost_update_leads_to_a_whole_map_and_is_not_shown():
    shown, requests = follow(update(0), update(1, 0), update(3, 2), update(4, 3), update(5), update(6, 5))
    assert shown == [(0, 0), (1, 0), (5, 3), (6, 0)]
    assert requests == [(0, False), (1, False), (3, True), (4, False), (5, False), (6, False)]


def test_a_whole_map_that_is_wrong_ends_the_stream():
    with pytest.raises(clearway.DecodeError):
        follow(update(0), service_pb2.MapUpdate(), update(2))

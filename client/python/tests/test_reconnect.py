"""A stream over gRPC that is to reconnect, against a server in this process that ends each stream after a map."""

import json
import logging
import socket
from concurrent import futures
from contextlib import contextmanager
from pathlib import Path

import grpc
import pytest

import clearway
from clearway.over_grpc import _target
from clearway.v1 import map_pb2, service_pb2

ADDRESSES = json.loads((Path(__file__).resolve().parents[2] / "golden" / "addresses.json").read_text())


@pytest.mark.parametrize("case", ADDRESSES, ids=lambda case: case["address"])
def test_every_client_accepts_and_refuses_the_same_addresses(case):
    scheme = "https://" if case["certificates"] else "http://"
    if case["refused"] is None:
        assert "/" not in _target(case["address"], scheme)
    else:
        with pytest.raises(clearway.ClearwayError, match=case["refused"]) as error:
            _target(case["address"], scheme)
        assert error.value.reason == "address"


def update(sequence):
    header = map_pb2.Header(vehicle="alpha", boot_id=7, sequence=sequence, valid_until_ns=1 << 62)
    return service_pb2.MapUpdate(map=map_pb2.Map(header=header).SerializeToString())


class Server:
    """Tells a state, sends one map and ends; refuses the third stream."""

    def __init__(self):
        self.streams = 0

    def Watch(self, requests, context):
        assert next(requests).selection.states
        self.streams += 1
        if self.streams == 3:
            context.abort(grpc.StatusCode.PERMISSION_DENIED, "the role is lost")
        yield service_pb2.MapUpdate(vehicle=service_pb2.Vehicle(name="alpha", reasons=["no packets from top"]))
        yield update(4 * self.streams)


@contextmanager
def serving(watch, address):
    """A server whose streams are made by `watch`; its port."""
    server = grpc.server(futures.ThreadPoolExecutor(2))
    received, sent = service_pb2.WatchRequest.FromString, service_pb2.MapUpdate.SerializeToString
    methods = {"Watch": grpc.stream_stream_rpc_method_handler(watch, received, sent)}
    server.add_generic_rpc_handlers([grpc.method_handlers_generic_handler("clearway.v1.MapService", methods)])
    port = server.add_insecure_port(address)
    server.start()
    yield port
    server.stop(None)


def test_a_stream_waits_for_its_server_and_is_opened_again_until_it_is_refused(caplog):
    with socket.create_server(("127.0.0.1", 0)) as chosen:
        address = f"127.0.0.1:{chosen.getsockname()[1]}"
    with pytest.raises(clearway.ClearwayError, match=address):
        next(clearway.watch(address))
    with caplog.at_level(logging.WARNING, "clearway"), clearway.watch(address, reconnect=True) as maps:
        while not maps.reasons:
            pass
        assert address in maps.reasons[0]
        with serving(Server().Watch, address):
            first, second = next(maps), next(maps)
            assert (first.sequence, first.skipped, second.sequence, second.skipped) == (4, 0, 8, 3)
            with pytest.raises(clearway.ClearwayError, match="the role is lost"):
                next(maps)
    assert "the server has ended the stream; the stream of maps is opened again" in caplog.text


def test_a_stream_that_is_to_reconnect_ends_at_a_vehicle_that_the_server_does_not_know():
    def refuse(_, context):
        context.abort(grpc.StatusCode.NOT_FOUND, "no vehicle 'beta'")

    with serving(refuse, "127.0.0.1:0") as port, clearway.watch(f"127.0.0.1:{port}", "beta", reconnect=True) as maps:
        with pytest.raises(clearway.ClearwayError, match="no vehicle 'beta'"):
            next(maps)


def test_the_reasons_of_the_server_stay_until_a_map_comes():
    slot = clearway.stream.LatestSlot()
    slot.set_reasons(["no packets from top"])
    maps = clearway.MapStream(slot, lambda: None)
    assert maps.reasons == ["no packets from top"]
    slot.store(clearway.Map(update(1).map), None)
    assert maps.reasons == []

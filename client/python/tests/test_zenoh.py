"""A stream over zenoh against a session in this process that publishes as the server does (see the Rust client's
zenoh.rs)."""

import socket
import subprocess
import sys
import threading
import time

import pytest

import clearway
from clearway.v1 import map_pb2

zenoh = pytest.importorskip("zenoh")
from zenoh import ext  # noqa: E402

KEY = "clearway/alpha/map/{}"
LASTS_NS = 60_000_000_000


@pytest.fixture
def endpoint():
    # zenoh for Python does not return the port that the system chose.
    with socket.create_server(("127.0.0.1", 0)) as chosen:
        return f"tcp/127.0.0.1:{chosen.getsockname()[1]}"


@pytest.fixture
def server(endpoint):
    config = zenoh.Config()
    for key, value in [("listen/endpoints", f'["{endpoint}"]'), ("scouting/multicast/enabled", "false"),
                       ("scouting/gossip/enabled", "false"), ("transport/link/tx/lease", "2000")]:  # fmt: skip
        config.insert_json5(key, value)
    with zenoh.open(config) as session:
        yield session


def part(sequence, layer="drivability", valid_ns=LASTS_NS, vehicle="alpha", boot_id=7, ahead_ns=0):
    end_ns = clearway.now_ns() + ahead_ns
    header = map_pb2.Header(vehicle=vehicle, boot_id=boot_id, sequence=sequence, capture_start_ns=end_ns,
                            capture_end_ns=end_ns, valid_until_ns=end_ns + valid_ns)  # fmt: skip
    grid = map_pb2.RadialGrid(row_radius_m=[10.0], columns=4)
    return map_pb2.Map(header=header, layers=[map_pb2.Layer(name=layer, radial=grid)]).SerializeToString()


def published(session, layer="drivability"):
    """Declares a publisher as the server does."""
    misses = ext.MissDetectionConfig(heartbeat=0.5, sporadic_heartbeat=None)
    return ext.declare_advanced_publisher(
        session, KEY.format(layer), cache=ext.CacheConfig(1), publisher_detection=True, sample_miss_detection=misses
    )


def watch(at, *layers):
    return clearway.watch(f"zenoh:{at}", vehicle="alpha", layers=layers or ["drivability"])


def counts(m):
    return m.sequence, m.skipped, m.lost


def matched(publisher):
    """Waits until there is a subscriber."""
    changes = publisher.declare_matching_listener()
    while not publisher.matching_status.matching:
        changes.recv()


def test_a_new_subscriber_gets_the_current_map_of_every_layer(server, endpoint):
    layers = ["drivability", "terrain"]
    publishers = [published(server, layer) for layer in layers]
    for sequence in (40, 41):
        for publisher, layer in zip(publishers, layers):
            publisher.put(part(sequence, layer))
    with watch(endpoint, *layers) as maps:
        m = next(maps)
    assert counts(m) == (41, 0, 0) and [layer.name for layer in m._message.layers] == layers


def says(maps, why):
    """Waits until the stream says this, and nothing else, as why no map comes."""
    while maps.reasons != [why]:
        time.sleep(0.002)


def test_a_name_that_no_server_publishes_is_named_with_those_that_are_published(server, endpoint):
    with server.liveliness().declare_token("clearway/alpha"), published(server):
        with watch(endpoint, "fspace", "drivability") as maps:
            why = "no server publishes of alpha the layers fspace now; published: drivability"
            says(maps, why)
        with clearway.watch(f"zenoh:{endpoint}", vehicle="alfa", layers="drivability") as maps:
            says(maps, "no server publishes the vehicle 'alfa' now; published: alpha")


@pytest.mark.parametrize("call", [clearway.watch, clearway.get])
@pytest.mark.parametrize("names", [("*", "speed"), ("car$*", "speed"), ("a/b", "speed"), ("Car", "speed"), ("car", "**")])
def test_a_name_that_is_no_name_is_refused_before_anything_is_opened(call, names):
    wrong = next(name for name in names if not name.isalpha() or not name.islower())
    with pytest.raises(clearway.ClearwayError, match="1 to 64 of the characters a-z, 0-9, - and _") as refused:
        call("zenoh:tcp/127.0.0.1:1", vehicle=names[0], layers=[names[1]])
    assert repr(wrong) in str(refused.value)


def test_a_stream_that_is_to_reconnect_waits_for_a_router_at_the_start(endpoint):
    with pytest.raises(clearway.ClearwayError, match="PROTOCOL/HOST:PORT is allowed"):
        clearway.watch("zenoh:localhost:7447", vehicle="alpha", layers="drivability")
    with pytest.raises(clearway.ClearwayError, match=f"{endpoint}: no zenoh router or server accepts a connection$"):
        watch(endpoint)
    with clearway.watch(f"zenoh:{endpoint}", vehicle="alpha", layers="drivability", reconnect=True) as maps:
        says(maps, f"{endpoint}: no zenoh router or server accepts a connection")
        assert maps.next_or_stale(timeout=0.01) is None
        config = zenoh.Config()
        config.insert_json5("listen/endpoints", f'["{endpoint}"]')
        with zenoh.open(config) as session, published(session) as publisher:
            publisher.put(part(41))
            assert next(maps).sequence == 41
    with clearway.watch(f"zenoh:{endpoint}", vehicle="alpha", layers="drivability", reconnect=True) as maps:
        pass
    with pytest.raises(clearway.ClearwayError, match="closed"):
        maps.next_or_stale()


def test_lost_maps_are_counted_and_a_lost_last_map_is_queried(server, endpoint):
    key = KEY.format("drivability")
    asked = server.declare_queryable(key)
    maps = server.declare_publisher(key)
    heartbeats = server.declare_publisher(f"{key}/@adv/pub/{maps.id.zid}/{maps.id.eid}/_")

    def put(number, sequence):
        """Publishes a sample with a number; missing numbers are lost samples."""
        maps.put(part(sequence), source_info=zenoh.SourceInfo(maps.id, number))

    with watch(endpoint) as stream:
        matched(maps)
        matched(heartbeats)
        put(0, 41)
        assert counts(next(stream)) == (41, 0, 0)
        put(2, 43)
        assert counts(next(stream)) == (43, 1, 1), "the lost map is one of the skipped ones"
        put(3, 46)
        assert counts(next(stream)) == (46, 2, 0), "two maps were never published"
        heartbeats.put(ext.z_serialize(ext.UInt32(3)))
        heartbeats.put(ext.z_serialize(ext.UInt32(4)))
        with asked.recv() as query:
            query.reply(key, part(47))
        assert counts(next(stream)) == (47, 0, 0), "the last map arrived late and is not lost"
        put(5, 48)
        assert counts(next(stream)) == (48, 0, 0)
        assert asked.try_recv() is None, "there is no query without a reason"


@pytest.fixture
def lone_routers():
    """Two routers that are not joined, each with its endpoint."""
    with socket.create_server(("127.0.0.1", 0)) as a, socket.create_server(("127.0.0.1", 0)) as b:
        endpoints = [f"tcp/127.0.0.1:{chosen.getsockname()[1]}" for chosen in (a, b)]
    sessions = []
    for endpoint in endpoints:
        config = zenoh.Config()
        for key, value in [("mode", '"router"'), ("listen/endpoints", f'["{endpoint}"]'),
                           ("scouting/multicast/enabled", "false")]:  # fmt: skip
            config.insert_json5(key, value)
        sessions.append(zenoh.open(config))
    yield list(zip(sessions, endpoints))
    for session in sessions:
        session.close()


def test_a_reader_at_two_routers_at_once_reads_through_either(lone_routers):
    (first, near), (second, far) = lone_routers
    layers = ["drivability", "terrain"]
    publishers = [published(second, layer) for layer in layers]
    for publisher, layer in zip(publishers, layers):
        publisher.put(part(1, layer))
    for endpoints in (f"{near}+{far}", f"{far}+{near}"):
        with watch(endpoints, *layers) as maps:
            assert counts(next(maps)) == (1, 0, 0), endpoints
    # A reader that knows one router waits there.
    with watch(near) as maps:
        of_first = published(first)
        of_first.put(part(2))
        assert counts(next(maps)) == (2, 0, 0)


def test_a_dead_router_before_a_live_one_costs_a_reader_no_maps(lone_routers):
    (first, near), (second, far) = lone_routers
    first.close()
    publisher = published(second)
    publisher.put(part(1))
    for endpoints in (f"{near},{far}", f"{near}+{far}"):
        with watch(endpoints) as maps:
            assert counts(next(maps)) == (1, 0, 0), endpoints


@pytest.mark.parametrize("ending", ["", "maps.close()", "raise SystemExit(3)"], ids=["end", "close", "exit"])
def test_a_program_may_end_without_closing_its_stream(server, endpoint, ending):
    publisher = published(server)
    publisher.put(part(3))
    program = (
        f"import clearway; maps = clearway.watch('zenoh:{endpoint}', vehicle='alpha', layers=['drivability']); "
        "next(maps); "
    )
    run = subprocess.run([sys.executable, "-c", program + ending], capture_output=True, text=True, timeout=60)
    assert (run.returncode, run.stderr) == (3 if "raise" in ending else 0, "")


def test_a_process_that_was_forked_is_told_so_and_ends(server, endpoint):
    publisher = published(server)
    publisher.put(part(3))
    program = f"""
import os, sys, clearway
at = 'zenoh:{endpoint}'
maps = clearway.watch(at, vehicle='alpha', layers=['drivability'])
next(maps)
child = os.fork()
if child == 0:
    for use in [maps.__next__, maps.next_or_stale, lambda: clearway.vehicles(at)]:
        try:
            use()
        except clearway.ClearwayError as error:
            print(error.reason, error)
    maps.close()
    sys.exit(5)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), maps.newest().sequence)
"""
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    *told, last = run.stdout.splitlines()
    assert last == "5 3" and len(told) == 3 and run.stderr == "", run
    assert all(line.startswith("fork ") and "get_context('spawn')" in line for line in told), told


class Wire:
    """A connection between client and server. While it is cut, no data pass and neither side is notified."""

    def __init__(self, to):
        self._to = self._address(to)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        self._whole = threading.Event()
        self._whole.set()
        self._held = []
        threading.Thread(target=self._accept, daemon=True).start()

    @staticmethod
    def _address(endpoint):
        host, port = endpoint.removeprefix("tcp/").rsplit(":", 1)
        return host, int(port)

    def _accept(self):
        while True:
            near, _ = self._listener.accept()
            self._held.append(near)
            if self._whole.is_set():
                far = socket.create_connection(self._to)
                self._held.append(far)
                laid = self._whole
                for ends in ((near, far), (far, near)):
                    threading.Thread(target=self._carry, args=(*ends, laid), daemon=True).start()

    @staticmethod
    def _carry(of, to, laid):
        # Data that arrive after the cut are not read.
        while laid.is_set() and (said := of.recv(65_536)) and laid.is_set():
            to.sendall(said)

    def cut(self):
        self._whole.clear()

    def restore(self):
        self._whole = threading.Event()
        self._whole.set()


def test_a_stream_continues_after_a_cut_link_and_counts_lost_maps(server, endpoint):
    publisher = published(server)
    wire = Wire(endpoint)
    publisher.put(part(0, valid_ns=1))
    with watch(wire.endpoint) as maps:
        m = maps.next_or_stale()
        assert m.stale and m.sequence == 0
        wire.cut()
        for sequence in range(1, 5):
            publisher.put(part(sequence))
        wire.restore()
        m = maps.next_or_stale()
        assert not m.stale and counts(m) == (4, 3, 3), "the newest map, and the number of lost ones"
        publisher.put(part(5))
        assert counts(maps.next_or_stale()) == (5, 0, 0)


def test_certificates_for_an_unencrypted_endpoint_are_refused(tmp_path):
    for name in ("ca.pem", "reader.pem"):
        (tmp_path / name).write_text("")
    tls = clearway.Tls(tmp_path / "ca.pem")
    with pytest.raises(clearway.ClearwayError, match="zenoh:tls/HOST:PORT"):
        clearway.vehicles("zenoh:tcp/127.0.0.1:7447", tls=tls)
    for address in ("127.0.0.1:9", "zenoh:tls/127.0.0.1:7447"):
        with pytest.raises(clearway.ClearwayError, match="absent.pem"):
            clearway.vehicles(address, tls=clearway.Tls(tmp_path / "absent.pem"))
    with pytest.raises(clearway.ClearwayError, match="both or none are needed"):
        clearway.Tls(tmp_path / "ca.pem", cert=tmp_path / "reader.pem")

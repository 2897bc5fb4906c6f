"""A peer of the zenoh network that is no server: what it puts on a map's key is counted and passed over."""

import subprocess
import time

import pytest
from test_zenoh import KEY, counts, endpoint, matched, part, server, watch, zenoh  # noqa: F401

import clearway

MAPS = KEY.format("drivability")


def wait(condition):
    end_s = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end_s, "waited in vain"


def passed_over(maps, **expected):
    """Waits until the stream has counted these messages."""
    wait(lambda: all(getattr(maps.passed_over, reason) >= count for reason, count in expected.items()))
    assert maps.passed_over._replace(not_newer=0)._asdict() == clearway.PassedOver(**expected)._asdict()


@pytest.fixture
def attacked(server, endpoint):  # noqa: F811
    """(publisher, peer, stream): the stream has received map 1 of the publisher; the peer may put anything."""
    publisher = server.declare_publisher(MAPS)
    config = zenoh.Config()
    for key, value in [("mode", '"client"'), ("connect/endpoints", f'["{endpoint}"]'),
                       ("scouting/multicast/enabled", "false")]:  # fmt: skip
        config.insert_json5(key, value)
    with zenoh.open(config) as peer, watch(endpoint) as maps:
        matched(publisher)
        publisher.put(part(1))
        assert counts(next(maps)) == (1, 0, 0)
        yield publisher, peer, maps


def test_what_is_no_map_of_the_key_is_counted_and_passed_over(attacked):
    publisher, peer, maps = attacked
    peer.put(MAPS, b"x")
    peer.put(MAPS, part(2, vehicle="beta"))
    peer.put(MAPS, part(2, layer="terrain"))
    peer.put("clearway/**", part(2))
    passed_over(maps, undecodable=1, misplaced=3)
    publisher.put(part(2))
    assert counts(next(maps)) == (2, 0, 0)


@pytest.mark.parametrize("ahead_ns", [0, 3_600_000_000_000])
def test_a_forged_sequence_holds_no_true_map_back(attacked, ahead_ns):
    publisher, peer, maps = attacked
    peer.put(MAPS, part(1 << 63, ahead_ns=ahead_ns))
    while next(maps).sequence != 1 << 63:
        pass
    publisher.put(part(2))
    assert counts(next(maps)) == (2, 0, 0)
    publisher.put(part(4))
    assert counts(next(maps)) == (4, 1, 0)


def test_a_forged_run_is_not_shown_beside_the_true_one(attacked):
    publisher, peer, maps = attacked
    for sequence in range(2, 20):
        publisher.put(part(sequence))
        assert counts(next(maps)) == (sequence, 0, 0)
        peer.put(MAPS, part(sequence + 1, boot_id=666))
        passed_over(maps, other_run=sequence - 1)


def test_no_map_is_fresh_for_good_whatever_it_states(attacked):
    _, peer, maps = attacked
    peer.put(MAPS, part(2, valid_ns=1 << 62))
    m = next(maps)
    assert not m.stale and m.is_stale(clearway.now_ns() + 60_000_000_000)


def test_a_false_answer_to_a_query_hides_no_true_one(attacked, server, endpoint):  # noqa: F811
    peer, kept = attacked[1], []
    for session, answer in ((peer, b"x"), (server, part(5))):
        def reply(query, answer=answer):
            query.reply(MAPS, answer)

        kept.append(session.declare_queryable(MAPS, reply, complete=True))
    assert clearway.get(f"zenoh:{endpoint}", "alpha", ["drivability"]).sequence == 5


def test_with_a_public_key_only_signed_maps_are_believed(attacked, endpoint, tmp_path):  # noqa: F811
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    key, pub = tmp_path / "maps.key", tmp_path / "maps.pub"
    subprocess.run(["openssl", "genpkey", "-algorithm", "ed25519", "-out", key], check=True)
    subprocess.run(["openssl", "pkey", "-in", key, "-pubout", "-out", pub], check=True)
    own, other = load_pem_private_key(key.read_bytes(), None), Ed25519PrivateKey.generate()
    publisher, peer, _ = attacked

    def sign(private, on, encoded):
        return private.sign(b"clearway.v1.Map\0" + on.encode() + b"\0" + encoded)

    with clearway.watch(f"zenoh:{endpoint}", "alpha", ["drivability"], signed_by=pub) as maps:
        # The second subscription may reach the publisher later than the first.
        wait(lambda: publisher.put(part(2)) or maps.passed_over.unsigned)
        first = part(2)
        publisher.put(first, attachment=sign(own, MAPS, first))
        assert counts(next(maps)) == (2, 0, 0)
        unsigned = maps.passed_over.unsigned
        for attachment in (None, sign(other, MAPS, first), sign(own, KEY.format("terrain"), first)):
            peer.put(MAPS, first, attachment=attachment)
        passed_over(maps, unsigned=unsigned + 3)
    with pytest.raises(clearway.ClearwayError, match="public key"):
        clearway.watch(f"zenoh:{endpoint}", "alpha", ["drivability"], signed_by=key)
    with pytest.raises(clearway.ClearwayError, match="over gRPC use tls"):
        clearway.watch("localhost:1", signed_by=pub)

"""Certificates, against a running server that asks for them: CLEARWAY_SECURED_GRPC, behind a router that does too:
CLEARWAY_SECURED_ZENOH, and their CA's folder CLEARWAY_CERTIFICATES, beside the folder of another CA."""

import os
import time
from pathlib import Path

import pytest

import clearway

NAMES = ("SECURED_GRPC", "SECURED_ZENOH", "CERTIFICATES")
GRPC, ZENOH, FOLDER = (os.environ.get(f"CLEARWAY_{name}", "") for name in NAMES)
pytestmark = pytest.mark.skipif(not GRPC, reason="CLEARWAY_SECURED_GRPC names no server")
TRANSPORTS = [{"address": GRPC}, {"address": f"zenoh:{ZENOH}", "vehicle": "car"}]
OURS, THEIRS = Path(FOLDER), Path(FOLDER).with_name("theirs")


def tls(ca=OURS, of=OURS, name="reader"):
    return clearway.Tls(ca / "ca.pem", of / f"{name}.pem", of / f"{name}.key")


@pytest.mark.parametrize("transport", TRANSPORTS, ids=["grpc", "zenoh"])
def test_a_certificate_of_the_servers_ca_gives_access(transport):
    # Over zenoh a server is not listed while a loaded machine delays its link to the router.
    give_up = time.monotonic() + 60.0
    while not (vehicles := clearway.vehicles(transport["address"], tls=tls())) and time.monotonic() < give_up:
        pass
    assert vehicles == ["car"]
    one = clearway.get(**transport, layers=["drivability"], tls=tls())
    with clearway.watch(**transport, layers=["drivability"], tls=tls()) as maps:
        assert (next(maps)["drivability"].classes == one["drivability"].classes).all()


@pytest.mark.parametrize("transport", TRANSPORTS, ids=["grpc", "zenoh"])
@pytest.mark.parametrize("shown", [None, clearway.Tls(OURS / "ca.pem"), tls(of=THEIRS), tls(ca=THEIRS)],
                         ids=["nothing", "no certificate", "another CA's", "believing another CA"])  # fmt: skip
def test_a_client_without_certificate_or_with_another_ca_is_refused(transport, shown):
    with pytest.raises(clearway.ClearwayError) as refused:
        next(clearway.watch(**transport, layers=["drivability"], tls=shown))
    assert refused.value.reason in ("UNAVAILABLE", "zenoh")
    assert transport["address"].removeprefix("zenoh:") in str(refused.value)


def test_a_certificate_without_the_role_is_refused_with_the_roles():
    with pytest.raises(clearway.ClearwayError, match=r"ingester.*allowed roles are \[reader, operator\]") as refused:
        next(clearway.watch(GRPC, layers=["drivability"], tls=tls(name="ingester")))
    assert refused.value.reason == "PERMISSION_DENIED"

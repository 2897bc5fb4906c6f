"""Status, recorder and ingest, against a running server with roles and a recorder: CLEARWAY_SECURED_GRPC."""

import os
from pathlib import Path

import numpy as np
import pytest

import clearway
from clearway.v1 import ingest_pb2, journal_pb2

GRPC, FOLDER = (os.environ.get(f"CLEARWAY_{name}", "") for name in ("SECURED_GRPC", "CERTIFICATES"))
pytestmark = pytest.mark.skipif(not GRPC, reason="CLEARWAY_SECURED_GRPC names no server")


def tls(name):
    return clearway.Tls(Path(FOLDER, "ca.pem"), Path(FOLDER, f"{name}.pem"), Path(FOLDER, f"{name}.key"))


def test_the_status_has_the_state_of_one_vehicle_and_names_the_known_ones():
    assert clearway.status(GRPC, tls=tls("reader")).name == "car"
    status = clearway.status(GRPC, "car", tls("reader"))
    assert status.state in ("ok", "warn", "error") and "freespace" in status.layers
    with pytest.raises(clearway.ClearwayError, match="0 vehicles fit 'bus'; the server has car"):
        clearway.status(GRPC, "bus", tls("reader"))


def test_the_recorder_is_stopped_and_started_and_lists_its_parts_to_an_operator_alone():
    recorder = clearway.Recorder(GRPC, tls("operator"))

    def wait_for(state):
        while recorder.status().state != state:
            pass

    wait_for("recording")
    recorder.stop()
    wait_for("stopped")
    with pytest.raises(clearway.ClearwayError, match="stopped already"):
        recorder.stop()
    recorder.start()
    wait_for("recording")
    assert recorder.list()[0].bytes > 0
    assert recorder.save(5, "from-python")
    # The recorder of the test bed writes one file, as a replay does.
    with pytest.raises(clearway.ClearwayError, match="recorded to one file"):
        recorder.split()
    with pytest.raises(clearway.ClearwayError, match="allowed roles"):
        clearway.Recorder(GRPC, tls("reader")).status()


def test_scans_and_poses_are_sent_and_each_refusal_is_named():
    now_ns = clearway.now_ns()
    with clearway.Ingester(GRPC, "car", tls("ingester")) as car:
        car.send(ingest_pb2.Observation(declaration=journal_pb2.Sensor(name="bumper", z_m=0.5)))
        points = np.random.default_rng(1).uniform(-9.0, 9.0, (100, 3))
        car.send_scan(now_ns, points, sensor="bumper", intensity=np.ones(100), ring=np.zeros(100))
        car.send_pose(now_ns, (1.0, 2.0, 0.0), speed_mps=3.0)
        assert car.settled() == []
        short = car.send_scan(now_ns + 1, points, sensor="bumper", intensity=np.ones(99))
        (refusal,) = car.settled()
        assert (refusal.number, refusal.count) == (short, 1) and "99" in refusal.message, refusal
        for i in range(40):
            car.send_pose(now_ns + 2 + i, (1.0, 2.0, 0.0))
        assert car.settled() == []
    with pytest.raises(clearway.ClearwayError, match="shape"):
        car.send_scan(now_ns, [1.0, 2.0, 3.0])
    with clearway.Ingester(GRPC, "bus", tls("ingester")) as bus, pytest.raises(clearway.ClearwayError, match="car"):
        bus.send_pose(now_ns, (0.0, 0.0, 0.0))
        bus.settled()

"""Every program of the README runs against a running server, and says something."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

README = (Path(__file__).resolve().parents[1] / "README.md").read_text()
PROGRAMS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
NAMES = ("GRPC", "ZENOH", "SECURED_GRPC", "CERTIFICATES", "RECORDING")
HERE = {name: os.environ.get(f"CLEARWAY_{name}", "") for name in NAMES}
pytestmark = pytest.mark.skipif(not HERE["GRPC"], reason="CLEARWAY_GRPC names no server")


def placed(program):
    """With the addresses and files of this run."""
    grpc = HERE["SECURED_GRPC" if "Tls(" in program else "GRPC"]
    here = {"localhost:50051": grpc, "tcp/localhost:7447": HERE["ZENOH"], "certificates/": f"{HERE['CERTIFICATES']}/",
            "drive.mcap": HERE["RECORDING"]}  # fmt: skip
    for named, there in here.items():
        program = program.replace(named, there)
    return program


@pytest.mark.parametrize("number", range(len(PROGRAMS)))
def test_each_program_of_the_readme_prints_what_it_should(number, tmp_path):
    file = tmp_path / "program.py"
    file.write_text(placed(PROGRAMS[number]))
    run = subprocess.Popen([sys.executable, "-u", file], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        lines = [run.stdout.readline() for _ in range(PROGRAMS[number].count("print("))]
        assert all(lines), run.stderr.read()
    finally:
        run.kill()
        run.wait()


def test_the_readme_has_a_program_for_each_source_of_maps():
    assert len(PROGRAMS) == 8

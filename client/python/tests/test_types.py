"""The types of the installed package."""

import subprocess
import sys
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[1] / "pyproject.toml"


def test_mypy_finds_nothing_in_strict_mode(tmp_path):
    pytest.importorskip("mypy")
    mypy = [sys.executable, "-m", "mypy", "--cache-dir", tmp_path, "--config-file", PROJECT]
    # A checkout would stand before the installed package.
    said = subprocess.run(mypy, cwd=tmp_path, capture_output=True, text=True)
    assert said.returncode == 0, said.stdout + said.stderr

"""The fixture of pytest that replays recordings; `clearway.testing` describes it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from .testing import Replay


@pytest.fixture
def clearway_replay() -> Iterator[Callable[..., Replay]]:
    """Starts replays as `clearway.testing.Replay` does, and ends them with the test."""
    with ExitStack() as replays:
        yield lambda *arguments: replays.enter_context(Replay(*arguments))

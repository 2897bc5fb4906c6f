"""The fixture of pytest that replays recordings; `clearway.testing` describes it. `clearway` itself is imported when a
test uses the fixture."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from clearway.testing import Replay


@pytest.fixture
def clearway_replay() -> Iterator[Callable[..., Replay]]:
    """Starts replays as `clearway.testing.Replay` does, and ends them with the test."""
    from clearway.testing import Replay

    with ExitStack() as replays:
        yield lambda *arguments: replays.enter_context(Replay(*arguments))

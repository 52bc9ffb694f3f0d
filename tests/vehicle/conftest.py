"""What the tests of the vehicle share: a hub in real time, in a thread of the test."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from busharness import RunningHub, running_hub


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[RunningHub]:
    with running_hub(tmp_path / "bus.log") as running:
        yield running

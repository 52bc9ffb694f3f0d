"""Experiments over several processes: in order, and one that hangs is named, killed and not waited for."""

import os
import signal
import time
from pathlib import Path

import pytest

from aftbed.campaign.explore import each
from aftbed.core.errors import HarnessError

LIMIT_S = 20.0  # what a machine under load may take for a failure that is due after one second


def doubled(number: int) -> int:
    return 2 * number


def hangs_at_five(number: int) -> int:
    while number == 5:
        signal.pause()
    return number


def late(number: int) -> int:
    raise TimeoutError(f"of its own: {number}")


def workers() -> set[str]:
    """The children of this process."""
    return set(Path(f"/proc/self/task/{os.getpid()}/children").read_text().split())


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_come_in_order(jobs: int) -> None:
    assert list(each(doubled, range(50), jobs)) == [(n, n, 2 * n) for n in range(50)]


def test_one_that_hangs_is_named_with_its_command_and_nobody_is_left() -> None:
    before, began_s = workers(), time.monotonic()
    found = each(hangs_at_five, range(9), 2, 4, alone=lambda number, _: f"run {number}", seconds_max=1.0)
    with pytest.raises(HarnessError) as raised:
        list(found)
    assert str(raised.value) == "experiment 5 hangs, after 1 s there is no result: 5; alone: run 5"
    assert time.monotonic() - began_s < LIMIT_S
    assert workers() <= before


def test_an_error_of_an_experiment_is_no_hang() -> None:
    with pytest.raises(TimeoutError, match="of its own: 0"):
        list(each(late, range(3), 2))

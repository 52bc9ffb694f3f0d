"""How long the end of a run is waited for: a machine that does not let its processes run does not end it."""

import itertools

import pytest

from aftbed.runtime.unix.supervisor import (
    DRAIN_EXCUSED_SECONDS_MAX,
    DRAIN_SECONDS_MAX,
    LOOK_NS_MAX,
    Patience,
    drains_too_long,
)

MS = 1_000_000


@pytest.mark.parametrize(
    ("seconds", "excused_s", "too_long"),
    [
        (DRAIN_SECONDS_MAX, 0.0, False),
        (DRAIN_SECONDS_MAX + 0.01, 0.0, True),
        (DRAIN_SECONDS_MAX + 0.5, 0.6, False),
        (DRAIN_SECONDS_MAX + 0.7, 0.6, True),
        (DRAIN_SECONDS_MAX + DRAIN_EXCUSED_SECONDS_MAX + 0.01, 1000.0, True),
    ],
)
def test_time_in_which_a_process_was_not_let_run_is_not_counted(
    seconds: float, excused_s: float, *, too_long: bool
) -> None:
    assert drains_too_long(seconds, excused_s) is too_long


def test_a_wait_ends_after_its_time() -> None:
    patience = Patience(1.0, 0)
    assert next(at_ms for at_ms in itertools.count(1) if patience.ends(at_ms * MS)) == 1001


def test_a_supervisor_that_was_not_let_run_has_not_waited() -> None:
    """The machine stood still for longer than any excuse lasts."""
    patience = Patience(1.0, 0)
    assert not patience.ends(3000 * MS)
    after_ms = next(at_ms for at_ms in itertools.count(1) if patience.ends((3000 + at_ms) * MS))
    assert after_ms == 1001 - LOOK_NS_MAX // MS

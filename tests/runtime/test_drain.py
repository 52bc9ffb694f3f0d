"""How long the end of a run is waited for: a machine that does not let its processes run does not end it."""

import pytest

from aftbed.runtime.unix.supervisor import (
    DRAIN_SECONDS_MAX,
    DRAIN_STARVED_SECONDS_MAX,
    drains_too_long,
)


@pytest.mark.parametrize(
    ("seconds", "starved_s", "too_long"),
    [
        (DRAIN_SECONDS_MAX, 0.0, False),
        (DRAIN_SECONDS_MAX + 0.01, 0.0, True),
        (DRAIN_SECONDS_MAX + 0.5, 0.6, False),
        (DRAIN_SECONDS_MAX + 0.7, 0.6, True),
        (DRAIN_SECONDS_MAX + DRAIN_STARVED_SECONDS_MAX + 0.01, 1000.0, True),
    ],
)
def test_time_in_which_a_process_was_not_let_run_is_not_counted(
    seconds: float, starved_s: float, *, too_long: bool
) -> None:
    assert drains_too_long(seconds, starved_s) is too_long

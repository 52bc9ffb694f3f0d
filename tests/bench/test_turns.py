"""A run and its limit that take turns on one clock: which may begin when, and what is left out."""

import time

import psutil
import pytest
from homes import Home
from hypothesis import given
from hypothesis import strategies as st

from aftbed.bench.cycle import (
    OURS,
    SETTLE_NS,
    THEIRS,
    TURN_NS,
    CycleRun,
    RingShape,
    ring_in_their_turns,
    settled,
)
from aftbed.bench.runs import TimedSample, limited_run
from aftbed.core.errors import HarnessError
from aftbed.core.journal import EntryKind
from aftbed.runtime.unix.options import Turns

RING = RingShape(4, ((2, "b"),))


@given(st.integers(1, 10**9), st.integers(0, 10**18))
def test_at_each_moment_one_of_two_may_begin_and_the_other_knows_when(ns: int, now_ns: int) -> None:
    first, second = Turns(ns, 0).left_ns(now_ns), Turns(ns, 1).left_ns(now_ns)
    assert min(first, second) == 0 < max(first, second) <= ns
    later_ns = now_ns + max(first, second)
    assert (Turns(ns, 0).left_ns(later_ns) == 0) == (first > 0)


def test_the_begin_of_a_turn_and_what_outlasts_it_are_left_out() -> None:
    settled_ns, end_ns = TURN_NS + SETTLE_NS, 2 * TURN_NS  # of an odd turn
    begins_ns = (TURN_NS, settled_ns - 1, settled_ns, end_ns - 40_001, end_ns - 40_000, end_ns)
    measured = [TimedSample(begin_ns, 40.0) for begin_ns in begins_ns]
    assert settled(measured, THEIRS, 2) == measured[2:4]
    assert settled(measured, OURS, 0) == []


def test_where_too_few_end_within_a_turn_all_count() -> None:
    """A machine may be so busy; what it measures is told as it is."""
    measured = [TimedSample(TURN_NS + SETTLE_NS, 40.0), TimedSample(TURN_NS + 2 * SETTLE_NS, TURN_NS / 1e3)]
    assert settled(measured, THEIRS, 1) == measured[:1]
    assert settled(measured, THEIRS, 2) == measured


@pytest.mark.process
def test_a_load_sends_in_its_turns_only(home: Home) -> None:
    for turns in (OURS, THEIRS):
        record = limited_run("none", "single", 1000, pin=True, turns=turns)
        sent = [entry for entry in record.history.dialogue if entry.kind is EntryKind.SENT]
        assert len(sent) == 1000 and all(turns.left_ns(entry.t_ns) == 0 for entry in sent)


@pytest.mark.process
def test_a_cycle_and_its_ring_are_measured_side_by_side(home: Home) -> None:
    with ring_in_their_turns(RING, 64, pin=True) as ring:
        began_ns = time.monotonic_ns()
        cycles, beside = CycleRun("pbr", "replica").cycles_beside(60, ring_in_their_turns(RING, 64, pin=True))
        ended_ns = time.monotonic_ns()
    assert len(cycles) == 60 and min(cycles) > 0
    assert beside and min(beside) > 0
    within = [one.began_ns for one in ring if began_ns <= one.began_ns <= ended_ns]
    assert within and not any(map(THEIRS.left_ns, within))


@pytest.mark.process
def test_a_ring_that_dies_ends_the_measurement(home: Home) -> None:
    before = set(psutil.Process().children())
    with (
        pytest.raises(HarnessError, match="the bare ring: one of its processes died"),
        ring_in_their_turns(RING, 64, pin=True),
    ):
        (ring,) = set(psutil.Process().children()) - before
        ring.kill()

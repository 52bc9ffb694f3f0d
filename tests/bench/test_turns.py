"""A run and its limit that take turns on one clock: which may begin when, and what is left out."""

import contextlib
import itertools
import os
import time
from collections.abc import Iterator
from functools import partial

import psutil
import pytest
from homes import Home, until
from hypothesis import given
from hypothesis import strategies as st

from aftbed.bench.cycle import (
    OURS,
    SETTLE_SHARE,
    THEIRS,
    TURN_NS,
    CycleRun,
    RingShape,
    Side,
    ring_in_turns,
    settled,
    side_by_side,
)
from aftbed.bench.rounds import together
from aftbed.bench.runs import TimedSample, endless_run, limited_run, wait_for
from aftbed.core.errors import HarnessError
from aftbed.core.journal import EntryKind
from aftbed.runtime.unix.options import Turns

RING = RingShape(4, ((2, "b"),))
SETTLE_NS = TURN_NS // SETTLE_SHARE


@given(st.integers(1, 10**9), st.integers(0, 10**18), st.integers(2, 5), st.data())
def test_at_each_moment_one_may_begin_and_the_others_know_when(
    ns: int, now_ns: int, of: int, data: st.DataObject
) -> None:
    first = data.draw(st.integers(1, of - 1), "the share of the first")
    sides = [Turns(ns, 0, of, first), *(Turns(ns, number, of) for number in range(first, of))]
    left_ns = sorted(side.left_ns(now_ns) for side in sides)
    assert left_ns[0] == 0 < left_ns[1] <= first * ns  # one of them, and the next
    for side in sides:
        begins_ns = now_ns + side.left_ns(now_ns)
        assert side.left_ns(begins_ns) == 0
        if begins_ns > now_ns:
            assert side.left_ns(begins_ns - 1) == 1


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
    for turns in (OURS, THEIRS, Turns(TURN_NS, 0, 3, 2)):
        record = limited_run("none", "single", 1000, pin=True, turns=turns)
        sent = [entry for entry in record.history.dialogue if entry.kind is EntryKind.SENT]
        assert len(sent) == 1000 and all(turns.left_ns(entry.t_ns) == 0 for entry in sent)


@pytest.mark.process
def test_a_load_at_a_rate_leaves_out_what_is_due_in_the_turns_of_others(home: Home) -> None:
    turns = Turns(4 * TURN_NS, 0, 3, 2)
    with endless_run("none", "single", 500.0, turns=turns) as run:
        wait_for(run.private, lambda status: sent_of(status) >= 100, 10, "100 requests")
    sent_ns = [e.t_ns for e in run.record.history.dialogue if e.kind is EntryKind.SENT]
    assert not any(map(turns.left_ns, sent_ns))
    assert any(after - before > turns.ns for before, after in itertools.pairwise(sent_ns))  # a pause


def sent_of(status: dict[str, object]) -> int:
    counts = status["requests"]
    return int(counts["sent"]) if isinstance(counts, dict) else 0


@pytest.mark.process
def test_a_cycle_and_its_ring_are_measured_side_by_side(home: Home) -> None:
    side = partial(ring_in_turns, RING, 64, pin=True)
    with side(THEIRS) as ring:
        began_ns = time.monotonic_ns()
        cycles, beside = CycleRun("pbr", "replica").cycles_beside(60, side)
        ended_ns = time.monotonic_ns()
    assert len(cycles) == 60 and min(cycles) > 0
    assert beside and min(beside) > 0
    within = [one.began_ns for one in ring if began_ns <= one.began_ns <= ended_ns]
    assert within and not any(map(THEIRS.left_ns, within))


@pytest.mark.process
def test_three_sides_are_measured_in_one_time_each_in_its_own_turns(home: Home) -> None:
    given: list[Turns] = []
    began: list[list[TimedSample]] = []

    @contextlib.contextmanager
    def noted(side: Side, turns: Turns) -> Iterator[list[TimedSample]]:
        given.append(turns)
        with side(turns) as measured:
            began.append(measured)
            yield measured

    run, ring = CycleRun("pbr", "replica"), partial(ring_in_turns, RING, 64, pin=True)
    found = side_by_side([partial(noted, side) for side in (run.in_turns, ring, ring)], 2 * TURN_NS, 0.3)
    assert given == [Turns(2 * TURN_NS, number, 3) for number in range(3)]
    for us, measured, turns in zip(found, began, given, strict=True):
        assert us and set(us) <= {one.us for one in measured}
        assert len(us) < len(measured)  # without the warm-up
        own = [one for one in measured if not turns.left_ns(one.began_ns)]
        assert len(own) > len(measured) / 2 and set(us) <= {one.us for one in own}


@contextlib.contextmanager
def silent(_: Turns) -> Iterator[list[TimedSample]]:
    """A side that the machine does not let run."""
    yield []


@pytest.mark.process
def test_a_side_that_measured_nothing_fails_the_measurement_which_is_then_repeated(home: Home) -> None:
    sides = iter((silent, partial(ring_in_turns, RING, 64, pin=True)))
    run = CycleRun("none", "single")
    found = together(1, lambda _: run.cycles_beside(60, next(sides)))
    assert found.machine.failures == 1 and len(found.figures[0]) == 60 and found.limits[0]
    reason = r"one side measured nothing in its turns within \d+ ms: .* let it measure for longer"
    with pytest.raises(HarnessError, match=reason):
        side_by_side([silent, silent], TURN_NS, 0.01)


@pytest.mark.process
def test_a_ring_has_a_session_of_its_own_as_a_run_has(home: Home) -> None:
    """The kernel shares a core among sessions: in that of a busy bench it takes the core from the run."""
    before = set(psutil.Process().children())
    with ring_in_turns(RING, 64, THEIRS, pin=True):
        (ring,) = set(psutil.Process().children()) - before
        until(lambda: len(ring.children()) == RING.hops, "the others of its hops, and the backup's")
        assert {os.getsid(one.pid) for one in (ring, *ring.children())} == {ring.pid}


@pytest.mark.process
def test_a_ring_that_is_ended_before_its_first_turn_has_measured_nothing_and_has_not_died() -> None:
    halves = [Turns(10**12, number, 2) for number in range(2)]
    (later,) = (turns for turns in halves if turns.left_ns(time.monotonic_ns()))
    with ring_in_turns(RING, 64, later, pin=True) as measured:
        pass
    assert measured == []


@pytest.mark.process
def test_a_ring_that_dies_ends_the_measurement(home: Home) -> None:
    before = set(psutil.Process().children())
    with (
        pytest.raises(HarnessError, match="the bare ring: one of its processes died"),
        ring_in_turns(RING, 64, THEIRS, pin=True),
    ):
        (ring,) = set(psutil.Process().children()) - before
        ring.kill()

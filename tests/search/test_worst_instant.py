"""The search for the worst instant: it misses nothing that trying every cycle finds, and its words repeat."""

import itertools
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import psutil
import pytest
from msgspec.structs import replace
from roads import near_course, sudden_course

from aftbed.core.errors import HarnessError
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Trigger
from aftbed.inject.hang import Hang
from aftbed.inject.model import Fault, FaultAction, parse
from aftbed.runtime.sim.world import Setup, simulate
from aftbed.search import worst_instant as search_worst_instant
from aftbed.search.worst_instant import (
    ANCHOR,
    STEP_CYCLES,
    Branch,
    Course,
    Worst,
    branched,
    coarse,
    course_of,
    harm,
    span,
    strike,
    worst_instant,
)

pytestmark = pytest.mark.simulation

NO_LOSS_M: Final = 0.05  # what a failover may take of the gap
STEP_M: Final = 0.02  # a step of the brakes, at the speeds of these drives


@pytest.fixture(scope="module")
def near(tmp_path_factory: pytest.TempPathFactory) -> Course:
    """Under no mechanism: warning, partial and full braking."""
    return near_course(tmp_path_factory.mktemp("near"), "none")


@pytest.fixture(scope="module")
def hung(near: Course) -> Worst:
    """The worst instant for an outage of 300 ms."""
    found = worst_instant(near, Hang(300), "primary")
    assert found is not None
    return found


@pytest.fixture(scope="module")
def pbr(tmp_path_factory: pytest.TempPathFactory) -> Course:
    return near_course(tmp_path_factory.mktemp("pbr"), "pbr")


def gaps_at_cycles(course: Course, action: FaultAction, step: int) -> list[float]:
    """The gap that is left by a fault at each `step`-th cycle of the search, without any clever choice."""

    def branches() -> Iterator[Branch]:
        first, last = span(course.cycles)
        for cycle in course.cycles[first + 1 : last + 1 : step]:
            yield Branch(cycle.t_ms - 1.0, Fault(action, "primary", Trigger(ANCHOR)))

    found = [outcome.result.min_gap_m for outcome in branched(course, branches(), 1e6)]
    return [gap for gap in found if gap is not None]


def assert_none_is_worse(course: Course, worst: Worst, outage_ms: int, step: int) -> None:
    """Than `worst`, of the instants that `gaps_at_cycles` tries."""
    assert worst.struck.result.min_gap_m is not None
    first, last = span(course.cycles)
    assert worst.instants < (last - first) / 2, "it is no search if it tries them all"
    assert worst.struck.result.min_gap_m <= min(gaps_at_cycles(course, Hang(outage_ms), step)) + STEP_M
    assert worst.struck.result.min_gap_m < (course.result.min_gap_m or 0.0) - outage_ms / 1000 * 2.0


def test_nothing_worse_is_found_by_trying_many_cycles(near: Course, hung: Worst) -> None:
    assert_none_is_worse(near, hung, 300, step=60)


@pytest.mark.deep
@pytest.mark.parametrize("outage_ms", [40, 300])
def test_nothing_worse_is_found_by_trying_every_cycle(near: Course, outage_ms: int) -> None:
    worst = worst_instant(near, Hang(outage_ms), "primary")
    assert worst is not None
    assert_none_is_worse(near, worst, outage_ms, step=1)


def test_the_words_of_the_worst_repeat_it_from_the_beginning(near: Course, hung: Worst) -> None:
    again = simulate(replace(near.setup, faults=(parse(str(hung.struck.fault)),)))
    assert again.vehicle == hung.struck.result != near.result


@pytest.mark.deep
def test_a_longer_outage_never_harms_less(near: Course, hung: Worst) -> None:
    shorter = worst_instant(near, Hang(20), "primary")
    assert shorter is not None
    assert harm(shorter.struck.result) <= harm(hung.struck.result)


@pytest.mark.deep
@pytest.mark.parametrize("ftm", ["pbr", "lfr", "pbr+tr", "lfr+tr"])
def test_a_crash_at_the_worst_instant_takes_next_to_nothing_under_any_mechanism(
    tmp_path: Path, ftm: str
) -> None:
    """And its words, simulated from the beginning, repeat it. One is in the tests of the tables each time."""
    course = near_course(tmp_path, ftm)
    worst = worst_instant(course, Crash(), "primary")
    assert worst is not None and worst.instants > 20
    lost_m = (course.result.min_gap_m or 0.0) - (worst.struck.result.min_gap_m or 0.0)
    assert 0.0 <= lost_m < NO_LOSS_M
    assert worst.struck.broken == ()
    again = simulate(replace(course.setup, faults=(parse(str(worst.struck.fault)),)))
    assert again.vehicle == worst.struck.result
    assert again.struck, "no process was struck"


def test_without_a_mechanism_a_crash_in_sight_of_the_car_ahead_is_a_collision(tmp_path: Path) -> None:
    worst = worst_instant(sudden_course(tmp_path, "none", 50, 15.5), Crash(), "primary")
    assert worst is not None and worst.struck.result.collision
    assert worst.struck.result.impact_speed_kmh == pytest.approx(50.0)


def test_under_none_nothing_notices_an_outage(tmp_path: Path) -> None:
    course = sudden_course(tmp_path, "none", 50, 15.5)
    run = simulate(replace(course.setup, faults=(parse("hang primary for 300ms at server.enter nth 4"),)))
    told = {event for _, event, _ in run.logged}
    assert told == {"armed", "roles"}
    found = strike(course, Fault(Hang(300), "primary", Trigger(ANCHOR, 4)))
    assert found.fired and found.broken == ()


def test_a_cycle_is_found_by_the_how_manieth_event_it_is_under_tr_too(tmp_path: Path) -> None:
    course = near_course(tmp_path, "pbr+tr")
    index = 50
    nth = course.nths[ANCHOR][course.cycles[index].request_id]
    assert nth == 2 * index + 1, "TR executes each request twice"
    struck = strike(course, Fault(Crash(), "primary", Trigger(ANCHOR, nth)))
    assert struck.t_ms == pytest.approx(course.cycles[index].t_ms, abs=1.0)


def test_a_time_since_the_arming_is_that_of_the_drive(pbr: Course) -> None:
    struck = strike(pbr, Fault(Crash(), "primary", Trigger(after_ms=1234.0 - pbr.armed_ms)))
    assert struck.t_ms == pytest.approx(1234.0, abs=0.1)


def test_a_fault_that_never_comes_to_its_point_has_not_fired(near: Course) -> None:
    struck = strike(near, Fault(Crash(), "primary", Trigger(ANCHOR, 100_000)))
    assert not struck.fired and struck.t_ms is None
    assert struck.result == near.result


def test_the_search_begins_at_each_change_of_stage_and_leaves_no_gap(near: Course) -> None:
    first, last = span(near.cycles)
    assert near.cycles[first].target and not near.cycles[last].moving
    begun = coarse(near.cycles, first, last)
    stages = [near.cycles[at].stage for at in begun[:3]]
    assert stages == [1, 2, 3]
    ordered = sorted(begun)
    assert (ordered[0], ordered[-1]) == (first, last)
    assert max(b - a for a, b in itertools.pairwise(ordered)) <= STEP_CYCLES


def test_behind_a_car_that_moves_the_search_ends_with_the_braking() -> None:
    course = course_of(Setup("none", scenario="ccrm-50"))
    _, last = span(course.cycles)
    assert last < len(course.cycles) - 1
    assert (course.cycles[last - 1].stage, course.cycles[last].stage) == (3, 0)
    assert course.cycles[last].moving


def test_of_a_drive_without_a_target_all_is_searched() -> None:
    course = course_of(Setup("none", scenario="negative:free-drive-30"))
    assert span(course.cycles) == (0, len(course.cycles) - 1)


def test_a_copy_that_comes_to_no_end_is_killed_and_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search_worst_instant, "DECIDED_SECONDS_MAX", 0.05)
    monkeypatch.setattr(search_worst_instant, "_decided", lambda *_: signal.pause())
    course = course_of(Setup("none", scenario="ccrs-20"))
    branch = Branch(500.0, Fault(Crash(), "primary", Trigger()))
    before = psutil.Process().children()
    with pytest.raises(HarnessError, match=r"the copy of the simulator is not decided after 0.05 s, ccrs-20"):
        list(branched(course, [branch], 2000.0))
    assert psutil.Process().children() == before, "it is dead, and reaped"


def test_a_copy_that_dies_says_why(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(search_worst_instant, "_decided", lambda *_: 1 // 0)
    course = course_of(Setup("none", scenario="ccrs-20"))
    branch = Branch(500.0, Fault(Crash(), "primary", Trigger()))
    with pytest.raises(HarnessError, match="the copy of the simulator died, ccrs-20"):
        list(branched(course, [branch], 2000.0))
    assert "ZeroDivisionError" in capfd.readouterr().err

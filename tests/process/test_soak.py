"""Failover after failover, adaptation after adaptation, in one run: nothing grows with their number.

The process tier does a few; the deep one a thousand.
"""

import itertools
import time
from collections.abc import Callable
from typing import Final

import msgspec
import psutil
import pytest
from liveruns import ENDLESS, LOOK_SECONDS, Home, Started, until
from test_adaptations import adapt

from aftbed.core.messages import Goal
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Trigger
from aftbed.inject.model import Fault
from aftbed.runtime.unix import control_client
from aftbed.runtime.unix.options import LoadRun

pytestmark = pytest.mark.process

LASTING: Final = ("supervisor", "proxy", "client", "recovery", "engine", "a/watchdog", "b/watchdog", "zygote")
WARM_UP: Final = 5  # failovers after which all is allocated that is ever needed at once
SPARES: Final = 6  # parked for a whole replica and one more, or just being forked
DESCRIPTORS_SLACK: Final = 2 * SPARES + 2  # the supervisor has two for each of them
PSS_MB_PER_THOUSAND: Final = 6.0
PSS_MB_SLACK: Final = 2.0
RATE_HZ: Final = 200.0
SETTLE_SECONDS_MAX: Final = 5.0


class Size(msgspec.Struct, frozen=True):
    """How big the run is: descriptors and PSS (MB) of each lasting process, and how many there are in all."""

    descriptors: dict[str, int]
    pss_mb: dict[str, float]
    processes: int


def size(home: Home, run: Started) -> Size:
    """Measured while nothing is under way."""
    pids = {row.name: row.pid for row in run.rows()}
    return Size(
        {name: run.descriptors(pids[name]) for name in LASTING},
        {name: psutil.Process(pids[name]).memory_full_info().pss / 1e6 for name in LASTING},
        len(home.processes()),
    )


def until_settled(look: Callable[[], list[str]]) -> None:
    """Wait until `look` finds nothing: a zygote may be at work for the next spares."""
    limit = time.monotonic() + SETTLE_SECONDS_MAX
    while (found := look()) and time.monotonic() < limit:
        time.sleep(LOOK_SECONDS)
    assert not found


def fail_over(run: Started, count: int) -> None:
    """Crash the primary `count` times, each time when a backup stands."""
    for _ in range(count):
        leader = run.status()["leader"]
        control_client.ask(run.private, control_client.InjectCommand(Fault(Crash(), "primary", Trigger())))
        until(lambda led=leader: run.status()["leader"] not in ("", led), "another leader")
        until(run.redundant, "redundancy")


@pytest.mark.parametrize(
    ("placement", "count"),
    [
        ("process", 6),
        ("replica", 6),
        pytest.param("process", 1000, marks=[pytest.mark.deep, pytest.mark.timeout(1200)]),
        pytest.param("replica", 1000, marks=[pytest.mark.deep, pytest.mark.timeout(1200)]),
    ],
)
def test_many_failovers_leave_no_trace(home: Home, placement: str, count: int) -> None:
    with Started(home, LoadRun(ENDLESS, RATE_HZ), placement=placement) as run:
        run.wait_for("started")
        fail_over(run, WARM_UP)
        until(lambda: len(home.processes()) <= len(run.rows()) + 1, "the dead to be reaped")  # and the warden
        before = size(home, run)
        fail_over(run, count)
        until_settled(lambda: grown(before, size(home, run), count))
        run.launched.stop()
        outcome = run.finish(120.0)
    assert outcome.verdict.verdict == "pass", outcome.verdict.reasons
    assert outcome.verdict.requests.lost == 0
    assert len(outcome.verdict.failovers) == WARM_UP + count


def adapt_back_and_forth(run: Started, count: int) -> None:
    """`count` adaptations: a composition, its end, and so on."""
    for expression in itertools.islice(itertools.cycle(("pbr+tr", "pbr")), count):
        found = adapt(run, Goal(expression=expression))
        assert (found["outcome"], found["reason"]) == ("done", "")


@pytest.mark.parametrize(
    ("placement", "count"),
    [
        ("process", 6),
        pytest.param("process", 1000, marks=[pytest.mark.deep, pytest.mark.timeout(1200)]),
        pytest.param("replica", 1000, marks=[pytest.mark.deep, pytest.mark.timeout(1200)]),
    ],
)
def test_many_adaptations_leave_no_trace(home: Home, placement: str, count: int) -> None:
    with Started(home, LoadRun(ENDLESS, RATE_HZ), placement=placement) as run:
        run.wait_for("started")
        adapt_back_and_forth(run, 2 * WARM_UP)
        until_settled(lambda: ["the dead"] if len(home.processes()) > len(run.rows()) + 1 else [])
        before = size(home, run)
        adapt_back_and_forth(run, count)
        until_settled(lambda: grown(before, size(home, run), count))
        run.launched.stop()
        outcome = run.finish(120.0)
    assert outcome.verdict.verdict == "pass", outcome.verdict.reasons
    assert outcome.verdict.requests.lost == 0
    assert not outcome.verdict.failovers


def grown(before: Size, after: Size, count: int) -> list[str]:
    """What there is more of than before: processes, descriptors, memory beyond what `count` may cost."""
    found = [] if after.processes <= before.processes + SPARES else [f"{after.processes} processes"]
    for name in LASTING:
        descriptors = after.descriptors[name]
        if descriptors > before.descriptors[name] + DESCRIPTORS_SLACK:
            found.append(f"{name}: {descriptors} descriptors, {before.descriptors[name]} before")
        allowed_mb = before.pss_mb[name] + PSS_MB_SLACK + PSS_MB_PER_THOUSAND * count / 1000
        if after.pss_mb[name] > allowed_mb:
            found.append(f"{name}: {after.pss_mb[name]:.1f} MB, {before.pss_mb[name]:.1f} MB before")
    return found

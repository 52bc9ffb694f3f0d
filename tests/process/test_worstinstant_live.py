"""A worst instant that was found in the simulator, on real processes, in the words that it was told in."""

import shlex
from typing import Final

import pytest
from liveruns import aftbed

from aftbed.inject.crash import Crash
from aftbed.inject.hang import Hang
from aftbed.inject.model import FaultAction
from aftbed.runtime.sim.world import Setup
from aftbed.search.road_table import PRIMARY, repeat
from aftbed.search.worst_instant import course_of, worst_instant
from aftbed.vehicle.plant import VehicleResult

pytestmark = pytest.mark.process

SCENARIO: Final = "r152:m1-20"
LOST_M_MAX: Final = 0.05
OUTAGE_M: Final = 300 / 1000 * 20 / 3.6


def searched(ftm: str, action: FaultAction) -> tuple[list[str], VehicleResult, VehicleResult]:
    """The command for real processes; what the drive is without the fault, and with it, simulated."""
    course = course_of(Setup(ftm, scenario=SCENARIO))
    worst = worst_instant(course, action, PRIMARY)
    assert worst is not None
    _, command = repeat(worst.struck.setup)
    words = shlex.split(command)
    assert words[:2] == ["aftbed", "run"]
    return words[1:], course.result, worst.struck.result


@pytest.mark.deep
@pytest.mark.parametrize("ftm", ["pbr", "lfr+tr"])
def test_a_crash_at_the_worst_instant_passes_on_processes_too(ftm: str) -> None:
    words, free, _ = searched(ftm, Crash())
    done = aftbed(*words, "--json")
    verdict = done.verdict()
    assert (done.code, verdict.verdict) == (0, "pass"), done.out + done.err
    assert verdict.failovers, "no process was struck"
    assert verdict.vehicle is not None and not verdict.vehicle.collision
    assert verdict.vehicle.min_gap_m == pytest.approx(free.min_gap_m, abs=LOST_M_MAX)


@pytest.mark.deep
def test_an_outage_at_the_worst_instant_takes_its_metres_on_processes_too() -> None:
    words, free, struck = searched("none", Hang(300))
    done = aftbed(*words, "--json")
    vehicle = done.verdict().vehicle
    assert vehicle is not None, done.out + done.err
    assert free.min_gap_m is not None and struck.min_gap_m is not None
    assert struck.min_gap_m < free.min_gap_m - OUTAGE_M / 2, "in the simulator it took them"
    gap_m = 0.0 if vehicle.min_gap_m is None else vehicle.min_gap_m
    assert gap_m < free.min_gap_m - OUTAGE_M / 2, "on processes it did not"

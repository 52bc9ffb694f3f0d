"""Tables of the road: rows are judged as the table says, outages stand beside mechanisms."""

from pathlib import Path
from typing import Final

import pytest
from msgspec.structs import replace
from roads import near

from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Trigger
from aftbed.inject.model import Fault, parse
from aftbed.judge.simulated import breaches
from aftbed.runtime.sim.world import Setup, simulate
from aftbed.search.road_table import PRIMARY, DrivenRow, RoadDrive, RoadLine, drive, driven, drives, outage
from aftbed.vehicle.scenarios.tables import Case, cases

pytestmark = pytest.mark.simulation

BARE: Final = RoadLine("none", "none")
LOST_M_MAX: Final = 0.05
R152: Final = {case.name: case for case in cases("r152")}


def crash(ftm: str) -> RoadLine:
    """A crash of the primary at the worst instant."""
    return RoadLine(f"{ftm}, crash", ftm, Fault(Crash(), PRIMARY, Trigger()), searched=True)


def row(case: Case, line: RoadLine) -> DrivenRow:
    """That one, driven."""
    (found,) = drive(RoadDrive((case,), line, 0))
    return found


def test_a_row_without_a_fault_passes_and_says_how() -> None:
    found = row(R152["r152:m1-60"], BARE)
    assert (found.passed, found.because, found.impact_kmh, found.limit_kmh) == (True, (), 0.0, 35.0)
    assert found.min_gap_m is not None and found.min_gap_m > 1.0
    assert found.warning_s is not None and found.warning_s >= 0.8
    assert (found.fault, found.instants, found.loss_m, found.closed_form_kmh) == (None, None, None, None)
    assert found.repeat[0] == "aftbed sim --scenario r152:m1-60 --ftm none --seed 0"


def test_rows_that_begin_alike_are_driven_once_and_judged_each_by_its_own() -> None:
    laden = [R152["r152:m1-laden-40"], R152["r152:n1-laden-40"]]
    assert [case.limit_kmh for case in laden] == [0.0, 10.0]
    todo = drives(laden, (BARE, outage(500)), 0)
    assert [len(one.cases) for one in todo] == [2, 2]
    strict, mild = drive(
        RoadDrive(
            tuple(laden), RoadLine("late", "none", parse("hang primary for 400ms at server.enter nth 152")), 0
        )
    )
    assert strict.impact_kmh == mild.impact_kmh
    assert [strict.case, mild.case] == ["r152:m1-laden-40", "r152:n1-laden-40"]
    assert "--scenario r152:n1-laden-40" in mild.repeat[0]


@pytest.mark.deep
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("ftm", ["pbr", "lfr", "pbr+tr", "lfr+tr"])
def test_every_row_of_m1_passes_under_a_crash_at_the_worst_instant(ftm: str) -> None:
    for rows in driven(drives(cases("r152", "m1"), (crash(ftm),), 0), 2):
        for found in rows:
            assert found.passed, found
            assert found.loss_m is not None and found.loss_m <= LOST_M_MAX
            assert found.loss_kmh == 0.0


@pytest.mark.deep
def test_a_row_passes_under_a_crash_at_the_worst_instant_as_without_it() -> None:
    case = R152["r152:m1-10"]
    found, free = row(case, crash("pbr")), row(case, RoadLine("pbr", "pbr"))
    assert found.passed and free.passed
    assert found.loss_m is not None and 0.0 <= found.loss_m <= LOST_M_MAX
    assert found.min_gap_m is not None and free.min_gap_m is not None
    assert found.min_gap_m == pytest.approx(free.min_gap_m - found.loss_m, abs=2e-4)
    assert found.at_s is not None and found.instants is not None and found.instants > 20
    assert found.fault is not None and found.fault.startswith("crash primary at ")
    again = simulate(Setup("pbr", scenario=case.name, faults=(parse(found.fault),)))
    assert again.vehicle is not None and again.vehicle.min_gap_m is not None
    assert round(again.vehicle.min_gap_m, 4) == found.min_gap_m
    assert breaches(again) == () and again.struck, "its words repeat it"
    assert (
        found.repeat[1]
        == f'aftbed run --scenario r152:m1-10 --ftm pbr --seed 0 --pace max --inject "{found.fault}"'
    )


def test_an_outage_that_fails_a_row_says_that_it_must(tmp_path: Path) -> None:
    case = replace(R152["r152:m1-20"], name=near(tmp_path))
    found = row(case, outage(1000))
    assert not found.passed
    assert found.because[0] == f"impact at {found.impact_kmh:.1f} km/h, allowed is none"
    assert found.closed_form_kmh is not None and 0.0 < found.impact_kmh <= found.closed_form_kmh
    left_m = row(case, BARE).min_gap_m
    assert found.must_fail == f"1000 ms take 5.56 m of the braking distance; {left_m:.2f} m were left"
    assert "--pace real" in found.repeat[1], "in lockstep the drive would wait for the function"


def test_a_fault_that_never_strikes_is_no_pass() -> None:
    line = RoadLine("never", "pbr", parse("crash primary at server.enter nth 100000"))
    found = row(R152["r152:m1-10"], line)
    assert (found.struck, found.passed) == (False, False)
    assert found.because == ("never struck: crash primary at server.enter nth 100000",)
    assert found.repeat == ()


def test_a_broken_promise_fails_a_row_whatever_the_car_does() -> None:
    # No TR: a flipped bit of a reply that was due reaches the brakes. Here it is one that asks for nothing.
    line = RoadLine("flip", "pbr", parse("bitflip result bit 60 nth 3"))
    found = row(R152["r152:m1-10"], line)
    assert not found.passed and found.struck
    assert found.because[0].startswith("one_history (G3): ")


def test_colours_are_those_of_euro_ncap_only() -> None:
    (ncap,) = [case for case in cases("ncap", "ccrs") if case.speed_kmh == 10]
    assert row(ncap, BARE).colour == "green"
    assert row(R152["r152:m1-10"], BARE).colour is None


def test_a_negative_row_fails_if_anything_brakes() -> None:
    (case,) = [case for case in cases("negative", "free-drive") if case.speed_kmh == 30]
    assert row(case, BARE).passed
    impossible = replace(R152["r152:m1-10"], demand_ms2_max=0.0, demand_ms2_min=None)
    assert not row(impossible, BARE).passed


def test_the_rows_are_the_same_over_several_processes() -> None:
    todo = drives([R152["r152:m1-10"], R152["r152:m1-20"]], (BARE, RoadLine("pbr", "pbr")), 3)
    assert list(driven(todo, 1)) == list(driven(todo, 2))

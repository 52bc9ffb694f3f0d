"""The FTTI: against its closed form, against the simulator, over speed, and where there is none."""

import json
import math
from functools import cache
from pathlib import Path
from typing import Final

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from aftbed.core.errors import ConfigError
from aftbed.inject.grammar import Trigger
from aftbed.inject.hang import Hang
from aftbed.inject.model import Fault
from aftbed.runtime.sim.world import Setup
from aftbed.search.ftti import Fhti, FttiRow, FttiSearch, FunctionFault, ftti, margins, read_fhti, rows_of
from aftbed.search.worst_instant import ANCHOR, course_of, impact_kmh, strike
from aftbed.vehicle.ecus import BrakePolicy

pytestmark = pytest.mark.simulation

OBSTACLE: Final = """
description: a car that stands {gap_m} m ahead when the radar begins
duration_s: 6
ego: {{speed_kmh: {speed_kmh}}}
lead: {{gap_m: {gap_m}, speed_kmh: 0}}
expect: {{outcome: no_collision}}
"""
SLACK_MS: Final = 3  # the simulator's hops take time, and a reply counts from the next step of the brakes


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of all tests: what was measured there need not be measured again."""
    return tmp_path_factory.mktemp("obstacles")


def obstacle(folder: Path, speed_kmh: float, gap_m: float) -> str:
    path = folder / f"obstacle-{speed_kmh:g}-{gap_m:g}.yaml"
    path.write_text(OBSTACLE.format(speed_kmh=speed_kmh, gap_m=gap_m))
    return str(path)


@cache
def measured(name: str, fault: FunctionFault = FunctionFault.HANG, brakes: BrakePolicy = "latch") -> FttiRow:
    return ftti(FttiSearch(name, fault, brakes, 0))


@pytest.mark.deep
@pytest.mark.parametrize(
    ("name", "fault"),
    [
        (name, fault)
        for name in ("ccrs-20", "ccrs-42", "ccrs-50")
        for fault in (FunctionFault.OMISSION, FunctionFault.HANG)
    ],
)
def test_it_is_within_a_tenth_of_the_closed_form(name: str, fault: FunctionFault) -> None:
    row = measured(name, fault)
    assert row.closed_form_ms is not None and row.ftti_ms == pytest.approx(row.closed_form_ms, rel=0.1)


@pytest.mark.deep
def test_there_is_no_closed_form_where_a_fault_within_the_partial_braking_is_worse() -> None:
    row = measured("ncap:ccrs-40", FunctionFault.HANG)
    assert row.worst_instant_s == 3.0, "the first demand is at 2.56 s"
    assert row.ftti_ms is not None and row.closed_form_ms is None


def test_from_one_gap_it_never_grows_with_speed(folder: Path) -> None:
    found = [measured(obstacle(folder, speed_kmh, 18.0)).ftti_ms or math.inf for speed_kmh in (46, 53)]
    assert found[1] < found[0] < math.inf


def test_where_full_braking_cannot_wait_it_is_that_of_the_closed_form(folder: Path) -> None:
    row = measured(obstacle(folder, 53, 18.0))
    assert row.closed_form_ms is not None and row.ftti_ms == pytest.approx(row.closed_form_ms, rel=0.1)


def test_the_simulator_breaks_the_row_with_more_and_keeps_it_with_less(folder: Path) -> None:
    name = obstacle(folder, 53, 18.0)
    row = measured(name)
    assert row.ftti_ms is not None and row.worst_instant_s is not None
    course = course_of(Setup("none", scenario=name))
    cycle = next(cycle for cycle in course.cycles if cycle.t_ms == round(row.worst_instant_s * 1000))
    nth = course.nths[ANCHOR][cycle.request_id]
    for length_ms, hits in ((row.ftti_ms - SLACK_MS, False), (row.ftti_ms + SLACK_MS, True)):
        struck = strike(course, Fault(Hang(round(length_ms)), "primary", Trigger(ANCHOR, nth)))
        assert struck.fired
        assert (impact_kmh(struck.result) > 0.0) is hits


@pytest.mark.deep
def test_a_stuck_reply_is_refused_by_e2e_so_it_is_an_omission(folder: Path) -> None:
    name = obstacle(folder, 50, 18.0)
    stuck, omission = measured(name, FunctionFault.STUCK), measured(name, FunctionFault.OMISSION)
    assert stuck.ftti_ms == omission.ftti_ms


@pytest.mark.deep
def test_brakes_that_release_tolerate_no_more_than_those_that_latch(folder: Path) -> None:
    name = obstacle(folder, 50, 18.0)
    latch, release = (measured(name, FunctionFault.OMISSION, brakes) for brakes in ("latch", "release"))
    assert release.ftti_ms is not None and latch.ftti_ms is not None and release.ftti_ms <= latch.ftti_ms


def test_where_no_braking_is_due_a_missing_reply_breaks_nothing_and_a_wrong_one_all(tmp_path: Path) -> None:
    path = tmp_path / "empty.yaml"
    path.write_text(
        "{description: an empty road, duration_s: 1, ego: {speed_kmh: 80}, expect: {outcome: no_braking}}"
    )
    silent = measured(str(path), FunctionFault.OMISSION)
    assert (silent.ftti_ms, silent.broken_by, silent.worst_instant_s) == (None, None, None)
    wrong = measured(str(path), FunctionFault.WRONG_VALUE)
    assert wrong.ftti_ms == 1.0 and wrong.broken_by == "the car braked, expected no_braking"


def test_a_row_that_is_broken_without_a_fault_has_no_ftti(folder: Path) -> None:
    with pytest.raises(ConfigError, match="is broken without a fault, so has no FTTI: collision at"):
        measured(obstacle(folder, 60, 10.0))


def test_a_scenario_is_judged_by_the_rows_with_its_drive() -> None:
    assert [row.name for row in rows_of("ccrs-20")] == ["ncap:ccrs-20", "r152:m1-20", "r152:n1-20"]
    assert [row.name for row in rows_of("r152:m1-20")] == ["r152:m1-20"]
    assert rows_of("ccrm-50") and not rows_of("free-drive")


def test_the_margin_is_of_the_bound_or_of_the_p99() -> None:
    row = FttiRow("x", 50.0, FunctionFault.HANG, 100.0, None, "x: impact", 1.0)
    found = margins(row, {"pbr": Fhti(2.0, 4.0, 20.0), "lfr": Fhti(2.0, 4.0)}).mechanisms
    assert (found["pbr"].margin, found["lfr"].margin) == (0.8, 0.96)


figures = st.dictionaries(st.sampled_from(("p50", "p99", "bound")), st.integers(-5, 99) | st.floats())
documents = st.builds(
    lambda found, end: json.dumps({"pbr": found})[:end].encode(), figures, st.integers(-2, 99)
)


@given(st.binary(max_size=80) | documents)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_file_of_figures_is_read_or_refused(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "fhti.json"
    path.write_bytes(data)
    try:
        found = read_fhti(path)
    except ConfigError as error:
        assert str(path) in str(error)
    else:
        assert all(0.0 <= one.p50 <= one.p99 for one in found.values())

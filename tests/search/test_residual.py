"""The closed form of an outage, against the bare plant and what the search finds with the function."""

from math import sqrt
from pathlib import Path
from typing import Final

import pytest
from hypothesis import given
from hypothesis import strategies as st
from roads import sudden_course

from aftbed.inject.hang import Hang
from aftbed.search.road_table import closing_speed_ms, residual_kmh
from aftbed.search.worst_instant import impact_kmh, worst_instant
from aftbed.vehicle.plant import KMH_PER_MS, LeadCar, Plant, PlantSetup, VehicleResult
from aftbed.vehicle.scenarios.library import load_scenario

pytestmark = pytest.mark.simulation

FULL_MS2: Final = 9.0
PLANT_KMH: Final = 0.15  # drag makes the deceleration differ by 1 % along the way
FUNCTION_KMH: Final = 0.1


def last_moment(speed_ms: float, gap_m: float, brake_at_ms: int) -> VehicleResult:
    """Full braking from that millisecond on, without any function."""
    plant = Plant(PlantSetup(speed_ms, LeadCar(gap_m)))
    for t_ms in range(20_000):
        if plant.stopped():
            return plant.result()
        plant.step(FULL_MS2 if t_ms >= brake_at_ms else 0.0)
    raise AssertionError("it neither stops nor hits")


@pytest.mark.parametrize("speed_kmh", [20, 50, 80])
@pytest.mark.parametrize("outage_ms", [10, 100, 300])
def test_the_car_that_would_have_just_stopped_hits_at_the_root_of_2_a_v0_t(
    speed_kmh: int, outage_ms: int
) -> None:
    speed_ms = speed_kmh / KMH_PER_MS
    way_m = 100.0 - (last_moment(speed_ms, 100.0, 0).stop_gap_m or 0.0)
    free = last_moment(speed_ms, way_m + 1e-6, 0)
    assert not free.collision
    late = last_moment(speed_ms, way_m + 1e-6, outage_ms)
    formula_kmh = sqrt(2 * free.max_deceleration_ms2 * speed_ms * outage_ms / 1000) * KMH_PER_MS
    assert residual_kmh(free, speed_ms, outage_ms) == pytest.approx(min(formula_kmh, speed_kmh), abs=0.01)
    if formula_kmh < speed_kmh * 0.7:  # else it hits while the brakes still build up
        assert impact_kmh(late) == pytest.approx(formula_kmh, abs=PLANT_KMH)
    assert impact_kmh(late) <= residual_kmh(free, speed_ms, outage_ms) + PLANT_KMH


@given(
    st.floats(3, 40),
    st.floats(0.0, 20.0),
    st.integers(0, 2000),
    st.integers(0, 500),
)
def test_it_is_a_bound_of_the_bare_plant_that_grows_with_the_outage(
    speed_ms: float, spare_m: float, outage_ms: int, more_ms: int
) -> None:
    way_m = 200.0 - (last_moment(speed_ms, 200.0, 0).stop_gap_m or 0.0)
    free = last_moment(speed_ms, way_m + spare_m + 0.01, 0)
    bound_kmh = residual_kmh(free, speed_ms, outage_ms)
    assert impact_kmh(last_moment(speed_ms, way_m + spare_m + 0.01, outage_ms)) <= bound_kmh + PLANT_KMH
    assert bound_kmh <= residual_kmh(free, speed_ms, outage_ms + more_ms) <= speed_ms * KMH_PER_MS + 1e-9


def test_a_drive_that_ends_in_an_impact_anyway_only_gets_faster() -> None:
    free = last_moment(20.0, 20.0, 0)
    assert free.collision
    assert residual_kmh(free, 20.0, 0) == pytest.approx(impact_kmh(free))
    late = last_moment(20.0, 20.0, 50)
    assert impact_kmh(free) < impact_kmh(late) <= residual_kmh(free, 20.0, 50)


@pytest.mark.parametrize(
    ("speed_kmh", "gap_m", "outage_ms"),
    [
        (30, 7.5, 300),
        pytest.param(50, 15.5, 100, marks=pytest.mark.deep),
        pytest.param(70, 25.93, 20, marks=pytest.mark.deep),
    ],
)
def test_where_full_braking_cannot_wait_the_worst_outage_is_that_of_the_closed_form(
    tmp_path: Path, speed_kmh: float, gap_m: float, outage_ms: int
) -> None:
    course = sudden_course(tmp_path, "none", speed_kmh, gap_m)
    assert [c.stage for c in course.cycles][:6] == [0, 0, 0, 3, 3, 3], (
        "the function did not go to full at once"
    )
    assert not course.result.collision
    worst = worst_instant(course, Hang(outage_ms), "primary")
    assert worst is not None
    formula_kmh = residual_kmh(course.result, speed_kmh / KMH_PER_MS, outage_ms)
    assert formula_kmh > 5.0
    assert impact_kmh(worst.struck.result) == pytest.approx(formula_kmh, abs=FUNCTION_KMH)
    assert worst.struck.t_ms == pytest.approx(course.cycles[3].t_ms, abs=0.5)


@pytest.mark.parametrize(
    ("name", "closing_kmh"), [("ccrs-50", 50), ("ccrm-50", 30), ("ccrb-50-40m", None), ("free-drive", None)]
)
def test_what_closes_the_gap(name: str, closing_kmh: float | None) -> None:
    found = closing_speed_ms(load_scenario(name))
    assert (found is None) is (closing_kmh is None)
    assert closing_kmh is None or found == pytest.approx(closing_kmh / KMH_PER_MS)

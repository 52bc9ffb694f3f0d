"""A time as metres and as km/h left at contact, against a car that is driven step by step."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.bench.road import DECELERATION_MS2, metres, on_road, residual_kmh

SPEEDS = st.floats(1, 130)
DELAYS = st.floats(0, 5000)
STEP_S = 1e-5


def driven_kmh(speed_kmh: float, delay_ms: float) -> float:
    """The speed at contact of a car that begins to brake `delay_ms` after its last moment to."""
    speed_ms = speed_kmh / 3.6
    left_m, t_s = speed_ms**2 / (2 * DECELERATION_MS2), 0.0
    while left_m > 0 and speed_ms > 0:
        braking = t_s >= delay_ms / 1e3
        left_m -= speed_ms * STEP_S
        speed_ms -= DECELERATION_MS2 * STEP_S if braking else 0.0
        t_s += STEP_S
    return max(0.0, speed_ms) * 3.6


@pytest.mark.parametrize(("speed_kmh", "delay_ms"), [(50, 1), (50, 2), (50, 300), (80, 100), (30, 600)])
def test_the_closed_form_is_what_a_car_does(speed_kmh: float, delay_ms: float) -> None:
    assert residual_kmh(speed_kmh, delay_ms) == pytest.approx(driven_kmh(speed_kmh, delay_ms), abs=0.1)


def test_the_papers_figures_at_50_km_h() -> None:
    adaptation, recovery = on_road(300.0), on_road(1.0)
    assert (adaptation.metres, adaptation.worst_kmh) == (4.1667, 30.88)
    assert (recovery.metres, recovery.worst_kmh) == (0.0139, 1.78)


@given(SPEEDS, DELAYS, DELAYS)
def test_a_longer_delay_is_never_better(speed_kmh: float, one: float, other: float) -> None:
    short, long = sorted((one, other))
    assert residual_kmh(speed_kmh, short) <= residual_kmh(speed_kmh, long) <= speed_kmh
    assert metres(speed_kmh, short) <= metres(speed_kmh, long)


@given(SPEEDS, DELAYS)
def test_who_brakes_harder_loses_more_by_braking_late(speed_kmh: float, delay_ms: float) -> None:
    """The last moment is later: from there on each metre takes more of the speed."""
    assert residual_kmh(speed_kmh, delay_ms, 5.0) <= residual_kmh(speed_kmh, delay_ms, 8.0)


def test_no_delay_costs_nothing() -> None:
    assert on_road(0.0) == on_road(0.0, 130.0)
    assert residual_kmh(50, 0) == metres(50, 0) == 0

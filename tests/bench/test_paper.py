"""`aftbed bench paper`: failed measurements, sizes too large, and times as what they are on the road."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.bench.paper import DECELERATION_MS2, metres, on_road, residual_kmh
from aftbed.bench.runs import TRIES, tried
from aftbed.bench.sweep import StateResult, sweep_sizes
from aftbed.core.errors import ConfigError, HarnessError


class Flaky:
    """Fails so many times, then gives a number."""

    def __init__(self, failures: int, error: type[Exception] = HarnessError) -> None:
        self.failures, self.calls, self.error = failures, 0, error
        self.told: list[str] = []

    def measure(self) -> int:
        self.calls += 1
        if self.calls <= self.failures:
            raise self.error(f"trouble {self.calls}")
        return 42

    def tried(self) -> int:
        return tried("a figure", self.measure, self.told.append)


@pytest.mark.parametrize("error", [HarnessError, ConfigError])
def test_a_measurement_that_fails_is_begun_anew(error: type[Exception]) -> None:
    flaky = Flaky(TRIES - 1, error)
    assert flaky.tried() == 42
    assert flaky.told == ["a figure", "a figure, again (trouble 1)", "a figure, again (trouble 2)"]


def test_one_that_fails_again_and_again_is_trouble_of_the_harness() -> None:
    flaky = Flaky(TRIES)
    with pytest.raises(HarnessError, match="a figure: failed 3 times, the last time: trouble 3"):
        flaky.tried()


def test_a_fault_of_ours_is_not_tried_again() -> None:
    flaky = Flaky(1, ZeroDivisionError)
    with pytest.raises(ZeroDivisionError):
        flaky.tried()
    assert flaky.calls == 1


def test_behind_the_first_size_that_is_not_carried_none_is_tried() -> None:
    asked: list[int] = []

    def measure(size_bytes: int) -> StateResult:
        asked.append(size_bytes)
        return StateResult("pbr", size_bytes, refused="too large" if size_bytes > 100 else "")

    rows = sweep_sizes("pbr", (10_000, 100, 1_000), measure)
    assert asked == [100, 1_000]
    assert [(row.state_bytes, bool(row.refused)) for row in rows] == [
        (100, False),
        (1_000, True),
        (10_000, True),
    ]
    assert rows[2].refused == "not tried: a smaller one is not carried"


# -- on the road: a time as metres and as km/h left at contact, against a car that is driven step by step

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
def test_a_car_that_brakes_harder_loses_more_by_braking_late(speed_kmh: float, delay_ms: float) -> None:
    """The last moment is later: from there on each metre takes more of the speed."""
    assert residual_kmh(speed_kmh, delay_ms, 5.0) <= residual_kmh(speed_kmh, delay_ms, 8.0)


def test_no_delay_costs_nothing() -> None:
    assert on_road(0.0) == on_road(0.0, 130.0)
    assert residual_kmh(50, 0) == metres(50, 0) == 0

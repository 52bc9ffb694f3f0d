"""What must hold between two drives: longer outages, more friction, later starts, finer steps.

The brakes are given a demand by a clock here, without the function: from `onset_ms` on so much, but for an
outage. What the function makes of one is at the end. The car ahead stands or drives on: into one that brakes,
an earlier contact can be the slower one.
"""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from puredrive import drive
from sampling import sampled

from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.plant import (
    GRAVITY_MS2,
    STEP_US,
    Brakes,
    CutIn,
    LeadBraking,
    LeadCar,
    Plant,
    PlantSetup,
    VehicleResult,
)
from aftbed.vehicle.scenarios.library import load_scenario

pytestmark = pytest.mark.simulation

DRIVE_MS = 15_000
STEP_ERROR_M = 0.03  # of the place where the ego stands, or would stand at full grip

speeds = st.floats(3.0, 35.0)
gaps = st.floats(1.0, 80.0)
rooms = st.floats(0.1, 1.5)  # for braking, in parts of what the speed takes at full grip
demands = st.floats(0.5, 12.0)
frictions = st.floats(0.1, 1.2)
onsets = st.integers(0, 3000)
brakes = st.builds(
    Brakes,
    st.integers(0, 300),
    st.integers(0, 400),
    st.none() | st.floats(5.0, 100.0),
    st.none() | st.floats(2.0, 12.0),
)


def drive_by_clock(
    setup: PlantSetup,
    demand_ms2: float,
    onset_ms: int,
    outage_ms: tuple[int, int] = (0, 0),
    step_us: int = STEP_US,
    drive_ms: int = DRIVE_MS,
) -> VehicleResult:
    """To the end: braking from `onset_ms` on, but not from the first to the second instant of `outage_ms`."""
    plant = Plant(setup, step_us)
    while plant.t_us < drive_ms * 1000 and not plant.stopped():
        t_ms = plant.t_us / 1000
        asked = t_ms >= onset_ms and not outage_ms[0] <= t_ms < outage_ms[1]
        plant.step(demand_ms2 if asked else 0.0)
    return plant.result()


def gap_m(speed_ms: float, room: float, grip_ms2: float, onset_ms: int) -> float:
    """That at the start, so that `room` is left when braking begins: neither out of reach nor far off."""
    return speed_ms * onset_ms / 1000 + room * speed_ms * speed_ms / (2.0 * grip_ms2)


def impact_kmh(result: VehicleResult) -> float:
    """0 is no contact."""
    return result.impact_speed_kmh or 0.0


def margin_m(result: VehicleResult, grip_ms2: float) -> float:
    """Metres left at standstill; less than none after contact, by what the rest of the speed takes to stop.

    The speed at impact itself is no measure of an error: near 0 it changes without bound.
    """
    if not result.collision:
        assert result.min_gap_m is not None
        return result.min_gap_m
    impact_ms = impact_kmh(result) / 3.6
    return -impact_ms * impact_ms / (2.0 * grip_ms2)


@given(speeds, rooms, st.floats(0.0, 20.0), demands, frictions, brakes, onsets, *[st.integers(0, 2000)] * 3)
def test_a_longer_outage_never_lowers_the_impact_speed(
    speed_ms: float,
    room: float,
    lead_ms: float,
    demand_ms2: float,
    friction: float,
    able: Brakes,
    onset_ms: int,
    after_ms: int,
    outage_ms: int,
    longer_ms: int,
) -> None:
    lead_ms = min(lead_ms, speed_ms / 2)
    ahead_m = gap_m(speed_ms - lead_ms, room, min(demand_ms2, friction * GRAVITY_MS2), onset_ms)
    setup = PlantSetup(speed_ms, LeadCar(ahead_m, lead_ms), friction, able)
    start_ms = onset_ms + after_ms
    short = drive_by_clock(setup, demand_ms2, onset_ms, (start_ms, start_ms + outage_ms))
    long = drive_by_clock(setup, demand_ms2, onset_ms, (start_ms, start_ms + outage_ms + longer_ms))
    assert impact_kmh(long) >= impact_kmh(short) - 1e-6


@given(speeds, rooms, demands, frictions, st.floats(0.0, 0.5), brakes, onsets)
def test_more_friction_never_raises_the_impact_speed(
    speed_ms: float,
    room: float,
    demand_ms2: float,
    friction: float,
    more: float,
    able: Brakes,
    onset_ms: int,
) -> None:
    lead = LeadCar(gap_m(speed_ms, room, min(demand_ms2, friction * GRAVITY_MS2), onset_ms))
    slippery = drive_by_clock(PlantSetup(speed_ms, lead, friction, able), demand_ms2, onset_ms)
    rough = drive_by_clock(PlantSetup(speed_ms, lead, friction + more, able), demand_ms2, onset_ms)
    assert impact_kmh(rough) <= impact_kmh(slippery) + 1e-6


@given(speeds, gaps, st.floats(0.0, 20.0), demands, onsets, st.integers(0, 3000), st.floats(0.0, 9.0))
def test_a_later_start_changes_nothing(
    speed_ms: float,
    gap_m: float,
    lead_ms: float,
    demand_ms2: float,
    onset_ms: int,
    later_ms: int,
    lead_ms2: float,
) -> None:
    """The same approach, begun farther away, with all that happens by the clock that much later."""

    def lead(begun_ms: int) -> LeadCar:
        before_m = (speed_ms - lead_ms) * begun_ms / 1000
        braking = LeadBraking(500 + begun_ms, lead_ms2, 1000)
        return LeadCar(gap_m + max(0.0, before_m), lead_ms, braking, 3.0, CutIn(begun_ms, 200))

    lead_ms = min(lead_ms, speed_ms)
    now = drive_by_clock(PlantSetup(speed_ms, lead(0)), demand_ms2, onset_ms)
    setup = PlantSetup(speed_ms, lead(later_ms))
    later = drive_by_clock(setup, demand_ms2, onset_ms + later_ms, drive_ms=DRIVE_MS + later_ms)
    assert later.collision == now.collision
    assert impact_kmh(later) == pytest.approx(impact_kmh(now), abs=1e-4)
    assert later.stop_gap_m == pytest.approx(now.stop_gap_m, abs=1e-6)


@given(speeds, gaps, demands, frictions, onsets)
def test_half_the_step_changes_the_drive_by_less_than_three_centimetres(
    speed_ms: float, gap_m: float, demand_ms2: float, friction: float, onset_ms: int
) -> None:
    setup = PlantSetup(speed_ms, LeadCar(gap_m), friction)
    whole, half = (
        drive_by_clock(setup, demand_ms2, onset_ms, step_us=step_us) for step_us in (STEP_US, STEP_US // 2)
    )
    grip_ms2 = min(demand_ms2, friction * GRAVITY_MS2)
    assert margin_m(half, grip_ms2) == pytest.approx(margin_m(whole, grip_ms2), abs=STEP_ERROR_M)


# -- with the function in the loop


@pytest.mark.parametrize(
    ("from_ms", "name"), sampled((2000, 2400, 2700, 3000), ("r152:m1-40", "r152:m1-60", "ncap:ccrm-60"))
)
def test_a_longer_silence_of_the_function_never_lowers_the_impact_speed(name: str, from_ms: int) -> None:
    """Of the impact speed this is so, not of the gap: a silence that swallows the partial braking makes the
    full one begin farther away."""
    scenario = load_scenario(name)

    def silent(for_ms: int) -> float:
        def bus(frame: Frame) -> list[Frame]:
            t_ms = frame.t_us / 1000
            return [] if frame.can_id == 0x100 and from_ms <= t_ms < from_ms + for_ms else [frame]

        driven = drive(scenario.plant, scenario.duration_ms, seed=3, policy="release", bus=bus)
        return impact_kmh(driven.result)

    impacts_kmh = [silent(for_ms) for for_ms in (0, 500, 1000, 1500)]
    assert impacts_kmh[0] == 0.0 < impacts_kmh[-1]
    assert impacts_kmh == sorted(impacts_kmh)


@settings(max_examples=settings.default.max_examples // 8)
@given(st.floats(10.0, 60.0), st.floats(0.55, 0.9), st.floats(0.0, 0.3), st.integers(0, 1000))
def test_more_friction_never_raises_the_impact_speed_of_the_function(
    speed_kmh: float, friction: float, more: float, seed: int
) -> None:
    speed_ms = speed_kmh / 3.6

    def on(rough: float) -> float:
        setup = PlantSetup(speed_ms, LeadCar(speed_ms * 4.0), rough)
        return impact_kmh(drive(setup, 10_000, seed=seed).result)

    assert on(friction + more) <= on(friction) + 0.5  # km/h: the radar's noise meets another drive

"""The plant against physics that can be worked out by hand."""

import pytest

from aftbed.vehicle.plant import (
    GRAVITY_MS2,
    Brakes,
    CutIn,
    LeadBraking,
    LeadCar,
    LeadSpeed,
    Plant,
    PlantSetup,
)


def run(plant: Plant, steps: int, demand_ms2: float) -> Plant:
    for _ in range(steps):
        plant.step(demand_ms2)
    return plant


def test_the_driver_holds_the_speed_until_braking_is_asked_for() -> None:
    plant = run(Plant(PlantSetup(20.0)), 5000, 0.0)
    assert (plant.speed_ms, plant.t_us) == (20.0, 5_000_000)
    assert not plant.result().braked
    run(plant, 1, 1.0)
    run(plant, 2000, 0.0)
    assert 19.0 < plant.speed_ms < 20.0  # coasting
    assert plant.result().braked


def test_nothing_happens_in_the_dead_time() -> None:
    plant = run(Plant(PlantSetup(20.0)), 100, 9.0)
    assert plant.acceleration_ms2 == pytest.approx(-0.12 - 0.00027 * 400, abs=1e-3)  # resistance only
    run(plant, 1, 9.0)
    assert plant.acceleration_ms2 < -0.25


def test_after_one_lag_the_brakes_give_63_percent() -> None:
    plant = run(Plant(PlantSetup(30.0)), 200, 5.0)
    resistance_ms2 = 0.12 + 0.00027 * plant.speed_ms**2
    assert -plant.acceleration_ms2 - resistance_ms2 == pytest.approx(5.0 * 0.632, abs=0.03)


@pytest.mark.parametrize("friction", [0.3, 0.9])
def test_no_tyre_gives_more_than_its_grip(friction: float) -> None:
    plant = run(Plant(PlantSetup(30.0, friction=friction)), 1000, 12.0)
    limit_ms2 = friction * GRAVITY_MS2
    assert limit_ms2 < plant.result().max_deceleration_ms2 < limit_ms2 + 0.5  # drag is not the tyres'


def test_stopping_distance() -> None:
    plant = run(Plant(PlantSetup(50 / 3.6, LeadCar(100.0))), 4000, 9.0)
    result = plant.result()
    speed_ms, grip_ms2 = 50 / 3.6, 0.9 * GRAVITY_MS2
    distance_m = speed_ms * 0.2 + speed_ms**2 / (2 * grip_ms2)  # dead time and lag, then full grip
    assert result.stop_gap_m == pytest.approx(100.0 - distance_m, abs=0.4)
    assert result.min_gap_m == result.stop_gap_m
    assert plant.stopped()


@pytest.mark.parametrize(("gap_m", "speed_ms"), [(10.0, 13.89), (10.005, 13.89), (0.001, 30.0), (7.77, 5.0)])
def test_contact_is_found_inside_the_step(gap_m: float, speed_ms: float) -> None:
    plant = run(Plant(PlantSetup(speed_ms, LeadCar(gap_m))), 3000, 0.0)
    result = plant.result()
    assert result.collision
    assert result.impact_speed_kmh == pytest.approx(speed_ms * 3.6)
    assert (result.min_gap_m, result.stop_gap_m, plant.speed_ms) == (0.0, None, 0.0)


def test_impact_speed_while_braking_is_that_of_energy() -> None:
    plant = run(Plant(PlantSetup(20.0, LeadCar(25.0), friction=0.8)), 3000, 9.0)
    braked_m = 25.0 - 20.0 * 0.2
    expected_ms = (20.0**2 - 2 * (0.8 * GRAVITY_MS2 + 0.2) * braked_m) ** 0.5
    assert plant.result().impact_speed_kmh == pytest.approx(expected_ms * 3.6, rel=0.03)


def test_the_gap_changes_by_the_mean_speeds_and_contact_is_interpolated() -> None:
    """Every step of a drive into a braking car, against the trapezoids worked out here."""
    plant = run(Plant(PlantSetup(20.0, LeadCar(30.0, 15.0, LeadBraking(0, 8.0)), friction=0.3)), 1, 9.0)
    while True:
        gap_m, ego_ms, lead_ms = plant.gap_m, plant.speed_ms, plant.lead_speed_ms
        assert gap_m is not None
        plant.step(9.0)
        if plant.collided:
            break
        closed_m = ((ego_ms + plant.speed_ms) - (lead_ms + plant.lead_speed_ms)) / 2 * 0.001
        assert plant.gap_m == pytest.approx(gap_m - closed_m, abs=1e-12)
    part = gap_m / ((ego_ms - lead_ms) * 0.001)  # of the step, before contact
    impact_ms = ego_ms - lead_ms - part * 0.001 * (0.3 * GRAVITY_MS2 + 0.12 + 0.00027 * ego_ms**2)
    assert lead_ms == 0.0
    assert plant.result().impact_speed_kmh == pytest.approx(impact_ms * 3.6, abs=2e-4)


def test_a_lead_brakes_with_its_ramp_and_stops() -> None:
    plant = Plant(PlantSetup(10.0, LeadCar(50.0, 12.0, LeadBraking(1000, 6.0, 500))))
    assert run(plant, 1000, 0.0).lead_speed_ms == 12.0
    assert run(plant, 500, 0.0).lead_speed_ms == pytest.approx(12.0 - 6.0 * 0.5 / 2, abs=0.01)
    assert run(plant, 1000, 0.0).lead_speed_ms == pytest.approx(12.0 - 1.5 - 6.0, abs=0.01)
    assert run(plant, 2000, 0.0).lead_speed_ms == 0.0


def test_a_lead_that_brakes_to_a_speed_keeps_it() -> None:
    plant = Plant(PlantSetup(10.0, LeadCar(50.0, 12.0, LeadBraking(1000, 6.0, final_ms=3.0))))
    assert run(plant, 2000, 0.0).lead_speed_ms == pytest.approx(12.0 - 6.0, abs=0.01)
    assert run(plant, 1000, 0.0).lead_speed_ms == 3.0
    assert run(plant, 2000, 0.0).lead_speed_ms == 3.0


def test_a_lead_goes_from_speed_to_speed() -> None:
    """Up, and down again before it is there."""
    speeds = (LeadSpeed(1000, 14.0, 2.0), LeadSpeed(2000, 6.0, 4.0))
    plant = Plant(PlantSetup(10.0, LeadCar(50.0, 10.0, speeds=speeds)))
    assert run(plant, 1000, 0.0).lead_speed_ms == 10.0
    assert run(plant, 1000, 0.0).lead_speed_ms == pytest.approx(12.0, abs=0.01)
    assert run(plant, 1000, 0.0).lead_speed_ms == pytest.approx(8.0, abs=0.01)
    assert run(plant, 2000, 0.0).lead_speed_ms == 6.0


def test_a_jerk_limit_makes_the_brakes_slower() -> None:
    free, limited = (
        run(Plant(PlantSetup(20.0, brakes=Brakes(jerk_max_ms3=j))), 200, 9.0) for j in (None, 20.0)
    )
    assert -limited.acceleration_ms2 < 20.0 * 0.1 + 0.3 < -free.acceleration_ms2


def test_brakes_give_no_more_than_they_can_though_the_tyres_would() -> None:
    able, laden = (
        run(Plant(PlantSetup(30.0, brakes=Brakes(deceleration_max_ms2=most))), 1000, 12.0)
        for most in (None, 6.43)
    )
    assert able.result().max_deceleration_ms2 > 0.9 * GRAVITY_MS2
    assert 6.43 < laden.result().max_deceleration_ms2 < 6.43 + 0.5
    slippery = PlantSetup(30.0, friction=0.3, brakes=Brakes(deceleration_max_ms2=6.43))
    assert run(Plant(slippery), 1000, 12.0).result().max_deceleration_ms2 < 0.3 * GRAVITY_MS2 + 0.5


@pytest.mark.parametrize("dead_time_ms", [0, 1, 50, 250])
def test_the_dead_time_is_what_it_is_said_to_be(dead_time_ms: int) -> None:
    """Nothing but resistance for so long; all that was asked for in the next step, without a lag."""
    plant = run(Plant(PlantSetup(20.0, brakes=Brakes(dead_time_ms, lag_ms=0))), dead_time_ms, 5.0)
    assert -plant.acceleration_ms2 < 0.3
    assert -run(plant, 1, 5.0).acceleration_ms2 == pytest.approx(5.0 + 0.12 + 0.108, abs=0.01)


@pytest.mark.parametrize("lag_ms", [50, 200])
def test_after_one_lag_of_any_length_the_brakes_give_63_percent(lag_ms: int) -> None:
    plant = run(Plant(PlantSetup(30.0, brakes=Brakes(0, lag_ms))), lag_ms, 5.0)
    resistance_ms2 = 0.12 + 0.00027 * plant.speed_ms**2
    assert -plant.acceleration_ms2 - resistance_ms2 == pytest.approx(5.0 * 0.632, abs=0.05)


def test_a_car_beside_our_lane_is_passed_and_not_hit() -> None:
    plant = run(Plant(PlantSetup(10.0, LeadCar(20.0, lateral_m=3.5))), 1999, 0.0)
    assert plant.gap_m == pytest.approx(0.01)
    assert plant.ttc_s() == pytest.approx(0.001)
    run(plant, 2, 0.0)
    assert (plant.gap_m, plant.ttc_s(), plant.speed_ms) == (None, None, 10.0)
    result = run(plant, 500, 9.0).result()
    assert (result.collision, result.min_gap_m, result.stop_gap_m) == (False, None, None)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_car_cuts_in_evenly_and_its_gap_counts_from_when_it_is_in_the_way(side: float) -> None:
    lead = LeadCar(30.0, 10.0, lateral_m=3.6 * side, cut_in=CutIn(1000, 2000))
    plant = run(Plant(PlantSetup(12.0, lead)), 1000, 0.0)
    assert plant.lateral_m == 3.6 * side
    assert run(plant, 1000, 0.0).lateral_m == pytest.approx(1.8 * side)
    assert run(plant, 500, 0.0).lateral_m == pytest.approx(0.9 * side)
    assert run(plant, 700, 0.0).lateral_m == 0.0
    assert plant.result().min_gap_m == plant.gap_m == pytest.approx(30.0 - 3.2 * 2.0)


def test_a_car_that_has_cut_in_is_hit_like_any_other() -> None:
    lead = LeadCar(10.0, 10.0, lateral_m=3.0, cut_in=CutIn(0, 500))
    result = run(Plant(PlantSetup(20.0, lead)), 2000, 0.0).result()
    assert result.collision
    assert result.impact_speed_kmh == pytest.approx(36.0)


def test_time_to_collision() -> None:
    assert Plant(PlantSetup(10.0, LeadCar(20.0))).ttc_s() == 2.0
    assert Plant(PlantSetup(10.0, LeadCar(20.0, 10.0))).ttc_s() is None
    assert Plant(PlantSetup(10.0)).ttc_s() is None


def test_an_empty_road_has_no_gaps() -> None:
    result = run(Plant(PlantSetup(10.0)), 2000, 9.0).result()
    assert (result.min_gap_m, result.stop_gap_m, result.collision) == (None, None, False)

"""Scenario files are read strictly, and the shipped ones come to what they say: in the closed loop, without
sockets. The speeds are those of UN R152 and beyond."""

from pathlib import Path
from random import Random

import pytest
from puredrive import as_it_is, drive
from sampling import every, sampled

from aftbed.core.errors import ConfigError
from aftbed.vehicle.aeb.messages import STAGE_FULL, STAGE_NONE, STAGE_WARN
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.ecus import Fallback
from aftbed.vehicle.plant import (
    Brakes,
    CutIn,
    Driver,
    LeadBraking,
    LeadCar,
    LeadSpeed,
    PlantSetup,
    VehicleResult,
)
from aftbed.vehicle.scenarios.library import load_scenario, scenario_names
from aftbed.vehicle.scenarios.scenario import SlowEnd, broken_expectations

pytestmark = pytest.mark.simulation

NAMES = ["ccrb-50-12m", "ccrb-50-40m", "ccrm-50", "ccrs-20", "ccrs-42", "ccrs-50", "free-drive"]


def standing(speed_kmh: float, ttc_s: float = 4.0) -> PlantSetup:
    return PlantSetup(speed_kmh / 3.6, LeadCar(speed_kmh / 3.6 * ttc_s))


# -- the shipped scenarios


def test_these_are_shipped() -> None:
    assert scenario_names() == NAMES


@pytest.mark.parametrize(("name", "seed"), sampled(NAMES, (1, 2)))
def test_an_undisturbed_drive_comes_to_what_is_expected(name: str, seed: int) -> None:
    scenario = load_scenario(name)
    driven = drive(scenario.plant, scenario.duration_ms, seed=seed)
    assert broken_expectations(scenario, driven.result) == []
    if scenario.expect.outcome == "no_braking":
        assert {decision.output.stage for decision in driven.decisions} == {STAGE_NONE}
    else:
        assert driven.result.max_deceleration_ms2 > 5.0


def test_a_car_without_brakes_meets_no_expectation_but_that_of_the_empty_road() -> None:
    """The expectations can fail."""
    for name in NAMES:
        scenario = load_scenario(name)
        driven = drive(
            scenario.plant, scenario.duration_ms, bus=lambda frame: [frame] * (frame.can_id != 0x100)
        )
        assert bool(broken_expectations(scenario, driven.result)) == (name != "free-drive")


def test_the_same_seed_gives_the_same_frames() -> None:
    scenario = load_scenario("ccrs-50")
    first, again, other = (drive(scenario.plant, 3000, seed=seed).frames for seed in (5, 5, 6))
    assert first == again != other


# -- UN R152: warned at least 0.8 s before full braking; no impact up to 42 km/h, limits above


@pytest.mark.parametrize(
    ("speed_kmh", "impact_kmh_max"),
    every(2, [(10, 0), (20, 0), (30, 0), (40, 0), (42, 0), (45, 15), (50, 25), (55, 30), (60, 35), (80, 60)]),
)
def test_car_to_standing_car(speed_kmh: float, impact_kmh_max: float) -> None:
    driven = drive(standing(speed_kmh), 10_000)
    impact_kmh = driven.result.impact_speed_kmh or 0.0
    assert impact_kmh <= impact_kmh_max
    warned_s, full_s = driven.first_s(STAGE_WARN), driven.first_s(STAGE_FULL)
    assert warned_s is not None
    assert full_s is not None
    assert full_s - warned_s >= 0.8
    assert max(decision.output.deceleration_ms2 for decision in driven.decisions) >= 5.0
    if impact_kmh == 0.0:
        assert driven.result.stop_gap_m is not None
        assert 0.5 <= driven.result.stop_gap_m <= 10.0


@pytest.mark.parametrize(("speed_kmh", "lead_kmh"), every(2, [(30, 20), (60, 20), (60, 40), (80, 50)]))
def test_car_to_moving_car(speed_kmh: float, lead_kmh: float) -> None:
    closing_ms = (speed_kmh - lead_kmh) / 3.6
    driven = drive(PlantSetup(speed_kmh / 3.6, LeadCar(closing_ms * 4.0, lead_kmh / 3.6)), 10_000)
    assert not driven.result.collision
    assert driven.result.stop_gap_m is None, "braked to a stop behind a car that drives on"


@pytest.mark.parametrize("seed", every(2, range(4)))
def test_following_another_car_is_no_reason_to_brake(seed: int) -> None:
    """At 0.9 s of headway, the car ahead easing off and going on."""
    gentle = LeadBraking(2000, 0.5, 1000)
    driven = drive(PlantSetup(50 / 3.6, LeadCar(12.5, 50 / 3.6)), 10_000, seed=seed)
    assert {decision.output.stage for decision in driven.decisions} == {STAGE_NONE}
    driven = drive(PlantSetup(50 / 3.6, LeadCar(30.0, 50 / 3.6, gentle)), 6_000, seed=seed)
    assert not driven.result.braked


# -- a bus with faults


def test_one_frame_in_ten_lost_or_damaged_still_stops_the_car() -> None:
    random = Random(11)

    def bad_bus(frame: Frame) -> list[Frame]:
        match random.randrange(30):
            case 0:
                return []
            case 1:
                return [frame, frame]
            case 2:
                return [Frame(frame.t_us, frame.can_id, frame.data[:-1] + bytes([frame.data[-1] ^ 1]))]
            case _:
                return [frame]

    driven = drive(standing(50), 9000, bus=bad_bus)
    assert driven.result.stop_gap_m is not None
    assert driven.result.stop_gap_m > 0.5
    assert {"checksum", "repeated"} <= set(driven.gateway.counts.refused)


@pytest.mark.parametrize(("policy", "stops"), [("latch", True), ("hold", True), ("release", False)])
def test_a_function_that_falls_silent_in_full_braking(policy: str, stops: bool) -> None:
    assert policy in ("latch", "hold", "release")
    silent_us = 3_100_000  # full braking since about 2.9 s

    def bus(frame: Frame) -> list[Frame]:
        return [] if frame.can_id == 0x100 and frame.t_us >= silent_us else as_it_is(frame)

    driven = drive(standing(50), 9000, policy=policy, bus=bus)  # type: ignore[arg-type]  # checked above
    assert (driven.result.stop_gap_m is not None) == stops
    assert driven.result.collision == (not stops)
    if policy == "latch":
        assert driven.brake.fallback is Fallback.LATCH


def test_a_radar_that_is_not_believed_in_full_braking_does_not_end_it() -> None:
    def bus(frame: Frame) -> list[Frame]:
        if frame.can_id == 0x130 and frame.t_us >= 3_100_000:
            return [Frame(frame.t_us, frame.can_id, bytes(8))]
        return [frame]

    driven = drive(standing(50), 9000, bus=bus)
    assert driven.result.stop_gap_m is not None
    assert driven.brake.refused == 1, "requests have to go on"


# -- files


GOOD = """
description: a test
duration_s: 5
ego: {speed_kmh: 36}
lead: {gap_m: 40, speed_kmh: 18, braking: {after_s: 1, deceleration_ms2: 6, ramp_s: 0.5}}
road: {friction: 0.5}
brakes: {jerk_max_ms3: 30}
driver: {reaction_s: 1.2, deceleration_ms2: 4}
expect: {outcome: impact, impact_speed_kmh_max: 20}
"""


def write(folder: Path, text: str) -> str:
    path = folder / "mine.yaml"
    path.write_text(text)
    return str(path)


def test_a_file_becomes_a_scenario_in_si_units(tmp_path: Path) -> None:
    scenario = load_scenario(write(tmp_path, GOOD))
    lead = LeadCar(40.0, 5.0, LeadBraking(1000, 6.0, 500))
    assert scenario.plant == PlantSetup(10.0, lead, 0.5, Brakes(jerk_max_ms3=30.0), Driver(1200, 4.0))
    assert (scenario.name, scenario.duration_ms, scenario.expect.outcome) == ("mine", 5000, "impact")


def test_what_is_left_out_has_the_values_of_the_plant(tmp_path: Path) -> None:
    text = GOOD.replace(", ramp_s: 0.5", "")
    for key in ("road", "brakes", "driver"):
        text = "\n".join(line for line in text.splitlines() if not line.startswith(key))
    scenario = load_scenario(write(tmp_path, text))
    assert scenario.plant == PlantSetup(10.0, LeadCar(40.0, 5.0, LeadBraking(1000, 6.0, 1000)))
    assert scenario.plant.brakes == Brakes(dead_time_ms=100, lag_ms=100)


def test_brakes_and_the_way_into_the_lane_are_settable(tmp_path: Path) -> None:
    text = GOOD.replace(
        "brakes: {jerk_max_ms3: 30}",
        "brakes: {dead_time_s: 0.05, lag_s: 0, jerk_max_ms3: 30, deceleration_max_ms2: 6.43}",
    ).replace("gap_m: 40,", "gap_m: 40, lateral_m: -3.5, cut_in: {after_s: 1, over_s: 2},")
    scenario = load_scenario(write(tmp_path, text))
    assert scenario.plant.brakes == Brakes(50, 0, 30.0, 6.43)
    assert scenario.plant.lead is not None
    assert (scenario.plant.lead.lateral_m, scenario.plant.lead.cut_in) == (-3.5, CutIn(1000, 2000))


def test_a_lead_may_brake_to_a_speed_and_a_drive_end_at_one(tmp_path: Path) -> None:
    text = GOOD.replace("ramp_s: 0.5", "ramp_s: 0.5, to_kmh: 3.6")
    scenario = load_scenario(write(tmp_path, f"{text}ends: {{below_kmh: 18, below_lead_kmh: 3.6}}\n"))
    assert scenario.plant.lead is not None
    assert scenario.plant.lead.braking == LeadBraking(1000, 6.0, 500, 1.0)
    assert scenario.slow_end == SlowEnd(1000, 5.0, 1.0)


SPEEDS = "speeds: [{after_s: 1, to_kmh: 36, rate_ms2: 2}, {after_s: 3, to_kmh: 0, rate_ms2: 4}]"


def test_a_lead_may_change_its_speed_more_than_once(tmp_path: Path) -> None:
    braking = GOOD[GOOD.index("braking:") : GOOD.index("}", GOOD.index("braking:")) + 1]
    scenario = load_scenario(write(tmp_path, GOOD.replace(braking, SPEEDS)))
    assert scenario.plant.lead is not None
    assert scenario.plant.lead.speeds == (LeadSpeed(1000, 10.0, 2.0), LeadSpeed(3000, 0.0, 4.0))
    with pytest.raises(ConfigError, match="lead: found both, allowed is one of braking, speeds"):
        load_scenario(write(tmp_path, GOOD.replace(braking, f"{braking}, {SPEEDS}")))
    backwards = SPEEDS.replace("after_s: 3", "after_s: 1")
    with pytest.raises(ConfigError, match=r"lead\.speeds: found \[1\.0, 1\.0\], allowed is one after"):
        load_scenario(write(tmp_path, GOOD.replace(braking, backwards)))


@pytest.mark.parametrize(
    ("ends", "reason"),
    [
        ("{after_s: 1}", "ends: found none of them, allowed is below_kmh, below_lead_kmh or both"),
        ("{below_kmh: 37}", "ends.below_kmh: found 37, allowed is at most ego.speed_kmh, 36"),
        ("{below_kmh: 201}", "ends.below_kmh: found 201, allowed is a number at least 0 and at most 200"),
    ],
)
def test_an_end_that_cannot_be_is_refused(ends: str, reason: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as error:
        load_scenario(write(tmp_path, f"{GOOD}ends: {ends}\n"))
    assert reason in str(error.value)


def test_an_end_below_a_car_that_is_not_there_is_refused(tmp_path: Path) -> None:
    text = "".join(line for line in GOOD.splitlines(keepends=True) if not line.startswith("lead"))
    with pytest.raises(ConfigError, match=r"ends\.below_lead_kmh: found without lead"):
        load_scenario(write(tmp_path, f"{text}ends: {{below_lead_kmh: 1}}\n"))


def test_a_gap_may_be_given_as_time_to_collision(tmp_path: Path) -> None:
    scenario = load_scenario(write(tmp_path, GOOD.replace("gap_m: 40", "ttc_s: 4")))
    assert scenario.plant.lead is not None
    assert scenario.plant.lead.gap_m == pytest.approx(20.0)


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("duration_s: 5\n", "", "key 'duration_s' is missing"),
        (
            "duration_s: 5",
            "duration_s: 0",
            "duration_s: found 0, allowed is a number more than 0 and at most 3600",
        ),
        ("speed_kmh: 36", "speed_mph: 36", "ego: unknown key 'speed_mph'; did you mean 'speed_kmh'"),
        (
            "speed_kmh: 36",
            "speed_kmh: 36 km/h",
            "ego.speed_kmh: found '36 km/h', allowed is a number at least 0",
        ),
        ("speed_kmh: 36", "speed_kmh: .nan", "ego.speed_kmh: found nan, allowed is a number"),
        ("speed_kmh: 36", "speed_kmh: true", "ego.speed_kmh: found True, allowed is a number"),
        ("gap_m: 40", "gap_m: -40", "lead.gap_m: found -40, allowed is a number at least 0 and at most 1000"),
        ("gap_m: 40", "gap_m: 0", "lead.gap_m: found 0, allowed is more than 0"),
        ("gap_m: 40", "gap_m: 40, ttc_s: 4", "lead: found both, allowed is one of gap_m, ttc_s"),
        ("gap_m: 40, ", "", "lead: found none of them, allowed is one of gap_m, ttc_s"),
        ("gap_m: 40, speed_kmh: 18", "ttc_s: 4, speed_kmh: 36", "lead.ttc_s: found 4.0, allowed is gap_m"),
        (
            "ramp_s: 0.5",
            "to_kmh: 18",
            "lead.braking.to_kmh: found 18, allowed is less than lead.speed_kmh, 18",
        ),
        ("after_s: 1", "after: 1", "lead.braking: unknown key 'after'; did you mean 'after_s'"),
        ("outcome: impact", "outcome: crash", "expect.outcome: found 'crash', allowed is one of impact, no_"),
        (
            "speed_kmh: 36",
            "speed_kmh: 201",
            "ego.speed_kmh: found 201, allowed is a number at least 0 and at most 200",
        ),
        (
            "speed_kmh: 18",
            "speed_kmh: 250",
            "lead.speed_kmh: found 250, allowed is a number at least 0 and at most 200",
        ),
        (
            "jerk_max_ms3: 30",
            "dead_time_s: 3",
            "brakes.dead_time_s: found 3, allowed is a number at least 0 and at most 2",
        ),
        ("jerk_max_ms3: 30", "lag_ms: 100", "brakes: unknown key 'lag_ms'; did you mean 'lag_s'"),
        (
            "jerk_max_ms3: 30",
            "deceleration_max_ms2: 0",
            "brakes.deceleration_max_ms2: found 0, allowed is a number more than 0 and at most 12 or nothing",
        ),
        (
            "gap_m: 40,",
            "gap_m: 40, lateral_m: 11,",
            "lead.lateral_m: found 11, allowed is a number at least -10 and at most 10",
        ),
        (
            "gap_m: 40,",
            "gap_m: 40, cut_in: {after_s: 1, over_s: 2},",
            "lead.cut_in: found without lateral_m, allowed is a car beside our lane",
        ),
        (
            "reaction_s: 1.2",
            "reaction_s: -1",
            "driver.reaction_s: found -1, allowed is a number at least 0 and at most 10",
        ),
        ("reaction_s: 1.2, ", "", "driver: key 'reaction_s' is missing"),
        ("friction: 0.5", "friction: [1]", "road.friction: found [1], allowed is a number"),
        ("ego: {speed_kmh: 36}", "ego: 36", "ego: found 36, allowed is keys and values: speed_kmh"),
        ("description: a test", "description: {", "line "),
        (GOOD, "- 1\n", "found [1], allowed is keys and values: description"),
        (GOOD, "", "key 'description' is missing"),
        (GOOD, "? [a]\n: 1\n", "line 1, column 3: "),
        ("description: a test", "description: a test\n7: 1", "allowed is"),
        ("expect:", "expectation:", "unknown key 'expectation'; did you mean 'expect'"),
    ],
)
def test_a_bad_file_is_refused(tmp_path: Path, old: str, new: str, reason: str) -> None:
    assert old in GOOD
    path = write(tmp_path, GOOD.replace(old, new, 1))
    with pytest.raises(ConfigError) as error:
        load_scenario(path)
    assert str(error.value).startswith(f"{path}: ")
    assert reason in str(error.value)


def test_bytes_that_are_no_text_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "mine.yml"
    path.write_bytes(b"\xff\xfe\x00\xd8")
    with pytest.raises(ConfigError, match=r"mine\.yml: not YAML"):
        load_scenario(str(path))


def test_names_and_paths_that_lead_nowhere(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="unknown scenario 'ccrs-5'; did you mean 'ccrs-50'"):
        load_scenario("ccrs-5")
    with pytest.raises(ConfigError, match=r"none\.yaml: cannot be read: No such file"):
        load_scenario(str(tmp_path / "none.yaml"))


@pytest.mark.parametrize(
    ("outcome", "result", "reasons"),
    [
        (
            "stop",
            VehicleResult(False, None, 0.4, 0.4, 9.0, True),
            ["stopped at 0.40 m, at least 0.50 m expected"],
        ),
        ("stop", VehicleResult(False, None, 9.0, None, 0.0, False), ["the car did not stop, expected stop"]),
        ("stop", VehicleResult(True, 7.25, 0.0, None, 0.0, True), ["collision at 7.2 km/h, expected stop"]),
        ("no_collision", VehicleResult(False, None, 9.0, None, 0.0, True), []),
        (
            "no_braking",
            VehicleResult(False, None, 9.0, None, 0.0, True),
            ["the car braked, expected no_braking"],
        ),
        ("impact", VehicleResult(True, 20.0, 0.0, None, 9.0, True), []),
        (
            "impact",
            VehicleResult(True, 20.1, 0.0, None, 9.0, True),
            ["impact at 20.1 km/h, allowed are 20.0"],
        ),
    ],
)
def test_expectations(tmp_path: Path, outcome: str, result: VehicleResult, reasons: list[str]) -> None:
    text = GOOD.replace("outcome: impact", f"outcome: {outcome}, stop_gap_m_min: 0.5")
    assert broken_expectations(load_scenario(write(tmp_path, text)), result) == reasons

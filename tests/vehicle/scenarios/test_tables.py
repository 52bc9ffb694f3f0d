"""The published tables: what they hold, how they judge, and that the bare function passes them."""

import re
from pathlib import Path

import msgspec
import pytest
import yaml
from sampling import every

import aftbed
from aftbed.core.errors import ConfigError
from aftbed.runtime.sim.world import Setup, simulate
from aftbed.vehicle.can.dbc_file import load_dbc
from aftbed.vehicle.drive_virtual import VirtualCar
from aftbed.vehicle.plant import KMH_PER_MS, Driver, VehicleResult
from aftbed.vehicle.scenarios.library import load_scenario
from aftbed.vehicle.scenarios.scenario import broken_expectations
from aftbed.vehicle.scenarios.tables import Case, broken, cases, colour, group_names, table_names, title

CODEC = load_dbc()
EVERY_CASE = [case for table in table_names() for case in cases(table)]
FASTEST = [cases(table, group)[-1] for table in table_names() for group in group_names(table)]
R152 = cases("r152")
STOPPED = VehicleResult(False, None, 2.0, 2.0, 8.8, True, warning_s=1.0, demand_max_ms2=9.0)
HIT = VehicleResult(True, 25.0, 0.0, None, 8.8, True, warning_s=1.0, demand_max_ms2=9.0)
FREE = VehicleResult(False, None, None, None, 0.0, False)


def drive_bare(scenario: str, seed: int) -> VehicleResult:
    """What the car comes to with the bare function and no fault."""
    result = simulate(Setup("none", scenario=scenario, seed=seed)).vehicle
    assert result is not None
    return result


def case_of(name: str) -> Case:
    return next(case for case in EVERY_CASE if case.name == name)


# -- what they hold


def limits(group: str) -> dict[float, float]:
    return {case.speed_kmh: case.limit_kmh for case in cases("r152", group)}


def test_the_limits_of_r152_are_those_of_the_regulation() -> None:
    """The 00 series, 5.2.1.4, written down here a second time."""
    none = {10: 0, 20: 0, 30: 0}
    high = {45: 15, 50: 25, 55: 30, 60: 35}
    assert limits("m1") == limits("n1") == none | {40: 0, 42: 0} | high
    assert limits("m1-laden") == none | {40: 0, 42: 10} | high
    assert limits("n1-laden") == none | {38: 0, 40: 10, 42: 15, 45: 20, 50: 30, 55: 35, 60: 40}
    assert limits("m1-moving") == limits("n1-moving") == none | {40: 0, 42: 0}
    assert limits("m1-moving-laden") == none | {40: 0}
    assert limits("n1-moving-laden") == none | {38: 0}
    assert {(case.warning_s_min, case.demand_ms2_min) for case in R152} == {(0.8, 5.0)}


def test_the_rows_of_euro_ncap_are_those_of_the_protocol() -> None:
    speeds = {group: [case.speed_kmh for case in cases("ncap", group)] for group in group_names("ncap")}
    assert speeds["ccrs"] == list(range(10, 51, 5))
    assert speeds["ccrs-warning"] == list(range(55, 81, 5))
    assert speeds["ccrm"] == list(range(30, 81, 5))
    for gap_m in (12, 40):
        for deceleration_ms2 in (2, 6):
            lead = load_scenario(f"ncap:ccrb-{gap_m}m-{deceleration_ms2}-50").plant.lead
            assert lead is not None
            assert lead.braking is not None
            assert (lead.gap_m, lead.braking.deceleration_ms2, lead.braking.ramp_ms) == (
                gap_m,
                deceleration_ms2,
                1000,
            )
    assert load_scenario("ncap:ccrs-warning-80").plant.driver == Driver(1200, 4.0)
    assert {case.limit_kmh for case in cases("ncap")} == {0.0}


@pytest.mark.parametrize("case", EVERY_CASE, ids=lambda case: case.name)
def test_every_row_is_a_scenario_that_asks_for_what_the_row_says(case: Case) -> None:
    scenario = load_scenario(case.name)
    plant, lead = scenario.plant, scenario.plant.lead
    assert scenario.name == case.name
    assert plant.friction == 0.9
    assert case.source
    relative_ms = plant.speed_ms - (lead.speed_ms if lead and case.table == "r152" else 0.0)
    assert relative_ms * KMH_PER_MS == pytest.approx(case.speed_kmh)
    if case.table == "r152":
        assert lead is not None
        assert lead.gap_m / relative_ms >= 3.999, "the approach begins at a time to collision of 4 s"
        assert (plant.brakes.deceleration_max_ms2 is not None) == ("laden" in case.group)
    assert (scenario.expect.outcome == "no_braking") == (case.table == "negative")
    assert scenario.expect.impact_speed_kmh_max == case.limit_kmh


def test_names_are_unique_and_tables_have_titles() -> None:
    assert table_names() == ["ncap", "negative", "r152"]
    assert len({case.name for case in EVERY_CASE}) == len(EVERY_CASE) > 80
    assert all(title(table) for table in table_names())
    assert cases("r152", "m1") == tuple(case for case in R152 if case.group == "m1")


def test_no_number_of_a_table_is_written_into_the_code() -> None:
    """Each group says where its rows are from, in the file itself."""
    folder = Path(aftbed.__file__).parent / "vehicle" / "cases"
    for path in folder.glob("*.yaml"):
        groups = yaml.safe_load(path.read_text())["groups"]
        assert all(re.search(r"R152|Euro NCAP|ours", group["source"]) for group in groups.values()), path


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("r152:m1-61", r"unknown case 'r152:m1-61' \(of 55 in table r152, the nearest: .*r152:m1-60"),
        ("ncap:", r"unknown case 'ncap:' \(of "),
        ("r125:m1-60", r"unknown table 'r125'; did you mean 'r152'\? \(one of: ncap, negative, r152\)"),
        (":", r"unknown table ''"),
    ],
)
def test_a_row_that_does_not_exist_is_refused_with_the_nearest(name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_scenario(name)


def test_a_table_or_group_that_does_not_exist_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"unknown table 'r153'; did you mean 'r152'"):
        cases("r153")
    with pytest.raises(ConfigError, match=r"unknown group of table r152 'm2'; did you mean 'm1'"):
        cases("r152", "m2")


# -- what they judge


@pytest.mark.parametrize(
    ("name", "result", "reasons"),
    [
        ("r152:m1-60", STOPPED, []),
        ("r152:m1-50", HIT, []),
        ("r152:m1-45", HIT, ["impact at 25.0 km/h, allowed is at most 15"]),
        ("r152:m1-10", HIT, ["impact at 25.0 km/h, allowed is none"]),
        (
            "r152:m1-10",
            msgspec.structs.replace(HIT, impact_speed_kmh=0.0),
            ["impact at 0.0 km/h, allowed is none"],
        ),
        (
            "r152:m1-60",
            msgspec.structs.replace(STOPPED, warning_s=0.79),
            ["warned 0.79 s before braking, at least 0.8 s are due"],
        ),
        (
            "r152:m1-60",
            msgspec.structs.replace(STOPPED, demand_max_ms2=4.0),
            ["asked for 4.0 m/s2, at least 5 are due"],
        ),
        ("r152:m1-60", FREE, ["asked for 0.0 m/s2, at least 5 are due"]),
        ("negative:free-drive-80", FREE, []),
        (
            "negative:free-drive-80",
            STOPPED,
            ["asked for 9.0 m/s2, allowed is at most 0"],
        ),
    ],
)
def test_a_drive_is_judged_by_its_row(name: str, result: VehicleResult, reasons: list[str]) -> None:
    assert broken(case_of(name), result) == reasons


@pytest.mark.parametrize(
    ("impact_kmh", "name"),
    [
        (0.0, "green"),
        (4.99, "green"),
        (5.0, "yellow"),
        (14.99, "yellow"),
        (15.0, "orange"),
        (30.0, "brown"),
        (40.0, "red"),
        (80.0, "red"),
    ],
)
def test_colours(impact_kmh: float, name: str) -> None:
    assert colour(impact_kmh) == name


# -- what the bare function comes to


def check_bare(case: Case, seed: int) -> None:
    result = drive_bare(case.name, seed)
    assert broken(case, result) == []
    assert broken_expectations(load_scenario(case.name), result) == []
    if case.table == "negative":
        assert (result.braked, result.warning_s) == (False, None)


@pytest.mark.parametrize("case", every(2, cases("r152", "m1")), ids=lambda case: case.name)
def test_the_bare_function_passes_r152_in_running_order(case: Case) -> None:
    check_bare(case, seed=1)


@pytest.mark.parametrize("case", FASTEST[::4], ids=lambda case: case.name)  # deep: every row
def test_the_bare_function_passes_the_fastest_row_of_a_group(case: Case) -> None:
    check_bare(case, seed=2)


@pytest.mark.deep
@pytest.mark.parametrize("case", EVERY_CASE, ids=lambda case: case.name)
def test_the_bare_function_passes_every_row_whatever_the_noise(case: Case) -> None:
    for seed in range(10):
        check_bare(case, seed)


@pytest.mark.parametrize("name", ["r152:m1-42", "r152:m1-laden-60", "ncap:ccrm-80", "ncap:ccrb-12m-6-50"])
def test_without_brakes_no_row_is_passed(name: str) -> None:
    """The rows can fail: nothing of the function reaches the brakes."""
    car = VirtualCar(load_scenario(name), codec=CODEC)
    now_ns = 0
    while car.end is None:
        now_ns += 20_000_000
        car.advance(now_ns)
    assert broken(case_of(name), car.result()) != []

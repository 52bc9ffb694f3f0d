"""An OpenSCENARIO file becomes scenarios with the same drive."""

from pathlib import Path

import pytest
from puredrive import drive
from xoscfiles import (
    EGO_PLACE,
    LEAD_BRAKES,
    LEAD_SPEED,
    PLACE,
    RATE,
    SLOW_LEAD,
    STOP_12_S,
    changed,
    entity_condition,
    imported,
    refused,
)

from aftbed.interop.openscenario.importer import (
    ImportedFile,
    ImportOptions,
    import_scenario,
    write,
)
from aftbed.interop.openscenario.storyboard import ImportedDrive
from aftbed.runtime.sim.world import Setup, simulate
from aftbed.vehicle.plant import LeadBraking, LeadCar
from aftbed.vehicle.scenarios.library import load_scenario
from aftbed.vehicle.scenarios.scenario import Scenario


def only_drive(found: ImportedFile) -> ImportedDrive:
    (variation,) = found.variations
    return variation.drive


def scenario(found: ImportedFile, folder: Path) -> Scenario:
    (path,) = write(found, folder, force=False)
    return load_scenario(str(path))


# -- what a file becomes


def test_the_car_ahead_brakes(tmp_path: Path) -> None:
    found = scenario(imported(LEAD_BRAKES), tmp_path)
    assert found.name == "lead_brakes"
    assert found.description == "the car ahead brakes"
    assert found.duration_ms == 12_000
    assert found.plant.speed_ms == pytest.approx(50 / 3.6)
    assert found.plant.lead == LeadCar(40.0, found.plant.speed_ms, LeadBraking(1000, 6.0, 0))
    assert found.plant.friction == 0.9
    assert found.expect.outcome == "no_collision"


def test_a_slow_car_ahead_of_a_catalog_in_the_world_on_a_wet_road(tmp_path: Path) -> None:
    wanted = ImportOptions(ego="Host", expect="no_collision")
    found = scenario(import_scenario(SLOW_LEAD, None, wanted), tmp_path)
    assert found.plant.speed_ms == pytest.approx(15)
    assert found.plant.lead is not None
    # 60 m between the axles, 1.5 + 5.0 / 2 in front of the ego's, 4 / 2 - 1.2 behind the other one's
    assert found.plant.lead.gap_m == pytest.approx(60 - 4.0 - 0.8)
    assert found.plant.lead.speed_ms == pytest.approx(5)
    assert found.plant.lead.braking is None
    assert found.plant.friction == pytest.approx(0.72)
    assert found.duration_ms == 30_000, "no StopTrigger says it"


def test_an_imported_scenario_drives_and_stops(tmp_path: Path) -> None:
    wanted = ImportOptions(expect="stop")
    (path,) = write(import_scenario(LEAD_BRAKES, None, wanted), tmp_path, force=False)
    result = simulate(Setup("none", seed=1, scenario=str(path))).vehicle
    assert result is not None
    assert not result.collision
    assert result.stop_gap_m is not None
    assert result.stop_gap_m > 0.5
    again = drive(load_scenario(str(path)).plant, 12_000).result
    assert again.stop_gap_m == pytest.approx(result.stop_gap_m, abs=0.5)


def test_one_car_alone_is_a_free_drive(tmp_path: Path) -> None:
    text = LEAD_BRAKES.read_text()
    for begin, end in (
        ('<ScenarioObject name="Lead">', "</ScenarioObject>"),
        ('<Private entityRef="Lead">', "</Private>"),
        ("<Story name", "</Story>"),
    ):
        start = text.index(begin)
        text = text[:start] + text[text.index(end, start) + len(end) :]
    path = tmp_path / "alone.xosc"
    path.write_text(text)
    assert only_drive(imported(path)).lead is None


def test_used_and_ignored_elements_have_their_lines() -> None:
    found = imported(LEAD_BRAKES)
    lines = LEAD_BRAKES.read_text().splitlines()
    places = [(one.line, one.element) for one in found.taken]
    places += [(one.line, one.element) for one in found.ignored]
    for line, element in places:
        assert f"<{element}" in lines[line - 1]
    assert [one.meaning for one in found.taken] == [
        "Ego drives at 50 km/h",
        "Lead drives at 50 km/h",
        "Lead is 40 m ahead, bumper to bumper",
        "met at 0 s",
        "met at 1 s",
        "Lead brakes at 6 m/s2 from 1 s on",
        "the drive ends at 12 s",
    ]
    assert [one.element for one in found.ignored] == (
        ["CatalogLocations", "LogicFile", "SceneGraphFile", "Performance", "Axles", "Performance", "Axles"]
        + ["Properties", "AppearanceAction", "StartTrigger"]
    )


# -- the ways to say a speed, a deceleration and a place


@pytest.mark.parametrize(
    ("dynamics", "deceleration_ms2"),
    [
        ('dynamicsDimension="rate" value="6"', 6.0),
        ('dynamicsDimension="rate" value="-6"', 6.0),
        ('dynamicsDimension="time" value="2.5"', 50 / 3.6 / 2.5),
        ('dynamicsDimension="distance" value="20"', (50 / 3.6) ** 2 / 40),
    ],
)
def test_each_dimension_of_a_change_of_speed(dynamics: str, deceleration_ms2: float, tmp_path: Path) -> None:
    path = changed(tmp_path, (RATE, f'<SpeedActionDynamics dynamicsShape="linear" {dynamics}/>'))
    lead = only_drive(imported(path)).lead
    assert lead is not None
    assert lead.braking is not None
    assert lead.braking.rate_ms2 == pytest.approx(deceleration_ms2)


@pytest.mark.parametrize(
    ("target", "speed_kmh"),
    [
        ('<AbsoluteTargetSpeed value="10"/>', 36.0),
        (LEAD_SPEED.replace('value="0"', 'value="-5"'), 32.0),
        (LEAD_SPEED.replace('value="0"', 'value="0.5"').replace("delta", "factor"), 25.0),
    ],
)
def test_each_way_to_say_a_speed(target: str, speed_kmh: float, tmp_path: Path) -> None:
    lead = only_drive(imported(changed(tmp_path, (LEAD_SPEED, target)))).lead
    assert lead is not None
    assert lead.speed_ms == pytest.approx(speed_kmh / 3.6)


@pytest.mark.parametrize(
    ("ego", "lead"),
    [
        (EGO_PLACE, '<LanePosition roadId="1" laneId="-1" s="50"/>'),
        (EGO_PLACE, '<LanePosition roadId="1" laneId="-1" s="50"><Orientation h="0"/></LanePosition>'),
        (EGO_PLACE, '<RelativeLanePosition entityRef="Ego" dLane="0" dsLane="30" offset="0"/>'),
        (EGO_PLACE, '<RelativeRoadPosition entityRef="Ego" ds="30" dt="0"/>'),
        (EGO_PLACE, '<RelativeObjectPosition entityRef="Ego" dx="30" dy="0"/>'),
        ('<WorldPosition x="1" y="2" z="5"/>', '<RelativeObjectPosition entityRef="Ego" dx="30" dy="0"/>'),
        ('<RoadPosition roadId="7" s="3" t="-1.75"/>', '<RoadPosition roadId="7" s="33" t="-1.75"/>'),
        (
            '<WorldPosition x="1" y="2" h="3.141592653589793"/>',
            '<WorldPosition x="-29" y="2" h="-3.1415926"/>',
        ),
        ('<WorldPosition x="1" y="2"/>', '<RelativeWorldPosition entityRef="Ego" dx="30" dy="0"/>'),
        (
            '<WorldPosition x="0" y="0" h="0.6435011087932844"/>',  # 3, 4, 5
            '<RelativeWorldPosition entityRef="Ego" dx="24" dy="18"/>',
        ),
        (
            '<WorldPosition x="0" y="0" h="1"/>',
            '<RelativeObjectPosition entityRef="Ego" dx="30" dy="0"/>',
        ),
        ('<RelativeLanePosition entityRef="Lead" dLane="0" ds="-30"/>', EGO_PLACE),
    ],
)
def test_each_way_to_say_a_place(ego: str, lead: str, tmp_path: Path) -> None:
    found = only_drive(imported(changed(tmp_path, (PLACE, "PLACE"), (EGO_PLACE, ego), ("PLACE", lead)))).lead
    assert found is not None
    assert found.gap_m == pytest.approx(30 - 3.65 - 1, abs=1e-5)


@pytest.mark.parametrize(
    ("condition", "who", "gap_m", "lead_ms", "expected_s"),
    [  # the ego drives at 10 m/s; from axle to axle there are 4.65 m more
        (
            '<RelativeDistanceCondition entityRef="{}" relativeDistanceType="longitudinal" freespace="true"'
            ' rule="lessThan" value="20"/>',
            "Ego",
            40,
            6,
            5.0,
        ),
        (
            '<RelativeDistanceCondition entityRef="{}" relativeDistanceType="euclidianDistance"'
            ' freespace="false" rule="lessOrEqual" value="24.65"/>',
            "Lead",
            40,
            6,
            5.0,
        ),
        (
            '<RelativeDistanceCondition entityRef="{}" relativeDistanceType="longitudinal" freespace="true"'
            ' rule="greaterThan" value="60"/>',
            "Ego",
            40,
            14,
            5.0,
        ),
        (
            '<TimeHeadwayCondition entityRef="{}" freespace="true" rule="lessThan" value="2"/>',
            "Ego",
            40,
            6,
            5.0,
        ),
        (
            '<TimeHeadwayCondition entityRef="{}" freespace="true" alongRoute="true" rule="lessThan"'
            ' value="2" coordinateSystem="road" relativeDistanceType="longitudinal"/>',
            "Ego",
            40,
            6,
            5.0,
        ),
        (
            '<TimeToCollisionCondition freespace="true" rule="lessThan" value="5">'
            '<TimeToCollisionConditionTarget><EntityRef entityRef="{}"/></TimeToCollisionConditionTarget>'
            "</TimeToCollisionCondition>",
            "Ego",
            40,
            6,
            5.0,
        ),
        ('<TraveledDistanceCondition value="50"/>', "Ego", 40, 6, 5.0),
        ('<TraveledDistanceCondition value="30"/>', "Lead", 40, 6, 5.0),
    ],
)
def test_each_trigger(
    condition: str, who: str, gap_m: float, lead_ms: float, expected_s: float, tmp_path: Path
) -> None:
    other = "Lead" if who == "Ego" else "Ego"
    path = changed(
        tmp_path,
        entity_condition(condition.format(other), who),
        (
            'name="SpeedKmh" parameterType="double" value="50"',
            'name="SpeedKmh" parameterType="double" value="36"',
        ),
        (
            'name="Gap" parameterType="double" value="40"',
            f'name="Gap" parameterType="double" value="{gap_m}"',
        ),
        (LEAD_SPEED, f'<AbsoluteTargetSpeed value="{lead_ms}"/>'),
    )
    found = imported(path)
    lead = only_drive(found).lead
    assert lead is not None
    assert lead.braking is not None
    assert lead.braking.after_s == pytest.approx(expected_s)
    of_lead = "TraveledDistance" in condition and who == "Lead"  # which does not depend on the ego
    kept = "" if of_lead else ", if no car has braked by then"
    assert f"met at {expected_s:g} s{kept}" in [one.meaning for one in found.taken]


@pytest.mark.parametrize(
    ("act", "event", "expected_s"),
    [
        ('value="0" rule="greaterThan"', 'value="1" rule="greaterThan"', 1.0),
        ('value="3" rule="greaterThan"', 'value="3" rule="greaterOrEqual"', 3.0),
        ('value="2" rule="greaterThan"', 'value="5" rule="greaterThan"', 5.0),
    ],
)
def test_an_event_waits_for_its_act(act: str, event: str, expected_s: float, tmp_path: Path) -> None:
    path = changed(tmp_path, ('value="0" rule="greaterThan"', act), ('value="1" rule="greaterThan"', event))
    lead = only_drive(imported(path)).lead
    assert lead is not None
    assert lead.braking is not None
    assert lead.braking.after_s == pytest.approx(expected_s)


def test_a_delay_and_no_edge(tmp_path: Path) -> None:
    old = '<Condition name="after a second" delay="0" conditionEdge="rising">'
    new = old.replace('"0"', '"0.5"').replace("rising", "none")
    path = changed(tmp_path, (old, new), ('value="0" rule="greaterThan"', 'value="4" rule="greaterThan"'))
    lead = only_drive(imported(path)).lead
    assert lead is not None
    assert lead.braking is not None
    assert lead.braking.after_s == pytest.approx(4.5), "true already when the act begins"


def test_the_length_of_a_drive_may_be_asked_for(tmp_path: Path) -> None:
    path = changed(tmp_path, (STOP_12_S, '<SimulationTimeCondition value="12" rule="lessThan"/>'))
    assert "StopTrigger: ends the drive at its start" in refused(path)
    assert only_drive(imported(path, duration_s=9)).duration_s == 9

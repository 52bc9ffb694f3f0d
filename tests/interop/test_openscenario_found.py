"""Files as they are found: Euro NCAP's, ALKS', esmini's. Each becomes the drive that it means."""

import os
from pathlib import Path

import pytest
import xoscbuilder as osc
from reartest import IS_BRAKING, rear_test
from xoscfiles import imported, refused

from aftbed.interop.openscenario.document import Cause, RefusedError
from aftbed.interop.openscenario.importer import ImportedFile, ImportOptions, import_scenario, write
from aftbed.interop.openscenario.storyboard import ImportedDrive, LeadDrive
from aftbed.runtime.sim.world import Setup, simulate
from aftbed.vehicle.plant import LeadBraking, LeadCar, LeadSpeed, Plant
from aftbed.vehicle.scenarios.library import load_scenario
from aftbed.vehicle.scenarios.scenario import SlowEnd

_SHARED = os.environ.get("AFTBED_SHARED")
DATA = (Path(_SHARED) if _SHARED else Path(__file__).resolve().parents[3] / "shared") / "data"
NCAP = DATA / "osc" / "OpenSCENARIO" / "NCAP" / "AEB_C2C_2023" / "Variations"


def varied(folder: Path, **values: str) -> ImportedDrive:
    """The only variation of the rear test with these values."""
    path = folder / "varied.xosc"
    path.write_text(osc.distribution("rear.xosc", **{name: [value] for name, value in values.items()}))
    (variation,) = imported(path).variations
    return variation.drive


def lead_of(drive: ImportedDrive) -> LeadDrive:
    assert drive.lead is not None
    return drive.lead


# -- Euro NCAP


def test_a_standing_target(tmp_path: Path) -> None:
    (found,) = imported(rear_test(tmp_path)).variations
    lead = lead_of(found.drive)
    assert lead.gap_m == pytest.approx(5 * 20 / 3.6 - osc.EGO_FRONT_M - osc.LEAD_REAR_M)
    assert (lead.speed_ms, lead.lateral_m, lead.braking) == (0.0, 0.0, None)
    assert found.drive.slow_ends == ()
    assert found.drive.duration_s == 30


def test_a_moving_target_ends_the_drive_when_the_car_is_slower(tmp_path: Path) -> None:
    rear_test(tmp_path)
    drive = varied(tmp_path, Ego_kph="50", Lead_kph="20")
    assert lead_of(drive).speed_ms == pytest.approx(20 / 3.6)
    (end,) = drive.slow_ends
    assert (end.below_ms, end.after_s) == (pytest.approx(16 / 3.6), 1.0)


def test_a_braking_target_jumps_to_its_headway_and_rolls_on(tmp_path: Path) -> None:
    rear_test(tmp_path)
    drive = varied(
        tmp_path, Ego_kph="50", Lead_kph="50", Final_kph="2", Brakes="true", Headway="40", Rate="6"
    )
    lead = lead_of(drive)
    assert lead.gap_m == pytest.approx(40)
    assert lead.braking is not None
    assert lead.braking.after_s == 3.0
    assert lead.braking.rate_ms2 == 6.0
    assert lead.braking.final_ms == pytest.approx(2 / 3.6)


def test_the_end_relative_to_the_target(tmp_path: Path) -> None:
    rear_test(tmp_path, '<RelativeSpeedCondition entityRef="Lead" value="-1" rule="lessThan"/>')
    drive = varied(tmp_path, Ego_kph="50", Lead_kph="50", Brakes="true")
    (end,) = drive.slow_ends
    assert (end.below_ms, end.below_lead_ms) == (None, 1.0)


@pytest.mark.parametrize(("overlap", "lateral_m"), [("100", 0.0), ("50", -0.855), ("-50", -2.565)])
def test_an_overlap_is_an_offset(overlap: str, lateral_m: float, tmp_path: Path) -> None:
    rear_test(tmp_path)
    drive = varied(tmp_path, Ego_kph="50", Overlap=overlap)
    if abs(lateral_m) < 1.8:
        assert lead_of(drive).lateral_m == pytest.approx(lateral_m)
    else:
        assert drive.lead is None, "beside the ego's line"


def test_offset_final_speed_and_end_are_in_the_scenario(tmp_path: Path) -> None:
    rear_test(tmp_path)
    path = tmp_path / "varied.xosc"
    values = {"Ego_kph": "50", "Lead_kph": "50", "Final_kph": "2", "Brakes": "true", "Overlap": "50"}
    path.write_text(osc.distribution("rear.xosc", **{name: [value] for name, value in values.items()}))
    (written,) = write(imported(path), tmp_path, force=True)
    scenario = load_scenario(str(written))
    assert scenario.plant.lead == LeadCar(
        12.0, pytest.approx(50 / 3.6), LeadBraking(3000, 2.0, 0, pytest.approx(2 / 3.6)), -0.855
    )
    assert scenario.slow_end == SlowEnd(1000, pytest.approx(40 / 3.6))


def test_a_wet_road_of_a_catalog(tmp_path: Path) -> None:
    path = rear_test(tmp_path)
    path.write_text(path.read_text().replace('entryName="Sunny"', 'entryName="Wet"'))
    assert imported(path).variations[0].drive.friction == 0.45


@pytest.mark.simulation
@pytest.mark.parametrize(
    ("row", "values"),
    [
        ("ncap:ccrs-50", {"Ego_kph": "50"}),
        ("ncap:ccrm-80", {"Ego_kph": "80", "Lead_kph": "20"}),
        (
            "ncap:ccrb-12m-6-50",
            {"Ego_kph": "50", "Lead_kph": "50", "Final_kph": "2", "Brakes": "true", "Rate": "6"},
        ),
    ],
)
def test_the_impact_is_that_of_the_row_of_our_table(row: str, values: dict[str, str], tmp_path: Path) -> None:
    """Within 0.5 km/h, with the function and without it."""
    rear_test(tmp_path)
    path = tmp_path / "varied.xosc"
    path.write_text(osc.distribution("rear.xosc", **{name: [value] for name, value in values.items()}))
    (written,) = write(imported(path), tmp_path, force=True)
    impacts, unbraked = zip(*(_impacts(name) for name in (row, str(written))), strict=True)
    assert impacts[1] == pytest.approx(impacts[0], abs=0.5)
    assert unbraked[1] == pytest.approx(unbraked[0], abs=0.5)
    assert unbraked[0] > 10.0


def _impacts(name: str) -> tuple[float, float]:
    """The speeds at impact, km/h, of the drive and of a car that does not brake."""
    result = simulate(Setup("none", seed=1, scenario=name)).vehicle
    assert result is not None
    plant = Plant(load_scenario(name).plant)
    while not plant.collided:
        plant.step(0.0)
    return result.impact_speed_kmh or 0.0, plant.result().impact_speed_kmh or 0.0


@pytest.mark.skipif(not NCAP.is_dir(), reason="the files of others are not at hand")
def test_the_real_files_of_euro_ncap() -> None:
    counts = {}
    for path in sorted(NCAP.glob("*CCR*.xosc")):
        found = imported(path)
        assert not found.left_out
        counts[path.stem] = len(found.variations)
    assert sorted(counts.values()) == [1, 1, 1, 4, 30, 45, 55]


# -- ALKS


ALKS_CONTROLLER = (
    "<ObjectController>"
    '<CatalogReference catalogName="ControllerCatalog" entryName="ALKS"/></ObjectController>'
)
ACTIVATES = osc.act(
    "Activate",
    osc.group(
        "Ego",
        osc.maneuver(
            "Activate",
            osc.event(
                "Activate",
                "<ControllerAction>"
                '<ActivateControllerAction lateral="true" longitudinal="true"/></ControllerAction>',
                osc.after(10000),
            ),
        ),
    ),
    start=osc.trigger("StartTrigger", [osc.after(0)]),
)


def test_free_driving_needs_no_catalog_and_no_straight_road(tmp_path: Path) -> None:
    (tmp_path / "road.xodr").write_text(osc.road('<arc curvature="0.01"/>'))
    path = tmp_path / "free.xosc"
    path.write_text(
        osc.scenario(
            init={"Ego": [osc.placed(osc.lane(5, lane_id="-4")), osc.speed(16.67)]},
            story=ACTIVATES,
            stop=osc.trigger("StopTrigger", [osc.after(300)]),
            objects=ALKS_CONTROLLER,
        )
    )
    (found,) = imported(path).variations
    assert found.drive.lead is None
    assert found.drive.duration_s == 300


def test_a_fully_blocking_target_on_each_road_that_is_straight(tmp_path: Path) -> None:
    osc.write_catalogs(tmp_path)
    (tmp_path / "straight.xodr").write_text(osc.road("<line/>"))
    (tmp_path / "bend.xodr").write_text(osc.road('<arc curvature="0.004"/>'))
    parameters = {"Road": "straight.xodr", "Kph": "60", "Catalog": "people", "Model": "walker", "S": "500"}
    (tmp_path / "blocking.xosc").write_text(
        osc.scenario(
            init={
                "Ego": [osc.placed(osc.lane(5)), osc.speed("${$Kph / 3.6}")],
                "Lead": [osc.placed(osc.lane("$S"))],
            },
            entries={"Lead": ("$Catalog", "$Model")},
            story=ACTIVATES,
            stop=osc.trigger("StopTrigger", [osc.after("${($S / ($Kph / 3.6)) + 10.0}")]),
            parameters=parameters,
            objects=ALKS_CONTROLLER,
        )
    )
    path = tmp_path / "all.xosc"
    path.write_text(osc.distribution("blocking.xosc", Road=["bend.xodr", "straight.xodr"], Kph=["30", "60"]))
    found = imported(path)
    assert [one.name for one in found.variations] == [
        "all-Road-straight.xodr-Kph-30",
        "all-Road-straight.xodr-Kph-60",
    ]
    assert [(one.parameters["Kph"], one.reason) for one in found.left_out] == [
        ("30", "arc: a curve; the road has to be straight"),
        ("60", "arc: a curve; the road has to be straight"),
    ]
    drive = found.variations[1].drive
    assert lead_of(drive).gap_m == pytest.approx(495 - osc.EGO_FRONT_M - (0.2 - 0.1))
    assert drive.duration_s == pytest.approx(500 / (60 / 3.6) + 10)


def test_a_lead_that_starts_a_time_ahead_and_a_drive_that_ends_after_it_stands(tmp_path: Path) -> None:
    osc.write_catalogs(tmp_path)
    path = tmp_path / "follow.xosc"
    ended = (
        '<StoryboardElementStateCondition storyboardElementType="action" storyboardElementRef="BrakeAction"'
        ' state="completeState"/>'
    )
    place = '<RelativeLanePosition entityRef="Ego" dLane="0" ds="38"/>'
    brake = osc.event("Brake", osc.brakes(5), osc.after(10))
    path.write_text(
        osc.scenario(
            init={
                "Ego": [osc.placed(osc.lane(5)), osc.speed(15)],
                "Lead": [osc.placed(place), osc.speed(15), osc.keeps('timeGap="2"')],
            },
            story=ACTIVATES + osc.act("Act", osc.group("Lead", osc.maneuver("Brake", brake))),
            stop=osc.trigger("StopTrigger", [osc.by_value(ended, delay=10, edge="rising")]),
        )
    )
    (found,) = imported(path).variations
    assert lead_of(found.drive).gap_m == pytest.approx(30)
    assert found.drive.duration_s == pytest.approx(10 + 15 / 5 + 10)


# -- esmini


def test_what_brakes_the_ego_is_replaced_by_the_function(tmp_path: Path) -> None:
    osc.write_catalogs(tmp_path)
    path = tmp_path / "slow.xosc"
    ttc = (
        '<TimeToCollisionCondition value="2.7" freespace="false" alongRoute="true" rule="lessThan">'
        '<TimeToCollisionConditionTarget><EntityRef entityRef="Lead"/></TimeToCollisionConditionTarget>'
        "</TimeToCollisionCondition>"
    )
    brake = osc.event("Brake", osc.brakes(-6), osc.by_entity(ttc, edge="rising"))
    slower = osc.by_entity('<RelativeSpeedCondition rule="lessThan" value="0" entityRef="Lead"/>', delay=4)
    path.write_text(
        osc.scenario(
            init={
                "Ego": [osc.placed(osc.lane(50)), osc.speed(30)],
                "Lead": [osc.placed(osc.lane(200)), osc.speed(1)],
            },
            story=osc.act(
                "Act",
                osc.group("Ego", osc.maneuver("Brake", brake)),
                start=osc.trigger("StartTrigger", [osc.after(0)]),
            ),
            stop=osc.trigger("StopTrigger", [slower]),
        )
    )
    found = imported(path)
    assert ("LongitudinalAction", "aftbed's function takes its place") in [
        (one.element, one.reason) for one in found.ignored
    ]
    (end,) = found.variations[0].drive.slow_ends
    assert (end.below_lead_ms, end.after_s) == (0.0, 4.0)


def test_cars_that_are_not_in_the_way_do_not_matter(tmp_path: Path) -> None:
    osc.write_catalogs(tmp_path)
    path = tmp_path / "many.xosc"
    init = {
        "Ego": [osc.placed(osc.lane(50)), osc.speed(20)],
        "Behind": [osc.placed(osc.lane(20)), osc.speed(20)],
        "Left": [osc.placed(osc.lane(80, lane_id="-2")), osc.speed(25)],
        "Lead": [osc.placed(osc.lane(100)), osc.speed(10)],
    }
    entries = dict.fromkeys(("Behind", "Left", "Second"), ("cars", "target"))
    path.write_text(osc.scenario(init=init, entries=entries))
    found = imported(path)
    assert lead_of(found.variations[0].drive).name == "Lead"
    reasons = {one.reason for one in found.ignored}
    assert "Behind does not matter: it is behind the ego" in reasons
    assert "Left does not matter: it is in another lane than the ego" in reasons
    init["Second"] = [osc.placed(osc.lane(150)), osc.speed(10)]
    path.write_text(osc.scenario(init=init, entries=entries))
    assert "'Lead' and 'Second' are both in the ego's lane" in refused(path)


# -- the examples of the standard


def test_the_end_of_a_traffic_jam_with_drivers_that_nothing_activates(tmp_path: Path) -> None:
    osc.write_catalogs(tmp_path)
    path = tmp_path / "jam.xosc"
    brakes = {
        name: osc.event(
            "Event", osc.brakes(5, 10), osc.by_entity(f'<TraveledDistanceCondition value="{m}"/>', name)
        )
        for name, m in (("Beside", 100), ("Lead", 200))
    }
    driver = '<ObjectController><Controller name="driver"/></ObjectController>'
    text = osc.scenario(
        init={
            "Ego": [osc.speed(27.778), osc.placed(osc.lane(1000, lane_id="-3"))],
            "Beside": [
                osc.speed(20),
                osc.placed('<RelativeLanePosition entityRef="Ego" dLane="1" ds="200" offset="0"/>'),
            ],
            "Lead": [
                osc.speed(20),
                osc.placed('<RelativeLanePosition entityRef="Ego" dLane="0" ds="150" offset="0"/>'),
            ],
        },
        entries={"Beside": ("cars", "target")},
        story="".join(
            osc.act(
                name,
                osc.group(name, osc.maneuver("Maneuver", event)),
                start=osc.trigger("StartTrigger", [osc.after(0)]),
            )
            for name, event in brakes.items()
        ),
        stop="<StopTrigger/>",
    )
    path.write_text(text.replace("</ScenarioObject>", f"{driver}</ScenarioObject>"))
    (found,) = imported(path).variations
    lead = lead_of(found.drive)
    assert lead.name == "Lead"
    assert lead.braking is not None
    assert (lead.braking.after_s, lead.braking.final_ms) == (10.0, 10.0)
    activates = osc.event("On", "<ActivateControllerAction/>", osc.after(1))
    controls = osc.act("On", osc.group("Lead", osc.maneuver("On", activates)))
    path.write_text(path.read_text().replace("</Story>", f"{controls}</Story>"))
    with pytest.raises(RefusedError) as error:
        imported(path)
    assert error.value.cause is Cause.CONTROLLER


# -- what can never start, and what a condition makes of it


def braking_file(
    folder: Path, *conditions: str, start: str = "", variables: str = "", story: str = ""
) -> Path:
    """The lead drives at 10 m/s, as the ego does, and brakes on these conditions."""
    osc.write_catalogs(folder)
    path = folder / "brakes.xosc"
    brake = osc.event("Brake", osc.brakes(5), *conditions)
    path.write_text(
        osc.scenario(
            init={
                "Ego": [osc.placed(osc.lane(0)), osc.speed(10)],
                "Lead": [osc.placed(osc.lane(50)), osc.speed(10)],
            },
            story=osc.act("Act", osc.group("Lead", osc.maneuver("Brake", brake)), start=start) + story,
            parameters={"Brakes": "false"},
            variables=variables,
        )
    )
    return path


def after_s(path: Path) -> float | None:
    braking = lead_of(imported(path).variations[0].drive).braking
    return braking.after_s if braking else None


def test_an_act_that_can_never_start_may_hold_anything(tmp_path: Path) -> None:
    never = osc.trigger("StartTrigger", [IS_BRAKING, osc.after(1)])
    lateral = osc.event("Swerve", "<LateralAction><LaneChangeAction/></LateralAction>")
    path = braking_file(
        tmp_path,
        osc.after(2),
        story=osc.act("Never", osc.group("Lead", osc.maneuver("Swerve", lateral)), start=never),
    )
    assert after_s(path) == 2.0
    path.write_text(
        path.read_text().replace(
            'name="Brakes" parameterType="string" value="false"',
            'name="Brakes" parameterType="string" value="true"',
        )
    )
    with pytest.raises(RefusedError) as error:
        imported(path)
    assert error.value.cause is Cause.LATERAL


def sets(name: str, value: str, at_s: float) -> str:
    """An act that sets a variable."""
    setting = f'<VariableAction variableRef="{name}"><SetAction value="{value}"/></VariableAction>'
    one = osc.event(f"Set{name}{value}", setting, osc.after(at_s), kind="GlobalAction")
    return osc.act("Sets", osc.group(None, osc.maneuver("Sets", one)))


def time_below(seconds: float) -> str:
    return osc.by_value(f'<SimulationTimeCondition value="{seconds}" rule="lessThan"/>')


def rises_at(seconds: float) -> str:
    return osc.by_value(f'<SimulationTimeCondition value="{seconds}" rule="greaterThan"/>', edge="rising")


IS_GO = osc.by_value('<VariableCondition variableRef="go" rule="equalTo" value="1"/>')
GO = '<VariableDeclaration name="go" variableType="int" value="0"/>'


@pytest.mark.parametrize(
    ("conditions", "story", "expected_s"),
    [
        ([osc.after(2), osc.after(5)], "", 5.0),  # all of a group
        ([osc.after(2), time_below(3)], "", 2.0),
        ([osc.after(2), rises_at(5)], "", 5.0),
        ([osc.after(5), rises_at(2)], "", None),  # an edge is over when the rest of the group holds
        ([osc.after(4), time_below(3)], "", None),
        ([osc.by_value('<SimulationTimeCondition value="3" rule="lessThan"/>', edge="falling")], "", 3.0),
        (
            [osc.by_value('<SimulationTimeCondition value="3" rule="greaterThan"/>', edge="risingOrFalling")],
            "",
            3.0,
        ),
        ([osc.by_value('<SimulationTimeCondition value="3" rule="greaterThan"/>', edge="falling")], "", None),
        ([IS_GO], sets("go", "1", 7), 7.0),
        ([IS_GO], sets("go", "2", 7), None),
        ([IS_GO], "", None),
        ([IS_GO, osc.by_entity('<StandStillCondition duration="1"/>')], "", None),
        ([osc.by_entity('<SpeedCondition value="5" rule="greaterThan"/>', "Lead")], "", 0.0),
        ([osc.by_entity('<StandStillCondition duration="1"/>', "Lead")], "", None),
        ([osc.by_entity('<CollisionCondition><EntityRef entityRef="Lead"/></CollisionCondition>')], "", None),
        ([osc.by_entity('<AccelerationCondition value="-1" rule="greaterThan"/>')], "", 0.0),
    ],
)
def test_when_conditions_are_met(
    conditions: list[str], story: str, expected_s: float | None, tmp_path: Path
) -> None:
    path = braking_file(tmp_path, *conditions, variables=GO, story=story)
    assert after_s(path) == expected_s


def test_a_condition_that_has_ceased_to_hold_when_its_act_begins(tmp_path: Path) -> None:
    start = osc.trigger("StartTrigger", [osc.after(5)])
    assert after_s(braking_file(tmp_path, time_below(3), start=start)) is None
    assert after_s(braking_file(tmp_path, time_below(6), start=start)) == 5.0


@pytest.mark.parametrize(
    ("condition", "reason"),
    [
        (
            osc.by_value('<VariableCondition variableRef="stop" rule="equalTo" value="1"/>'),
            "variableRef: 'stop' is not declared",
        ),
        (
            osc.by_value(
                '<StoryboardElementStateCondition storyboardElementType="event" storyboardElementRef="Brak"'
                ' state="completeState"/>'
            ),
            "storyboardElementRef: found 'Brak', no event has this name",
        ),
        (
            osc.by_value(
                '<StoryboardElementStateCondition storyboardElementType="event" storyboardElementRef="Brake"'
                ' state="completeState"/>'
            ),
            "Event: waits for itself",
        ),
        (osc.by_value("<UserDefinedValueCondition/>"), "UserDefinedValueCondition: a trigger whose moment"),
        (
            osc.by_entity('<StandStillCondition duration="1"/>'),
            "StandStillCondition: never met while both cars keep their speed",
        ),
    ],
)
def test_a_moment_that_is_not_known_is_refused(condition: str, reason: str, tmp_path: Path) -> None:
    assert reason in refused(braking_file(tmp_path, condition, variables=GO))


def test_a_braking_after_the_end_of_the_drive_is_left_out(tmp_path: Path) -> None:
    path = braking_file(tmp_path, osc.after(20))
    found = import_scenario(path, None, ImportOptions(duration_s=10))
    assert lead_of(found.variations[0].drive).braking is None
    meanings = [one.meaning for one in found.taken]
    assert "Lead would change its speed at 20 s: the drive has ended by then" in meanings


def test_a_drive_without_an_end_lasts_until_the_lead_has_braked(tmp_path: Path) -> None:
    assert drive_of(braking_file(tmp_path, osc.after(40))).duration_s == 40 + 10 / 5 + 10


@pytest.mark.parametrize(
    ("limit_m", "final_ms", "lasts_s"),
    [
        (15, 0, 1.5),  # it drives at 10 m/s and brakes at 5 m/s2 after 2 s
        (27.5, 0, 3.0),
        (40, 0, 30.0),  # never: it stands after 30 m
        (27.5 + 10, 5, 3.0 + 2.0),
    ],
)
def test_what_a_car_travels_that_brakes(
    limit_m: float, final_ms: float, lasts_s: float, tmp_path: Path
) -> None:
    path = braking_file(tmp_path, osc.after(2))
    stop = osc.trigger(
        "StopTrigger", [osc.by_entity(f'<TraveledDistanceCondition value="{limit_m}"/>', "Lead")]
    )
    text = path.read_text().replace(
        '<AbsoluteTargetSpeed value="0"/>', f'<AbsoluteTargetSpeed value="{final_ms}"/>'
    )
    path.write_text(text.replace("</Storyboard>", f"{stop}</Storyboard>"))
    assert drive_of(path).duration_s == pytest.approx(lasts_s)


def drive_of(path: Path) -> ImportedDrive:
    (found,) = imported(path).variations
    return found.drive


def test_what_moves_no_car_that_matters_is_ignored(tmp_path: Path) -> None:
    """A car that keeps its speed, that is seen, and signals."""
    keeps = osc.maneuver("Keep", osc.event("Keep", osc.speed(10), osc.after(1)))
    shown = '<VisibilityAction graphics="false" sensors="true" traffic="false"/>'
    story = osc.act("Keep", osc.group("Lead", keeps, osc.maneuver("Show", osc.event("Show", shown))))
    path = braking_file(tmp_path, osc.after(2), story=story)
    signals = '<TrafficSignals><TrafficSignalController name="lights"/></TrafficSignals></RoadNetwork>'
    path.write_text(path.read_text().replace("</RoadNetwork>", signals))
    assert after_s(path) == 2.0
    ignored = {one.element: one.reason for one in imported(path).ignored}
    assert ignored["SpeedAction"] == "it is the speed that the car has"
    assert ignored["VisibilityAction"] == "the radar sees the car"
    assert ignored["TrafficSignals"] == "the function brakes for cars, not for signals"
    path.write_text(path.read_text().replace('sensors="true"', 'sensors="false"'))
    assert "VisibilityAction: a car that sensors do not see" in refused(path)


# -- more than one change of speed


def ended(name: str, delay: float = 0) -> str:
    condition = (
        f'<StoryboardElementStateCondition storyboardElementType="event" storyboardElementRef="{name}"'
        ' state="endTransition"/>'
    )
    return osc.by_value(condition, delay=delay)


def changing(folder: Path, *events: str, lead_ms: float = 10) -> Path:
    """The ego drives at 20 m/s, the lead 100 m ahead with these events."""
    osc.write_catalogs(folder)
    path = folder / "changing.xosc"
    path.write_text(
        osc.scenario(
            init={
                "Ego": [osc.placed(osc.lane(0)), osc.speed(20)],
                "Lead": [osc.placed(osc.lane(100)), osc.speed(lead_ms)],
            },
            story=osc.act("Act", osc.group("Lead", osc.maneuver("Vary", *events))),
        )
    )
    return path


def changes_of(path: Path) -> list[tuple[float, float, float]]:
    return [(one.after_s, one.final_ms, one.rate_ms2) for one in lead_of(drive_of(path)).changes]


def test_a_lead_that_speeds_up_and_slows_down_again(tmp_path: Path) -> None:
    """As in ALKS 4.3_1: the second change begins some time after the first one has ended."""
    up = osc.event("Up", osc.brakes(2, 20), osc.after(10))
    down = osc.event("Down", osc.brakes(4, 8), ended("Up", delay=5))
    path = changing(tmp_path, down, up)
    assert changes_of(path) == [(10.0, 20.0, 2.0), (20.0, 8.0, 4.0)]
    assert drive_of(path).duration_s == 20 + 12 / 4 + 10
    (written,) = write(imported(path), tmp_path, force=True)
    lead = load_scenario(str(written)).plant.lead
    assert lead is not None
    assert lead.braking is None
    assert lead.speeds == (LeadSpeed(10_000, 20.0, 2.0), LeadSpeed(20_000, 8.0, 4.0))


def test_a_target_that_sets_off_when_the_ego_comes_near(tmp_path: Path) -> None:
    distance = 'relativeDistanceType="longitudinal" freespace="false" value="40" rule="lessOrEqual"'
    near = osc.by_entity(f'<RelativeDistanceCondition entityRef="Lead" {distance}/>', edge="rising")
    set_off = osc.event("Go", osc.speed(4, 'dynamicsShape="linear" value="2" dynamicsDimension="time"'), near)
    assert changes_of(changing(tmp_path, set_off, lead_ms=0)) == [(3.0, 4.0, 2.0)]


def test_a_change_that_comes_before_the_one_before_it_is_done(tmp_path: Path) -> None:
    slow, fast = (
        osc.event("Slow", osc.brakes(2), osc.after(1)),
        osc.event("Fast", osc.brakes(2, 9), osc.after(3)),
    )
    path = changing(tmp_path, slow, fast)
    assert changes_of(path) == [(1.0, 0.0, 2.0), (3.0, 9.0, 2.0)]
    stands = osc.by_entity('<SpeedCondition value="8" rule="lessThan"/>', "Lead")
    stop = osc.trigger("StopTrigger", [stands])
    path.write_text(path.read_text().replace("</Storyboard>", f"{stop}</Storyboard>"))
    assert drive_of(path).duration_s == 2.0, "from 10 m/s, at 2 m/s2 from 1 s on"
    path.write_text(path.read_text().replace('value="8" rule="lessThan"', 'value="7" rule="greaterThan"'))
    assert "ends the drive at its start" in refused(path)


def test_what_it_travels_over_several_changes(tmp_path: Path) -> None:
    up = osc.event("Up", osc.brakes(5, 20), osc.after(2))
    path = changing(tmp_path, up)
    stop = osc.trigger(
        "StopTrigger", [osc.by_entity('<TraveledDistanceCondition value="90"/>', "Lead")]
    )  # 20 m, and 30 m in 2 s, and 40 m in 2 s
    path.write_text(path.read_text().replace("</Storyboard>", f"{stop}</Storyboard>"))
    assert drive_of(path).duration_s == pytest.approx(6.0)


def test_a_second_change_that_depends_on_how_the_cars_move_is_refused(tmp_path: Path) -> None:
    ttc = '<TimeHeadwayCondition entityRef="Lead" freespace="true" rule="lessThan" value="1.5"/>'
    path = changing(
        tmp_path,
        osc.event("Up", osc.brakes(2, 12), osc.after(1)),
        osc.event("Down", osc.brakes(2), osc.by_entity(ttc)),
    )
    assert "TimeHeadwayCondition: depends on how the cars move, after another change of speed" in refused(
        path
    )


# -- catalogs


def test_a_broken_catalog_beside_the_one_that_is_needed(tmp_path: Path) -> None:
    path = braking_file(tmp_path, osc.after(2))
    (tmp_path / "cars" / "another.xosc").write_text("<OpenSCENARIO>")
    assert after_s(path) == 2.0
    (tmp_path / "cars" / "cars.xosc").unlink()
    assert f"{tmp_path / 'cars' / 'another.xosc'}: line 1: not XML" in refused(path)


def test_a_trailer_is_refused_where_there_is_one(tmp_path: Path) -> None:
    path = braking_file(tmp_path, osc.after(2))
    cars = tmp_path / "cars" / "cars.xosc"
    cars.write_text(
        cars.read_text().replace('<TrailerRef entityRef=""/>', '<TrailerRef entityRef="caravan"/>')
    )
    assert "Trailer: a trailer; one car ahead is all there is" in refused(path)


def test_the_cars_would_touch_where_those_of_a_drive_do_not(tmp_path: Path) -> None:
    osc.write_catalogs(tmp_path)
    path = tmp_path / "moped.xosc"
    init = {
        "Ego": [osc.placed(osc.lane(0)), osc.speed(10)],
        "Lead": [osc.placed(osc.lane(50, offset=1.5)), osc.speed(5)],
    }
    path.write_text(osc.scenario(init=init, entries={"Lead": ("cars", "moped")}))
    assert "found 1.5 m beside the line of 'Ego', where these cars touch below 1.3 m" in refused(path)


# -- variations


def test_some_of_the_variations(tmp_path: Path) -> None:
    rear_test(tmp_path)
    path = tmp_path / "varied.xosc"
    path.write_text(osc.distribution("rear.xosc", Ego_kph=["10", "20", "30"], Overlap=["100", "75"]))
    found = _picked(path, ("Ego_kph", "20.0"), ("Ego_kph", "30"), ("Overlap", "75"))
    assert [one.name for one in found.variations] == [
        "varied-Ego_kph-20-Overlap-75",
        "varied-Ego_kph-30-Overlap-75",
    ]


def _picked(path: Path, *pick: tuple[str, str]) -> ImportedFile:
    return import_scenario(path, None, ImportOptions(pick=pick))


def test_a_distribution_without_its_file(tmp_path: Path) -> None:
    path = tmp_path / "varied.xosc"
    path.write_text(osc.distribution("../rear.xosc", Ego_kph=["10"]))
    with pytest.raises(RefusedError, match=r"ScenarioFile: filepath: '.*rear\.xosc' is not there") as error:
        imported(path)
    assert error.value.cause is Cause.MISSING

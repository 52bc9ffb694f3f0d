"""An OpenSCENARIO file that a scenario cannot express is refused with file, line and reason."""

from pathlib import Path

import pytest
from xoscfiles import (
    EGO_PLACE,
    LATERAL,
    LEAD_BRAKES,
    LEAD_SPEED,
    LONGITUDINAL,
    PLACE,
    RATE,
    SLOW_LEAD,
    changed,
    entity_condition,
    imported,
    refused,
)

from aftbed.core.errors import ConfigError
from aftbed.interop.openscenario.importer import ImportedFile, ImportOptions, import_scenario

# -- what is refused


TELEPORT = (
    '<TeleportAction><Position><LanePosition roadId="1" laneId="-1" s="1"/></Position></TeleportAction>'
)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ([(LONGITUDINAL, LATERAL)], "line 122: LateralAction: lateral motion"),
        ([(LONGITUDINAL, "<RoutingAction/>")], "line 122: RoutingAction: routes"),
        ([(LONGITUDINAL, "<SynchronizeAction/>")], "SynchronizeAction: the speed of the car ahead"),
        ([(LONGITUDINAL, TELEPORT)], "PrivateAction: found TeleportAction, allowed is Longitud"),
        (
            [("<CatalogLocations/>", "<Wormhole/>")],
            "line 15: Wormhole: not allowed here in OpenSCENARIO, allowed is VariableDeclarations or",
        ),
        ([("<Init>", "<Init>text")], "Init: text is not expected here"),
        (
            [(RATE, RATE.replace("linear", "sinusoidal"))],
            "dynamicsShape: found 'sinusoidal', allowed is linear",
        ),
        ([(RATE, RATE.replace("$Deceleration", "20"))], "a deceleration of 20 m/s2, allowed is 0.01 to 12"),
        ([(RATE, RATE.replace("$Deceleration", "0"))], "value: found '0', allowed is more than 0"),
        (
            [
                (
                    '<EntityRef entityRef="$Owner"/>',
                    '<EntityRef entityRef="$Owner"/><EntityRef entityRef="Ego"/>',
                )
            ],
            "found 'Lead', 'Ego'; allowed is the car ahead, 'Lead'",
        ),
        (
            [
                ('<EntityRef entityRef="$Owner"/>', '<EntityRef entityRef="Ego"/>'),
                ('<AbsoluteTargetSpeed value="0"/>', '<AbsoluteTargetSpeed value="20"/>'),
            ],
            "the ego speeds up to 72 km/h; it keeps its speed of the start until the function brakes",
        ),
        ([('<EntityRef entityRef="$Owner"/>', "")], "Actors: no car in it that the action could move"),
        ([('<EntityRef entityRef="$Owner"/>', '<EntityRef entityRef="Nobody"/>')], "unknown car 'Nobody'"),
        ([(LEAD_SPEED, '<AbsoluteTargetSpeed value="-1"/>')], "-1 m/s, allowed is 0 or more"),
        ([(LEAD_SPEED, '<AbsoluteTargetSpeed value="fast"/>')], "value: found 'fast', allowed is a number"),
        ([(LEAD_SPEED, '<AbsoluteTargetSpeed value="$Fast"/>')], "value: unknown parameter 'Fast'"),
        ([(LEAD_SPEED, '<AbsoluteTargetSpeed value="${1 / 0}"/>')], "'${1 / 0}': division by zero"),
        ([(PLACE, PLACE.replace('dLane="0"', 'dLane="0.5"'))], "dLane: found '0.5', allowed is a whole"),
        (
            [(PLACE, '<LanePosition roadId="2" laneId="-1" s="50"/>')],
            "found a lane of road 2, allowed is a lane of road 1",
        ),
        (
            [(PLACE, '<LanePosition roadId="1" laneId="1" s="50"/>')],
            "laneId: found '1', allowed is a lane that",
        ),
        (
            [(PLACE, '<LanePosition roadId="1" laneId="-1" offset="-1.82" s="50"/>')],
            "found -1.82 m beside the line of 'Ego', where these cars touch below 1.85 m",
        ),
        ([(PLACE, '<LanePosition roadId="1" laneId="-1" s="22"/>')], "'Lead' is -2.65 m ahead of the ego"),
        ([(PLACE, PLACE.replace("Ego", "Lead"))], "entityRef: unknown car 'Lead'"),
        (
            [(EGO_PLACE, '<RelativeLanePosition entityRef="Lead" dLane="0" ds="-30"/>')],
            "'Lead' is placed by 'Ego', which is placed by 'Lead'",
        ),
        (
            [(PLACE, PLACE[:-2] + '><Orientation h="3.14"/></RelativeLanePosition>')],
            "Position: heads elsewhere than 'Ego'; the road is straight",
        ),
        (
            [
                (
                    'maximumExecutionCount="1">\n          <Actors',
                    'maximumExecutionCount="2">\n          <Actors',
                )
            ],
            "ManeuverGroup: maximumExecutionCount: found '2', allowed is 1",
        ),
        (
            [
                (
                    '<Condition name="after a second"',
                    '<Condition conditionEdge="none" delay="0" name="x"/><Condition name="y"',
                )
            ],
            "Condition: found nothing, allowed is ByEntityCondition or ByValueCondition",
        ),
        (
            [('value="0" rule="greaterThan"', 'value="4" rule="greaterThan"')],
            "met before it is looked at, at 4 s: with conditionEdge 'rising' it never triggers",
        ),
        (
            [entity_condition('<SpeedCondition rule="lessThan" value="1"/>')],
            "SpeedCondition: never met while both cars keep their speed",
        ),
        (
            [entity_condition('<ReachPositionCondition tolerance="1"/>')],
            "ReachPositionCondition: a trigger whose moment does not follow from the start",
        ),
        (
            [entity_condition('<SpeedCondition rule="lessThan" value="1"/>', "Other")],
            "SpeedCondition: of 'Other': a moment that follows from neither the ego nor the car ahead",
        ),
        (
            [
                entity_condition(
                    '<TimeHeadwayCondition entityRef="Lead" freespace="true" rule="lessThan" value="1"/>'
                )
            ],
            "never met while both cars keep their speed",
        ),
        (
            [('<Act name="act">\n        <Man', '<Act name="act">\n        <Many/><Man')],
            "Many: not allowed here in Act, allowed is ManeuverGroup",
        ),
        (
            [
                (
                    "<StopTrigger/>",
                    '<StopTrigger><ConditionGroup><Condition conditionEdge="none" delay="0" name="x">'
                    '<ByValueCondition><SimulationTimeCondition value="2" rule="greaterThan"/>'
                    "</ByValueCondition></Condition></ConditionGroup></StopTrigger>",
                )
            ],
            "may stop the act before the car ahead has its speed, at 3.31481 s",
        ),
        (
            [('<Event name="lights" priority="parallel">', '<Event name="lights" priority="override">')],
            "priority: found 'override', allowed is parallel",
        ),
        ([('revMinor="2"', 'revMinor="9"')], "FileHeader: OpenSCENARIO 1.9, allowed are 1.0, 1.1, 1.2, 1.3"),
        ([('vehicleCategory="van"', 'vehicleCategory="tram"')], "vehicleCategory: unknown value 'tram'"),
        ([('length="5"', 'length="0"')], "length: found '0', allowed is more than 0"),
        ([("$SpeedKmh / 3.6", "$SpeedKmh / 3.6 * 5")], "ego.speed_kmh"),
        ([('name="Lead">', 'name="Ego">')], "which vehicle is the ego?"),
        (
            [('<ScenarioObject name="Ego">', '<ScenarioObject name="Host">')],
            "--ego NAME says it (one of: Host, Lead)",
        ),
        (
            [
                (
                    '<ValueConstraint rule="greaterThan" value="0"/>',
                    '<ValueConstraint rule="greaterThan" value="60"/>',
                )
            ],
            "ParameterDeclaration: SpeedKmh = '50' keeps to no ConstraintGroup",
        ),
    ],
)
def test_an_inexpressible_element_is_refused(
    changes: list[tuple[str, str]], reason: str, tmp_path: Path
) -> None:
    path = changed(tmp_path, *changes)
    found = refused(path)
    assert found.startswith(f"{path}: ") or "the scenario would be out of range" in found
    assert reason in found


@pytest.mark.parametrize(
    "value", ["", "nan", "INF", "1e999", "1_0", "0x5", "\N{ARABIC-INDIC DIGIT FIVE}", "5 m/s"]
)
def test_a_number_that_xml_does_not_have_is_refused(value: str, tmp_path: Path) -> None:
    path = changed(tmp_path, (LEAD_SPEED, f'<AbsoluteTargetSpeed value="{value}"/>'))
    assert f"AbsoluteTargetSpeed: value: found {value!r}, allowed is a number" in refused(path)


def test_all_that_is_refused_is_said_at_once(tmp_path: Path) -> None:
    path = changed(
        tmp_path,
        (LONGITUDINAL, LATERAL),
        ("<CatalogLocations/>", '<CatalogLocations/><EntitySelection name="all"/>'),
        ("<Init>", "<Init><UserDefinedAction/>"),
    )
    assert refused(path).splitlines() == [
        f"{path}: 3 elements are not supported",
        "  line 15: EntitySelection: one car ahead is all there is: no other road users or objects",
        "  line 51: UserDefinedAction: commands that only one simulator knows",
        "  line 122: LateralAction: lateral motion; the cars keep to one lane of a straight road",
    ]


def test_the_world_is_said_once(tmp_path: Path) -> None:
    world = (
        '<GlobalAction><EnvironmentAction><Environment name="wet"><RoadCondition frictionScaleFactor="0.5"/>'
        "</Environment></EnvironmentAction></GlobalAction>"
    )

    def with_world(text: str) -> Path:
        return changed(tmp_path, ("<Init>\n      <Actions>", f"<Init><Actions>{text}"))

    assert imported(with_world(world)).variations[0].drive.friction == 0.45
    assert "RoadCondition: a second one" in refused(with_world(world * 2))
    reason = "frictionScaleFactor: found '0', allowed is more than 0"
    assert reason in refused(with_world(world.replace("0.5", "0")))


def test_assumptions_are_printed(tmp_path: Path) -> None:
    text = LEAD_BRAKES.read_text()
    begin = text.index("<PrivateAction>", text.index("RelativeLanePosition"))
    end = text.index("</PrivateAction>", begin) + len("</PrivateAction>")
    text = text[:begin] + text[end:]
    begin, end = text.index("<Story "), text.index("</Story>") + len("</Story>")
    text = text[:begin] + text[end:]
    begin = text.index("<StopTrigger>")
    text = text[:begin] + text[text.index("</StopTrigger>") + len("</StopTrigger>") :]
    path = tmp_path / "assumed.xosc"
    path.write_text(text)
    meanings = [one.meaning for one in imported(path).taken]
    assert "Lead stands: no SpeedAction" in meanings
    assert "the drive ends at 30 s: no StopTrigger says when" in meanings


def test_the_function_takes_the_place_of_a_controller_of_the_ego_only() -> None:
    found = import_scenario(SLOW_LEAD, None, ImportOptions(ego="Host"))
    replaced = [one.element for one in found.ignored if "takes its place" in one.reason]
    assert replaced == ["ObjectController", "ActivateControllerAction"]
    with pytest.raises(ConfigError, match="line 23: ObjectController: controllers"):
        import_scenario(SLOW_LEAD, None, ImportOptions(ego="Target"))


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (
            'catalogName="Cars" entryName="$LeadCar"',
            'catalogName="Cars" entryName="car_shirt"',
            "unknown entry of 'Cars' 'car_shirt'; did you mean 'car_short'? (one of: car_long, car_short)",
        ),
        (
            '<Directory path="catalogs"/>',
            '<Directory path="nowhere"/>',
            "No such file or directory; the gap needs",
        ),
        (
            'parameterRef="Length"',
            'parameterRef="Lenght"',
            "unknown parameter 'Lenght'; did you mean 'Length'?",
        ),
    ],
)
def test_a_vehicle_that_no_catalog_has(old: str, new: str, reason: str, tmp_path: Path) -> None:
    (tmp_path / "catalogs").symlink_to(SLOW_LEAD.parent / "catalogs")
    path = changed(tmp_path, (old, new), source=SLOW_LEAD)
    with pytest.raises(ConfigError) as error:
        import_scenario(path, None, ImportOptions(ego="Host"))
    assert reason in str(error.value)


@pytest.mark.parametrize(
    ("geometry", "profile", "reason"),
    [
        ('<geometry hdg="0"><line/></geometry><geometry hdg="0"><line/></geometry>', "", None),
        (
            '<geometry hdg="0"><line/></geometry><geometry hdg="0"><arc curvature="0.01"/></geometry>',
            "",
            "arc: a curve",
        ),
        (
            '<geometry hdg="0"><line/></geometry><geometry hdg="0.1"><line/></geometry>',
            "",
            "another direction",
        ),
        ('<geometry hdg="0"><line/></geometry>', '<elevation s="0" a="7" b="0" c="0" d="0"/>', None),
        (
            '<geometry hdg="0"><line/></geometry>',
            '<elevation s="0" a="0" b="0.02"/>',
            "b: found '0.02', allowed is 0",
        ),
    ],
)
def test_a_road_that_is_known_to_bend_or_climb_is_refused(
    geometry: str, profile: str, reason: str | None, tmp_path: Path
) -> None:
    path = changed(tmp_path)
    other = '<road id="2"><planView><geometry hdg="0"><spiral/></geometry></planView></road>'
    road = (
        f'<road id="1"><planView>{geometry}</planView><elevationProfile>{profile}</elevationProfile></road>'
    )
    (tmp_path / "straight.xodr").write_text(f"<OpenDRIVE>{other}{road}</OpenDRIVE>")
    if reason is None:
        (logic,) = (one for one in imported(path).ignored if one.element == "LogicFile")
        assert logic.reason == "nothing but its being straight and level was looked at"
    else:
        assert reason in refused(path)


def test_wishes_that_cannot_be_met() -> None:
    with pytest.raises(ConfigError, match="--ego: unknown vehicle 'Leader'; did you mean 'Lead'"):
        imported(LEAD_BRAKES, ego="Leader")
    with pytest.raises(ConfigError, match="--expect: unknown outcome 'impact'"):
        import_scenario(LEAD_BRAKES, None, ImportOptions(expect="impact"))
    for duration_s in (0.0, -1.0, 3601.0, float("nan")):
        with pytest.raises(
            ConfigError, match=r"--duration: found .*, allowed is more than 0 and at most 3600"
        ):
            imported(LEAD_BRAKES, duration_s=duration_s)
    with pytest.raises(ConfigError, match=r"nowhere\.xosc: cannot be read: No such file"):
        imported(Path("nowhere.xosc"))


# -- nothing is dropped unseen


def test_every_element_is_read_or_ignored_with_a_word_or_refused(tmp_path: Path) -> None:
    """Each element in turn gets an unknown name: the import fails, or says that it is ignored."""
    text = LEAD_BRAKES.read_text()
    ignored = {one.line for one in imported(LEAD_BRAKES).ignored}
    inside = _lines_inside(text, ignored)
    lines = text.splitlines(keepends=True)
    seen = 0
    for number, line in enumerate(lines, 1):
        if "<" not in line or line.strip().startswith(("</", "<!", "<?")) or number in inside:
            continue
        tag = line.strip()[1:].split()[0].rstrip(">/")
        strange = line.replace(f"<{tag}", "<Strange", 1).replace(f"</{tag}>", "</Strange>")
        rest = lines[number:]
        if not (line.rstrip().endswith("/>") or f"</{tag}>" in line):
            close = next(i for i, later in enumerate(rest) if later.startswith(_indent(line) + f"</{tag}>"))
            rest = [*rest[:close], rest[close].replace(tag, "Strange"), *rest[close + 1 :]]
        assert _import_text(tmp_path, "".join([*lines[: number - 1], strange, *rest])) is None, (number, line)
        seen += 1
    assert seen > 50


def test_every_attribute_is_read_or_a_label_or_refused(tmp_path: Path) -> None:
    """Each attribute in turn gets an unknown name: the import fails."""
    text = LEAD_BRAKES.read_text()
    inside = _lines_inside(text, {one.line for one in imported(LEAD_BRAKES).ignored})
    lines = text.splitlines(keepends=True)
    for number, line in enumerate(lines, 1):
        if line.strip().startswith(("<!", "<?")) or number in inside:
            continue
        for part in line.split()[1:]:
            if (name := part.partition("=")[0]) + "=" in part:
                strange = line.replace(f" {name}=", f" strange_{name}=", 1)
                assert (
                    _import_text(tmp_path, "".join([*lines[: number - 1], strange, *lines[number:]])) is None
                ), line


def _indent(line: str) -> str:
    return line[: len(line) - len(line.lstrip())]


def _lines_inside(text: str, begins: set[int]) -> set[int]:
    """The lines of the elements that begin in `begins`, to their ends."""
    lines = text.splitlines()
    found: set[int] = set()
    for begin in begins:
        first = lines[begin - 1]
        found.add(begin)
        if first.rstrip().endswith("/>"):
            continue
        tag = first.strip()[1:].split()[0].rstrip(">")
        close = next(
            i for i, line in enumerate(lines[begin:], begin + 1) if line == f"{_indent(first)}</{tag}>"
        )
        found |= set(range(begin, close + 1))
    return found


def _import_text(folder: Path, text: str) -> ImportedFile | None:
    """The import of a file with this text; None if it is refused."""
    path = folder / LEAD_BRAKES.name
    path.write_text(text)
    try:
        return imported(path)
    except ConfigError:
        return None

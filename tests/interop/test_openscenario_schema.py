"""The schema of OpenSCENARIO: what it refuses, with the line and what is allowed, and that it is ASAM's."""

import importlib.util
import shutil
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.core.errors import ConfigError
from aftbed.interop.openscenario.document import Element, parse_tree
from aftbed.interop.openscenario.importer import ImportOptions, import_scenario
from aftbed.interop.openscenario.schema import (
    AnyOrder,
    Child,
    Content,
    InOrder,
    OneOf,
    Repeated,
    enums,
    types,
    violations,
)

SLOW_LEAD: Final = Path(__file__).parent / "xosc" / "slow_lead.xosc"
XSDS: Final = importlib.util.find_spec("qc_openscenario")  # not imported: it would import much more
needs_xsds = pytest.mark.skipif(
    XSDS is None,
    reason="ASAM's XSDs are not installed: pip install -e '.[osc]'",
)


def found(text: str) -> list[str]:
    """What a tree has against the row of its name, each with its line."""
    root = parse_tree(text.encode(), "a.xosc")
    return [f"{one.element.line}: {one.element.tag}: {one.reason}" for one in violations(root, root.tag)]


INIT: Final = "<Init><Actions/></Init>"
BOX: Final = '<Dimensions height="1" length="1" width="1"/>'
LANE: Final = '<LanePosition roadId="1" laneId="1" s="1"/>'
MISTAKES: Final = {
    f"<Storyboard>\n<StopTrigger/>\n{INIT}</Storyboard>": "2: StopTrigger: not allowed here in Storyboard,"
    " allowed is Init",
    f"<Storyboard>{INIT}\n{INIT}</Storyboard>": "2: Init: not allowed here in Storyboard,"
    " allowed is Story or StopTrigger or its end",
    "<Storyboard/>": "1: Storyboard: found nothing, allowed is Init",
    "<Trigger>\n<Condtion/></Trigger>": "2: Condtion: not allowed here in Trigger,"
    " allowed is ConditionGroup or its end",
    "<SpeedActionTarget/>": "1: SpeedActionTarget: found nothing,"
    " allowed is RelativeTargetSpeed or AbsoluteTargetSpeed",
    f"<Position>{LANE}\n{LANE}</Position>": "2: LanePosition: not allowed here in Position,"
    " allowed is its end",
    "<AbsoluteTargetSpeed/>": "1: AbsoluteTargetSpeed: attribute 'value' is missing",
    '<AbsoluteTargetSpeed value="fast"/>': "1: AbsoluteTargetSpeed: value: found 'fast', allowed is a number",
    '<AbsoluteTargetSpeed value="1" unit="m"/>': "1: AbsoluteTargetSpeed: attribute 'unit' is not"
    " expected here, allowed is value",
    '<TransitionDynamics dynamicsDimension="time" dynamicsShape="liner" value="1"/>': "1: TransitionDynamics:"
    " dynamicsShape: found 'liner', allowed is one of cubic, linear, sinusoidal, step",
    '<Actors selectTriggeringEntities="no"/>': "1: Actors: selectTriggeringEntities: found 'no',"
    " allowed is true or false",
    '<RelativeLanePosition entityRef="Ego" dLane="0.5"/>': "1: RelativeLanePosition: dLane: found '0.5',"
    " allowed is a whole number",
    '<FileHeader revMajor="-1" revMinor="2"/>': "1: FileHeader: revMajor: found '-1',"
    " allowed is a whole number",
}


@pytest.mark.parametrize("text", MISTAKES)
def test_what_does_not_fit_is_told_with_what_is_allowed(text: str) -> None:
    assert found(text) == [MISTAKES[text]]


@pytest.mark.parametrize(
    "text",
    [
        '<AbsoluteTargetSpeed value="$Speed"/>',
        '<AbsoluteTargetSpeed value="${$Speed / 3.6}"/>',
        '<AbsoluteTargetSpeed value="-1.5e1"/>',
        f'<BoundingBox>{BOX}<Center x="1" y="1" z="1"/></BoundingBox>',
        '<MiscObject mass="1" miscObjectCategory="pole"><BoundingBox><Center x="1" y="1" z="1"/>'
        f"{BOX}</BoundingBox></MiscObject>",
        '<FileHeader revMajor="1" revMinor="2"/>',
    ],
)
def test_parameters_any_order_and_what_cannot_matter_fit(text: str) -> None:
    """Properties may be missing, as may author and date: nothing of the drive rests on them."""
    assert found(text) == []


def beside_catalogs(folder: Path, text: str) -> Path:
    """A file with this text."""
    (folder / "catalogs").symlink_to(SLOW_LEAD.parent / "catalogs")
    path = folder / "a.xosc"
    path.write_text(text)
    return path


def test_all_of_a_file_is_told_at_once(tmp_path: Path) -> None:
    text = SLOW_LEAD.read_text()
    for old, new in (('value="15"', 'value="fast"'), ("<StopTrigger/>", "<StopTriger/>")):
        assert old in text
        text = text.replace(old, new, 1)
    path = beside_catalogs(tmp_path, text)
    with pytest.raises(ConfigError) as refused:
        import_scenario(path, None, ImportOptions(ego="Host"))
    assert "2 elements are not supported" in str(refused.value)
    assert "AbsoluteTargetSpeed: value: found 'fast', allowed is a number" in str(refused.value)
    assert "StopTriger: not allowed here in Storyboard, allowed is Story or StopTrigger" in str(refused.value)


def test_an_empty_act_as_in_files_of_esmini_changes_nothing(tmp_path: Path) -> None:
    act = '<Story name="s"><Act name="a"></Act></Story>'
    path = beside_catalogs(tmp_path, SLOW_LEAD.read_text().replace("<StopTrigger/>", f"{act}<StopTrigger/>"))
    assert import_scenario(path, None, ImportOptions(ego="Host")).variations


def test_an_entry_of_a_catalog_is_held_against_it(tmp_path: Path) -> None:
    """Of the file of the catalog, with its line there."""
    shutil.copytree(SLOW_LEAD.parent / "catalogs", tmp_path / "catalogs")
    (cars,) = (tmp_path / "catalogs").iterdir()
    assert 'vehicleCategory="car"' in cars.read_text()
    heavy = 'vehicleCategory="car" mass="heavy"'
    cars.write_text(cars.read_text().replace('vehicleCategory="car"', heavy))
    (tmp_path / "a.xosc").write_text(SLOW_LEAD.read_text())
    with pytest.raises(ConfigError, match=r"cars.xosc: line \d+: Vehicle: mass: found 'heavy'"):
        import_scenario(tmp_path / "a.xosc", None, ImportOptions(ego="Host"))


def test_what_is_ignored_is_not_held_against_it(tmp_path: Path) -> None:
    """An act that never starts, with a mistake in it."""
    never = '<ParameterCondition parameterRef="LeadCar" rule="equalTo" value="none"/>'
    start = (
        '<StartTrigger><ConditionGroup><Condition name="c" delay="0" conditionEdge="none">'
        f"<ByValueCondition>{never}</ByValueCondition></Condition></ConditionGroup></StartTrigger>"
    )
    act = f'<Story name="s"><Act name="a"><Nonsense/>{start}</Act></Story>'
    text = SLOW_LEAD.read_text()
    path = beside_catalogs(tmp_path, text.replace("<StopTrigger/>", f"{act}<StopTrigger/>"))
    assert import_scenario(path, None, ImportOptions(ego="Host")).variations


def grown(tag: str, inner: list[Element]) -> Element:
    element = Element("a", 1, tag, {"name": "x", "value": "\u0663"})
    element.children = inner
    return element


NAMES: Final = sorted({*types(), *(tag for row in types().values() for tag in row.types)})
TREES: Final = st.recursive(
    st.builds(lambda tag: Element("a", 1, tag, {}), st.sampled_from(NAMES)),
    lambda inner: st.builds(grown, st.sampled_from(NAMES), st.lists(inner, max_size=4)),
    max_leaves=12,
)


@given(TREES, st.sampled_from(NAMES))
def test_any_tree_gets_an_answer(tree: Element, name: str) -> None:
    assert all(one.reason and one.lineage[-1] is one.element for one in violations(tree, name))


# -- beside ASAM's -------------------------------------------------------------------------------------

XSD: Final = "{http://www.w3.org/2001/XMLSchema}"
PARTS: Final = tuple(XSD + name for name in ("element", "group", "sequence", "choice", "all"))
KINDS: Final = {
    "Double": "number",
    "Int": "int",
    "UnsignedInt": "count",
    "UnsignedShort": "count",
    "Boolean": "flag",
    "DateTime": "",
    "String": "",
}
MAY_LACK: Final = (("TransitionDynamics", "value"),)  # esmini's steps have none, and need none
MAY_BE_EMPTY: Final = ("Story", "Act", "Maneuver", "Private")  # as an act of esmini's is
READ_ELSEWHERE: Final = "ParameterDeclarations"  # by `expression`, before


class Standard:
    """One of ASAM's XSDs."""

    def __init__(self, version: str) -> None:
        assert XSDS is not None and XSDS.submodule_search_locations
        path = Path(XSDS.submodule_search_locations[0]) / "schema" / version / "OpenSCENARIO.xsd"
        root = ET.fromstring(path.read_text("utf-8-sig"))
        self.named = {(one.tag.removeprefix(XSD), one.get("name", "")): one for one in root}

    def attributes(self, name: str) -> dict[str, tuple[str, bool]]:
        found = self.named["complexType", name].iter(f"{XSD}attribute")
        return {one.get("name", ""): (one.get("type", ""), one.get("use") == "required") for one in found}

    def words(self, name: str) -> tuple[str, ...]:
        return tuple(one.get("value", "") for one in self.named["simpleType", name].iter(f"{XSD}enumeration"))

    def content(self, name: str) -> Content:
        return self._parts(self.named["complexType", name])

    def tags(self, name: str) -> Iterator[str]:
        yield from (child.tag for child in tags_in(self.content(name)))

    def _parts(self, element: ET.Element) -> Content:
        parts = [self._part(one) for one in element if one.tag in PARTS]
        return parts[0] if len(parts) == 1 else InOrder(tuple(filter(None, parts)))

    def _part(self, element: ET.Element) -> Content:
        kind = element.tag.removeprefix(XSD)
        found: Content
        if kind == "element":
            found = Child(element.get("name", ""), element.get("type", ""))
        elif kind == "group":
            found = self._parts(self.named["group", element.get("ref", "")])
        else:
            shapes = {"sequence": InOrder, "choice": OneOf, "all": AnyOrder}
            items = (
                self._part(one) for one in element if one.tag in PARTS and one.get("name") != READ_ELSEWHERE
            )
            found = shapes[kind](tuple(items))
            found = found.items[0] if len(found.items) == 1 else found
        optional, many = element.get("minOccurs") == "0", element.get("maxOccurs") == "unbounded"
        return Repeated(found, optional, many) if optional or many else found


def tags_in(content: Content) -> Iterator[Child]:
    match content:
        case Child():
            yield content
        case Repeated(item, _, _):
            yield from tags_in(item)
        case InOrder(items) | OneOf(items) | AnyOrder(items):
            for item in items:
                yield from tags_in(item)


def may_be_empty(content: Content) -> Content:
    """The same, where the first of its items need not be there."""
    match content:
        case InOrder((first, *others)):
            return InOrder((may_be_empty(first), *others))
        case Repeated(item, _, many):
            return Repeated(item, True, many)
        case _:
            raise AssertionError(content)


@needs_xsds
def test_the_table_is_asams_of_version_1_3() -> None:
    standard = Standard("1.3.0")
    for name, row in types().items():
        content = standard.content(name)
        assert row.content == (may_be_empty(content) if name in MAY_BE_EMPTY else content), name
        own = {one.name: one for one in row.attributes}
        theirs = standard.attributes(name)
        assert own.keys() == theirs.keys(), name
        for attribute, (kind, required) in theirs.items():
            may_lack = not required or (name, attribute) in MAY_LACK
            assert (own[attribute].kind, own[attribute].optional) == (KINDS.get(kind, kind), may_lack), (
                f"{name}.{attribute}"
            )
    for name, words in enums().items():
        assert words == standard.words(name), name


@needs_xsds
@pytest.mark.parametrize("version", ["1.0.0", "1.1.1", "1.2.0"])
def test_what_an_older_version_has_is_in_the_table(version: str) -> None:
    standard = Standard(version)
    for name, row in types().items():
        if ("complexType", name) in standard.named:
            assert set(standard.tags(name)) <= {*row.types, READ_ELSEWHERE}, name
            own = {one.name: one for one in row.attributes}
            for attribute, (_, required) in standard.attributes(name).items():
                assert own[attribute].optional or required, f"{name}.{attribute}"
    for name, words in enums().items():
        if ("simpleType", name) in standard.named:
            assert set(standard.words(name)) <= set(words), name

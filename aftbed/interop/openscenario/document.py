"""The XML tree of an OpenSCENARIO file, and the account of the elements that the importer did not use.

The file is untrusted. expat parses it; a DOCTYPE is refused at its first character, and with it every entity
that could expand without end or be fetched from elsewhere. Size, depth and number of elements are limited.

An `Element` knows its line. Its attributes and children are read by name, and it records which were read.
Errors name file, line and element.

An OpenSCENARIO file can describe far more than one car behind another on a straight road. Nothing of it is
dropped silently. Each element is

    used      the importer reads it
    ignored   it cannot change a longitudinal drive; printed, with the reason (`IGNORED`)
    refused   it could; the import fails with its line and the reason (`REFUSED`)

An element that is in neither table and was not read is refused as well: it is new in a later version of the
standard, or a mistake in the file.
"""

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final
from xml.parsers import expat

import msgspec

from aftbed.core.errors import ConfigError, unknown

FILE_BYTES_MAX: Final = 4_000_000
DEPTH_MAX: Final = 60
ELEMENTS_MAX: Final = 100_000
SHOWN_CHARACTERS_MAX: Final = 60
_FLAGS: Final = {"true": True, "1": True, "false": False, "0": False}


class Element:
    """An element of the file `path` that starts in `line`. `text` is its character data, stripped.

    `visited`: it was read, but perhaps not its attributes and children. `ignored`: why it cannot, with all
    below it, change the drive.
    """

    def __init__(self, path: str, line: int, tag: str, attributes: dict[str, str]) -> None:
        self.path = path
        self.line = line
        self.tag = tag
        self.attributes = attributes
        self.children: list[Element] = []
        self.text = ""
        self.ignored: str | None = None
        self.visited = False
        self._read: set[str] = set()

    def error(self, reason: str) -> ConfigError:
        """An error at this element; the message has file, line and tag."""
        return ConfigError(f"{self.path}: line {self.line}: {self.tag}: {reason}")

    def wrong(self, name: str, allowed: str) -> ConfigError:
        """An error about the value of the attribute `name`."""
        found = self.attributes.get(name)
        shown = "nothing" if found is None else repr(found[:SHOWN_CHARACTERS_MAX])
        more = "..." if found is not None and len(found) > SHOWN_CHARACTERS_MAX else ""
        return self.error(f"{name}: found {shown}{more}, allowed is {allowed}")

    # -- attributes

    def has(self, name: str) -> bool:
        """Whether the attribute exists. Does not count as reading it."""
        return name in self.attributes

    def word(self, name: str, default: str | None = None) -> str:
        """The value of an attribute, as text. Required if there is no `default`."""
        self._read.add(name)
        found = self.attributes.get(name, default)
        if found is None:
            raise self.error(f"attribute {name!r} is missing")
        return found

    def choice(self, name: str, allowed: tuple[str, ...], default: str | None = None) -> str:
        found = self.word(name, default)
        if found not in allowed:
            raise self.error(f"{name}: {unknown('value', found[:SHOWN_CHARACTERS_MAX], allowed)}")
        return found

    def number(self, name: str, default: float | None = None) -> float:
        number = finite(self.word(name, None if default is None else repr(default)))
        if number is None:
            raise self.wrong(name, "a number")
        return number

    def flag(self, name: str, default: bool | None = None) -> bool:
        found = _FLAGS.get(self.word(name, None if default is None else str(default).lower()))
        if found is None:
            raise self.wrong(name, "true or false")
        return found

    # -- children

    def every(self, *tags: str) -> list["Element"]:
        """The children with these tags, in the order of the file."""
        found = [child for child in self.children if child.tag in tags]
        for child in found:
            child.visited = True
        return found

    def maybe(self, *tags: str) -> "Element | None":
        """The child with one of these tags, or None. Two are an error."""
        found = self.every(*tags)
        if len(found) > 1:
            raise found[1].error(f"stands twice in {self.tag}, of line {self.line}")
        return found[0] if found else None

    def one(self, *tags: str) -> "Element":
        """The child with one of these tags. None or two are an error."""
        found = self.maybe(*tags)
        if found is None:
            there = ", ".join(child.tag for child in self.children[:5]) or "nothing"
            raise self.error(f"found {there}, allowed is {' or '.join(tags)}")
        return found

    def walk(self) -> Iterator["Element"]:
        """This element and all below it, in the order of the file."""
        yield self
        for child in self.children:
            yield from child.walk()

    def unread_attributes(self) -> list[str]:
        """The attributes that were not read and may have an effect."""
        return [
            name
            for name in self.attributes
            if name not in self._read
            and name not in LABELS
            and name != "xmlns"
            and not name.startswith(("xmlns:", "xsi:", "xml:"))
        ]


def finite(text: str) -> float | None:
    """`text` as a finite number in XML notation, or None."""
    try:
        number = float(text) if text.isascii() and "_" not in text else math.nan
    except ValueError:
        return None
    return number if math.isfinite(number) else None


# -- parsing


def read_tree(path: Path) -> Element:
    """The root of the XML file `path`."""
    try:
        with path.open("rb") as file:
            data = file.read(FILE_BYTES_MAX + 1)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    return parse_tree(data, str(path))


def parse_tree(data: bytes, name: str) -> Element:
    """The root of the XML document `data`. Raises ConfigError, which calls it `name`."""
    if len(data) > FILE_BYTES_MAX:
        raise ConfigError(f"{name}: more than the {FILE_BYTES_MAX} bytes that are allowed")
    builder = _Builder(name)
    try:
        builder.parser.Parse(data, True)
    except expat.ExpatError as error:
        raise ConfigError(f"{name}: line {error.lineno}: not XML: {expat.ErrorString(error.code)}") from error
    except (LookupError, ValueError) as error:  # the encoding that the file claims to have
        raise ConfigError(f"{name}: line 1: not XML: {error}") from error
    assert builder.root is not None, "expat refuses a document without an element"
    return builder.root


class _Builder:
    """The handlers of an expat parser."""

    def __init__(self, name: str) -> None:
        self.root: Element | None = None
        self.parser = expat.ParserCreate()
        self.parser.buffer_text = True
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = lambda _tag: self._open.pop()
        self.parser.CharacterDataHandler = self._data
        self.parser.StartDoctypeDeclHandler = self._doctype
        self._name = name
        self._open: list[Element] = []
        self._elements = 0

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        line = self.parser.CurrentLineNumber
        element = Element(self._name, line, tag[:SHOWN_CHARACTERS_MAX], attributes)
        self._elements += 1
        if self._elements > ELEMENTS_MAX:
            raise element.error(f"more than the {ELEMENTS_MAX} elements that are allowed")
        if len(self._open) >= DEPTH_MAX:
            raise element.error(f"deeper than the {DEPTH_MAX} levels that are allowed")
        if self._open:
            self._open[-1].children.append(element)
        else:
            self.root = element
        self._open.append(element)

    def _data(self, data: str) -> None:
        self._open[-1].text = (self._open[-1].text + data).strip()[: SHOWN_CHARACTERS_MAX + 1]

    def _doctype(self, *_arguments: object) -> None:
        line = self.parser.CurrentLineNumber
        raise ConfigError(f"{self._name}: line {line}: DOCTYPE: not allowed, it may define entities")


# -- the account of unused elements


REFUSED_SHOWN_MAX: Final = 20
TRIGGER_UNKNOWN: Final = "a trigger whose moment does not follow from the start"


def _by_tag(tags_by_reason: Mapping[str, str]) -> dict[str, str]:
    return {tag: reason for reason, tags in tags_by_reason.items() for tag in tags.split()}


REFUSED: Final[Mapping[str, str]] = _by_tag(
    {
        "lateral motion; the cars keep to one lane of a straight road": "LateralAction",
        "routes, trajectories and places off the straight road": (
            "RoutingAction GeoPosition RoutePosition TrajectoryPosition"
        ),
        "one car ahead is all there is: no other road users or objects": (
            "Pedestrian MiscObject ExternalObjectReference EntitySelection Trailer TrailerAction "
            "EntityAction TrafficAction"
        ),
        "traffic signals": (
            "TrafficSignalController InfrastructureAction TrafficSignalCondition "
            "TrafficSignalControllerCondition"
        ),
        "controllers: the storyboard moves the car ahead, and the function brakes the ego": (
            "ObjectController ControllerAction ActivateControllerAction"
        ),
        "the speed of the car ahead changes by a SpeedAction to 0 only": (
            "LongitudinalDistanceAction SpeedProfileAction SynchronizeAction"
        ),
        "a car that sensors do not see": "VisibilityAction",
        "commands that only one simulator knows": "UserDefinedAction",
        "values that change while the scenario runs": "ParameterAction VariableAction",
        TRIGGER_UNKNOWN: (
            "ParameterCondition VariableCondition UserDefinedValueCondition TimeOfDayCondition "
            "AccelerationCondition AngleCondition RelativeAngleCondition DistanceCondition SpeedCondition "
            "EndOfRoadCondition OffroadCondition ReachPositionCondition RelativeClearanceCondition "
            "RelativeSpeedCondition"
        ),
    }
)
IGNORED: Final[Mapping[str, str]] = _by_tag(
    {
        "for people and tools": "License Properties",
        "read where an entry is needed": "CatalogLocations",
        "for pictures": "SceneGraphFile UsedArea AppearanceAction",
        "aftbed has its own model of the car and its brakes": "Performance Axles TrailerHitch TrailerCoupler",
        "the radar sees through any weather, and the air stands still": "TimeOfDay Weather",
        "nothing here depends on a variable": "VariableDeclarations",
        "nothing here depends on a monitor": "MonitorDeclarations SetMonitorAction",
    }
)
CONTROLLERS: Final = ("ObjectController", "ControllerAction", "ActivateControllerAction")
LABELS: Final = frozenset(("name", "description", "author", "date", "model3d"))  # without any effect


class IgnoredElement(msgspec.Struct, frozen=True):
    """An element that cannot change the drive, and its file."""

    path: str
    line: int
    element: str
    reason: str


def refuse(root: Element) -> None:
    """Raise ConfigError with every element of the tree whose tag is in `REFUSED`."""
    _raise(root, list(_refused(root)))


def account(root: Element) -> list[IgnoredElement]:
    """The ignored elements. Raises ConfigError with all that is unread and may have an effect."""
    ignored: list[IgnoredElement] = []
    refused: list[tuple[Element, str]] = []
    root.visited = True
    _account(root, ignored, refused)
    _raise(root, refused)
    return ignored


def _refused(element: Element) -> Iterator[tuple[Element, str]]:
    if element.ignored is not None or element.tag in IGNORED:
        return
    if element.tag in REFUSED:
        yield element, REFUSED[element.tag]
        return
    for child in element.children:
        yield from _refused(child)


def _account(element: Element, ignored: list[IgnoredElement], refused: list[tuple[Element, str]]) -> None:
    reason = element.ignored if element.visited else element.ignored or IGNORED.get(element.tag)
    if reason is not None:
        ignored.append(IgnoredElement(element.path, element.line, element.tag, reason))
        return
    if not element.visited:
        refused.append((element, REFUSED.get(element.tag, "not expected here")))
        return
    strange = element.unread_attributes()
    refused += [(element, f"attribute {name!r} is not expected here") for name in strange]
    if element.text:
        refused.append((element, "text is not expected here"))
    for child in element.children:
        _account(child, ignored, refused)


def _raise(root: Element, refused: list[tuple[Element, str]]) -> None:
    if not refused:
        return
    lines = [f"  line {one.line}: {one.tag}: {reason}" for one, reason in refused]
    more = len(lines) - REFUSED_SHOWN_MAX
    shown = lines[:REFUSED_SHOWN_MAX] + ([f"  and {more} more"] if more > 0 else [])
    count = "1 element is" if len(lines) == 1 else f"{len(lines)} elements are"
    raise ConfigError("\n".join([f"{root.path}: {count} not supported", *shown]))

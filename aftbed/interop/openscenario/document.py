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
standard, or a mistake in the file. Each refusal has a `Cause`, by which the files of a folder are counted.
"""

import math
from collections.abc import Iterator, Mapping
from enum import Enum
from pathlib import Path
from typing import Final, TypeVar
from xml.parsers import expat

import msgspec

from aftbed.core.errors import ConfigError, unknown

FILE_BYTES_MAX: Final = 4_000_000
DEPTH_MAX: Final = 60
ELEMENTS_MAX: Final = 100_000
SHOWN_CHARACTERS_MAX: Final = 60
_FLAGS: Final = {"true": True, "1": True, "false": False, "0": False}


# -- errors


class Cause(Enum):
    """What kind of thing a file is refused for. Of several, the first in this order is the file's."""

    UNREADABLE = "unreadable"
    CATALOG = "catalog"
    VERSION = "version"
    LATERAL = "lateral"
    ROAD = "road"
    ROAD_USERS = "road_users"
    SIMULATOR = "simulator"
    CONTROLLER = "controller"
    SPEED = "speed"
    TRIGGER = "trigger"
    RANGE = "range"
    MISSING = "missing"
    MISTAKE = "mistake"


CAUSES: Final[Mapping[Cause, str]] = {
    Cause.UNREADABLE: "not a readable XML file",
    Cause.CATALOG: "a catalog, no scenario: read where an entry of it is needed",
    Cause.VERSION: "not OpenSCENARIO XML 1.0 to 1.3",
    Cause.LATERAL: "lateral motion, or a car that heads elsewhere than the ego",
    Cause.ROAD: "a road that bends or climbs, or places on different roads",
    Cause.ROAD_USERS: "road users besides the ego and one ahead",
    Cause.SIMULATOR: "something that only one simulator knows",
    Cause.CONTROLLER: "a controller that moves another car than the ego",
    Cause.SPEED: "a change of speed that a scenario cannot express",
    Cause.TRIGGER: "a moment that does not follow from the start",
    Cause.RANGE: "a value out of the range of a scenario",
    Cause.MISSING: "a file that is needed and is not there",
    Cause.MISTAKE: "a mistake in the file, or an element that is not of the standard",
}


class RefusedError(ConfigError):
    """What a file is refused for: `reason` without its place, and `line` of `path`, 0 for no line."""

    def __init__(self, text: str, path: str, line: int, reason: str, cause: Cause) -> None:
        super().__init__(text)
        self.path = path
        self.line = line
        self.reason = reason
        self.cause = cause


class Element:
    """An element of the file `path` that starts in `line`. `text` is its character data, stripped.

    `visited`: it was read, but perhaps not its attributes and children. `ignored`: why it cannot, with all
    below it, change the drive. `parameter`: the value of the parameter that a ParameterCondition compares.
    """

    def __init__(self, path: str, line: int, tag: str, attributes: dict[str, str]) -> None:
        self.path = path
        self.line = line
        self.tag = tag
        self.attributes = attributes
        self.children: list[Element] = []
        self.text = ""
        self.ignored: str | None = None
        self.parameter: str | None = None
        self.visited = False
        self._read: set[str] = set()

    def error(self, reason: str, cause: Cause = Cause.MISTAKE) -> RefusedError:
        """An error at this element; the message has file, line and tag."""
        reason = f"{self.tag}: {reason}"
        text = f"{self.path}: line {self.line}: {reason}"
        return RefusedError(text, self.path, self.line, reason, cause)

    def wrong(self, name: str, allowed: str, cause: Cause = Cause.MISTAKE) -> RefusedError:
        """An error about the value of the attribute `name`."""
        found = self.attributes.get(name)
        shown = "nothing" if found is None else repr(found[:SHOWN_CHARACTERS_MAX])
        more = "..." if found is not None and len(found) > SHOWN_CHARACTERS_MAX else ""
        return self.error(f"{name}: found {shown}{more}, allowed is {allowed}", cause)

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
        raise _unreadable(str(path), 0, f"cannot be read: {error.strerror}") from error
    return parse_tree(data, str(path))


def parse_tree(data: bytes, name: str) -> Element:
    """The root of the XML document `data`. Raises ConfigError, which calls it `name`."""
    if len(data) > FILE_BYTES_MAX:
        raise _unreadable(name, 0, f"more than the {FILE_BYTES_MAX} bytes that are allowed")
    builder = _Builder(name)
    try:
        builder.parser.Parse(data, True)
    except expat.ExpatError as error:
        reason = f"not XML: {expat.ErrorString(error.code)}"
        raise _unreadable(name, error.lineno, reason) from error
    except (LookupError, ValueError) as error:  # the encoding that the file claims to have
        raise _unreadable(name, 1, f"not XML: {error}") from error
    assert builder.root is not None, "expat refuses a document without an element"
    return builder.root


def _unreadable(name: str, line: int, reason: str) -> RefusedError:
    place = f"{name}: line {line}" if line else name
    return RefusedError(f"{place}: {reason}", name, line, reason, Cause.UNREADABLE)


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
            raise element.error(f"more than the {ELEMENTS_MAX} elements that are allowed", Cause.UNREADABLE)
        if len(self._open) >= DEPTH_MAX:
            raise element.error(f"deeper than the {DEPTH_MAX} levels that are allowed", Cause.UNREADABLE)
        if self._open:
            self._open[-1].children.append(element)
        else:
            self.root = element
        self._open.append(element)

    def _data(self, data: str) -> None:
        self._open[-1].text = (self._open[-1].text + data).strip()[: SHOWN_CHARACTERS_MAX + 1]

    def _doctype(self, *_arguments: object) -> None:
        line = self.parser.CurrentLineNumber
        raise _unreadable(self._name, line, "DOCTYPE: not allowed, it may define entities")


# -- the account of unused elements


REFUSED_SHOWN_MAX: Final = 20
UNEXPECTED: Final = "not expected here"


_Reason = TypeVar("_Reason")


def _by_tag(tags_by_reason: Mapping[_Reason, str]) -> dict[str, _Reason]:
    return {tag: reason for reason, tags in tags_by_reason.items() for tag in tags.split()}


REFUSED: Final[Mapping[str, tuple[Cause, str]]] = _by_tag(
    {
        (Cause.LATERAL, "lateral motion; the cars keep to one lane of a straight road"): "LateralAction",
        (Cause.LATERAL, "routes, trajectories and places off the straight road"): (
            "RoutingAction GeoPosition RoutePosition TrajectoryPosition"
        ),
        (Cause.ROAD_USERS, "one car ahead is all there is: no other road users or objects"): (
            "ExternalObjectReference EntitySelection TrailerAction EntityAction TrafficAction"
        ),
        (
            Cause.CONTROLLER,
            "controllers: the storyboard moves the car ahead, and the function brakes the ego",
        ): ("ObjectController ControllerAction ActivateControllerAction"),
        (Cause.SPEED, "the speed of the car ahead changes by a SpeedAction only"): (
            "SpeedProfileAction SynchronizeAction"
        ),
        (Cause.SIMULATOR, "a car that sensors do not see"): "VisibilityAction",
        (Cause.SIMULATOR, "commands that only one simulator knows"): "UserDefinedAction",
        (Cause.TRIGGER, "values that change while the scenario runs"): "ParameterAction",
    }
)
IGNORED: Final[Mapping[str, str]] = _by_tag(
    {
        "for people and tools": "License Properties",
        "read where an entry is needed": "CatalogLocations",
        "for pictures": "SceneGraphFile UsedArea AppearanceAction",
        "aftbed has its own model of the car and its brakes": "Performance Axles TrailerHitch TrailerCoupler",
        "the radar sees through any weather, and the air stands still": "TimeOfDay Weather",
        "the function brakes for cars, not for signals": "TrafficSignals InfrastructureAction",
        "nothing here depends on a monitor": "MonitorDeclarations SetMonitorAction",
    }
)
LABELS: Final = frozenset(("name", "description", "author", "date", "model3d"))  # without any effect


class IgnoredElement(msgspec.Struct, frozen=True):
    """An element that cannot change the drive, and its file."""

    path: str
    line: int
    element: str
    reason: str


def refuse(root: Element) -> None:
    """Raise ConfigError with every element of the tree whose tag is in `REFUSED`."""
    raise_refused(root, list(_refused(root)))


def account(root: Element) -> list[IgnoredElement]:
    """The ignored elements. Raises ConfigError with all that is unread and may have an effect."""
    ignored: list[IgnoredElement] = []
    refused: list[tuple[Element, tuple[Cause, str]]] = []
    root.visited = True
    _account(root, ignored, refused)
    raise_refused(root, refused)
    return ignored


def _refused(element: Element) -> Iterator[tuple[Element, tuple[Cause, str]]]:
    if element.ignored is not None or element.tag in IGNORED:
        return
    if element.tag in REFUSED:
        yield element, REFUSED[element.tag]
        return
    for child in element.children:
        yield from _refused(child)


def _account(
    element: Element, ignored: list[IgnoredElement], refused: list[tuple[Element, tuple[Cause, str]]]
) -> None:
    reason = element.ignored if element.visited else element.ignored or IGNORED.get(element.tag)
    if reason is not None:
        ignored.append(IgnoredElement(element.path, element.line, element.tag, reason))
        return
    if not element.visited:
        refused.append((element, REFUSED.get(element.tag, (Cause.MISTAKE, UNEXPECTED))))
        return
    strange = element.unread_attributes()
    refused += [(element, (Cause.MISTAKE, f"attribute {name!r} is not expected here")) for name in strange]
    if element.text:
        refused.append((element, (Cause.MISTAKE, "text is not expected here")))
    for child in element.children:
        _account(child, ignored, refused)


def raise_refused(root: Element, refused: list[tuple[Element, tuple[Cause, str]]]) -> None:
    """Raise ConfigError with all of `refused`; its line, reason and cause are those of the weightiest."""
    if not refused:
        return
    lines = [
        f"  {'' if one.path == root.path else f'{one.path}: '}line {one.line}: {one.tag}: {reason}"
        for one, (_, reason) in refused
    ]
    more = len(lines) - REFUSED_SHOWN_MAX
    shown = lines[:REFUSED_SHOWN_MAX] + ([f"  and {more} more"] if more > 0 else [])
    count = "1 element is" if len(lines) == 1 else f"{len(lines)} elements are"
    text = "\n".join([f"{root.path}: {count} not supported", *shown])
    order = list(Cause)
    first, (cause, reason) = min(refused, key=lambda one: order.index(one[1][0]))
    raise RefusedError(text, first.path, first.line, f"{first.tag}: {reason}", cause)

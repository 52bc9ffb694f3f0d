"""What becomes of an element that the importer does not use: refused, or without meaning for this drive.

An OpenSCENARIO file can say far more than a drive of one car behind another on a straight road. Nothing
of that is dropped silently. Each element of the standard that may stand in a file is

    used      the importer reads it (`storyboard`, `placing`, `trigger`, `variations`)
    ignored   it cannot change a longitudinal drive; printed, with the reason
    refused   it could; the import fails and says where it stands, and why

and what is in neither table, and was not read, is refused as well: a new word of a later version of the
standard, or a mistake in the file.
"""

from collections.abc import Mapping
from typing import Final

import msgspec

from aftbed.core.errors import ConfigError
from aftbed.vehicle.xosc.tree import Element

REFUSED_SHOWN_MAX: Final = 20

_LATERAL: Final = "lateral motion; the cars keep to one lane of a straight road"
_ROUTES: Final = "routes, trajectories and places off the straight road"
_OTHERS: Final = "one car ahead is all there is: no other road users or objects"
_SIGNALS: Final = "traffic signals"
_CONTROLLER: Final = "controllers: the storyboard moves the car ahead, and the function brakes the ego"
_SPEED: Final = "the speed of the car ahead changes by a SpeedAction to 0 only"
_RUN_TIME: Final = "values that change while the scenario runs"
TRIGGER_UNKNOWN: Final = "a trigger whose moment does not follow from the start"

REFUSED: Final[Mapping[str, str]] = {
    "LateralAction": _LATERAL,
    "RoutingAction": _ROUTES,
    "GeoPosition": _ROUTES,
    "RoutePosition": _ROUTES,
    "TrajectoryPosition": _ROUTES,
    "Pedestrian": _OTHERS,
    "MiscObject": _OTHERS,
    "ExternalObjectReference": _OTHERS,
    "EntitySelection": _OTHERS,
    "Trailer": _OTHERS,
    "TrailerAction": _OTHERS,
    "EntityAction": _OTHERS,
    "TrafficAction": _OTHERS,
    "TrafficSignalController": _SIGNALS,
    "InfrastructureAction": _SIGNALS,
    "TrafficSignalCondition": _SIGNALS,
    "TrafficSignalControllerCondition": _SIGNALS,
    "ObjectController": _CONTROLLER,
    "ControllerAction": _CONTROLLER,
    "ActivateControllerAction": _CONTROLLER,
    "LongitudinalDistanceAction": _SPEED,
    "SpeedProfileAction": _SPEED,
    "SynchronizeAction": _SPEED,
    "VisibilityAction": "a car that sensors do not see",
    "UserDefinedAction": "commands that only one simulator knows",
    "ParameterAction": _RUN_TIME,
    "VariableAction": _RUN_TIME,
    "ParameterCondition": TRIGGER_UNKNOWN,
    "VariableCondition": TRIGGER_UNKNOWN,
    "UserDefinedValueCondition": TRIGGER_UNKNOWN,
    "TimeOfDayCondition": TRIGGER_UNKNOWN,
    "AccelerationCondition": TRIGGER_UNKNOWN,
    "AngleCondition": TRIGGER_UNKNOWN,
    "RelativeAngleCondition": TRIGGER_UNKNOWN,
    "DistanceCondition": TRIGGER_UNKNOWN,
    "EndOfRoadCondition": TRIGGER_UNKNOWN,
    "OffroadCondition": TRIGGER_UNKNOWN,
    "ReachPositionCondition": TRIGGER_UNKNOWN,
    "RelativeClearanceCondition": TRIGGER_UNKNOWN,
    "RelativeSpeedCondition": TRIGGER_UNKNOWN,
    "SpeedCondition": TRIGGER_UNKNOWN,
}

_TOOLS: Final = "for people and tools"
_DRAWN: Final = "for pictures"
_OWN_CAR: Final = "aftbed has its own model of the car and its brakes"
_AIR: Final = "the radar sees through any weather, and the air stands still"

IGNORED: Final[Mapping[str, str]] = {
    "License": _TOOLS,
    "Properties": _TOOLS,
    "CatalogLocations": "read where an entry is needed",
    "SceneGraphFile": _DRAWN,
    "UsedArea": _DRAWN,
    "AppearanceAction": _DRAWN,
    "Performance": _OWN_CAR,
    "Axles": _OWN_CAR,
    "TrailerHitch": _OWN_CAR,
    "TrailerCoupler": _OWN_CAR,
    "TimeOfDay": _AIR,
    "Weather": _AIR,
    "VariableDeclarations": "nothing here depends on a variable",
    "MonitorDeclarations": "nothing here depends on a monitor",
    "SetMonitorAction": "nothing here depends on a monitor",
}
CONTROLLERS: Final = ("ObjectController", "ControllerAction", "ActivateControllerAction")
LABELS: Final = frozenset(("name", "description", "author", "date", "model3d"))  # attributes that only name


class Ignored(msgspec.Struct, frozen=True):
    """An element that cannot change the drive, and the file in which it stands."""

    path: str
    line: int
    element: str
    reason: str


def refuse(root: Element) -> None:
    """Raise ConfigError with every element of the tree that is refused for what it is."""
    _raise(root, _refused(root))


def account(root: Element) -> list[Ignored]:
    """What was not read and has no meaning. Raises ConfigError with all that was not read and may have."""
    ignored: list[Ignored] = []
    refused: list[tuple[Element, str]] = []
    root.visit()
    _account(root, ignored, refused)
    _raise(root, refused)
    return ignored


def _refused(element: Element) -> list[tuple[Element, str]]:
    if element.ignored is not None or element.tag in IGNORED:
        return []
    if element.tag in REFUSED:
        return [(element, REFUSED[element.tag])]
    return [one for child in element.children for one in _refused(child)]


def _account(element: Element, ignored: list[Ignored], refused: list[tuple[Element, str]]) -> None:
    reason = element.ignored if element.visited() else element.ignored or IGNORED.get(element.tag)
    if reason is not None:
        ignored.append(Ignored(element.path, element.line, element.tag, reason))
        return
    if not element.visited():
        refused.append((element, REFUSED.get(element.tag, "not expected here")))
        return
    strange = [name for name in element.unread_attributes() if name not in LABELS]
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

"""Where the cars stand at the start: positions and lengths in, the gap between the bumpers out.

A position of OpenSCENARIO is that of a car's reference point, the middle of its rear axle. The gap that
matters to a radar is from bumper to bumper, so the bounding boxes are needed: in the file itself, or in
the vehicle catalog that it refers to.

Positions are compared in the frame in which they are given: along one lane, along one road, or in the
world, along the heading of the ego. Relative ones are taken from the other car. Two cars of different
frames, beside each other, turned against each other or on different levels are refused: the road is one
straight, level lane. Lanes that run against their road (`laneId` above 0) are refused too, because which
way "ahead" is there depends on the side of traffic, which only the road's own file knows.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.errors import unknown
from aftbed.vehicle.xosc.parameters import replaced_below
from aftbed.vehicle.xosc.tree import Element, read_tree
from aftbed.vehicle.xosc.words import refuse

VEHICLES: Final = ("car", "van", "truck", "bus", "motorbike")
BESIDE_M_MAX: Final = 0.01  # rounding of positions, not a place beside the lane
TURNED_RAD_MAX: Final = 0.001
LENGTH_M_MAX: Final = 100.0
CATALOG_FILES_MAX: Final = 100

_WORLD: Final = "the world"
_POSITIONS: Final = (
    "WorldPosition",
    "LanePosition",
    "RoadPosition",
    "RelativeLanePosition",
    "RelativeRoadPosition",
) + ("RelativeObjectPosition", "RelativeWorldPosition")


class Car(msgspec.Struct, frozen=True):
    """A car by its name; its bumpers are so far from its reference point."""

    name: str
    front_m: float
    rear_m: float


class Place(msgspec.Struct, frozen=True):
    """A reference point: metres along, across and above a frame, and where the car heads to in it."""

    frame: str
    along_m: float
    across_m: float
    above_m: float = 0.0
    heading_rad: float = 0.0


# -- the cars


def read_cars(root: Element) -> tuple[dict[str, Car], list[Element]]:
    """The cars of the file by name, in its order, and the entries of catalogs that were read for them."""
    found: dict[str, Car] = {}
    entries = []
    for thing in root.one("Entities").every("ScenarioObject"):
        name = thing.word("name")
        if name in found:
            raise thing.error(f"the name {name!r} stands twice")
        vehicle = thing.one("Vehicle", "CatalogReference")
        if vehicle.tag == "CatalogReference":
            vehicle = _entry(root, vehicle)
            refuse(vehicle)
            entries.append(vehicle)
        found[name] = _car(name, vehicle)
    return found, entries


def _car(name: str, vehicle: Element) -> Car:
    vehicle.choice("vehicleCategory", VEHICLES)
    for label in ("mass", "role"):
        vehicle.word(label, "")
    box = vehicle.one("BoundingBox")
    centre, size = box.one("Center"), box.one("Dimensions")
    for element, names in ((centre, ("y", "z")), (size, ("width", "height"))):
        for across in names:  # of no meaning ahead
            element.number(across, 0.0)
    length_m = size.number("length")
    if not 0.0 < length_m <= LENGTH_M_MAX:
        raise size.wrong("length", f"more than 0 and at most {LENGTH_M_MAX:g}")
    ahead_m = centre.number("x")
    return Car(name, ahead_m + length_m / 2, length_m / 2 - ahead_m)


def _entry(root: Element, reference: Element) -> Element:
    """The vehicle of a catalog to which `reference` refers."""
    catalog, name = reference.word("catalogName"), reference.word("entryName")
    assigned = reference.maybe("ParameterAssignments")
    values = {
        one.word("parameterRef").removeprefix("$"): one.word("value")
        for one in (assigned.every("ParameterAssignment") if assigned else [])
    }
    entries: list[str] = []
    for path in _catalog_files(root, reference):
        file = read_tree(path)
        for group in file.every("Catalog"):
            for vehicle in group.every("Vehicle") if group.word("name") == catalog else []:
                entries.append(vehicle.word("name"))
                if entries[-1] == name:
                    return replaced_below(vehicle, values)
    raise reference.error(str(unknown(f"entry of {catalog!r}", name, entries)))


def _catalog_files(root: Element, reference: Element) -> list[Path]:
    places = [
        directory.attributes.get("path", "")
        for locations in root.children
        if locations.tag == "CatalogLocations"
        for kind in locations.children
        if kind.tag == "VehicleCatalog"
        for directory in kind.children
    ]
    if not places:
        raise reference.error("found no VehicleCatalog in CatalogLocations; the gap needs the car's length")
    folder = Path(root.path).parent / places[0]
    try:
        files = sorted(path for path in folder.iterdir() if path.suffix == ".xosc" and path.is_file())
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a path"
        raise reference.error(f"catalog {str(folder)!r}: {reason}; the gap needs the car's length") from error
    return files[:CATALOG_FILES_MAX]


# -- the places


def gap_m(ego: Car, lead: Car, positions: Mapping[str, Element]) -> float:
    """Metres from the ego's front bumper to the rear bumper of the car ahead."""
    return distance_m(ego, lead, positions) - ego.front_m - lead.rear_m


def distance_m(ego: Car, lead: Car, positions: Mapping[str, Element]) -> float:
    """Metres from reference point to reference point, along the lane."""
    behind = _place(ego.name, positions, ())
    ahead = _place(lead.name, positions, ())
    where = positions[lead.name]
    if behind.frame != ahead.frame:
        raise where.error(f"found {ahead.frame}, allowed is {behind.frame}, where {ego.name!r} is")
    if abs(math.remainder(ahead.heading_rad - behind.heading_rad, math.tau)) > TURNED_RAD_MAX:
        raise where.error(f"heads elsewhere than {ego.name!r}; the road is straight")
    x_m, y_m = ahead.along_m - behind.along_m, ahead.across_m - behind.across_m
    cos, sin = math.cos(behind.heading_rad), math.sin(behind.heading_rad)
    beside_m = y_m * cos - x_m * sin
    if abs(beside_m) > BESIDE_M_MAX:
        raise where.error(f"found {beside_m:g} m beside the line of {ego.name!r}, allowed is 0")
    if abs(ahead.above_m - behind.above_m) > BESIDE_M_MAX:
        raise where.error(f"found another level than that of {ego.name!r}; the road is level")
    return x_m * cos + y_m * sin


def _place(name: str, positions: Mapping[str, Element], asking: tuple[str, ...]) -> Place:
    """Where the car `name` is; `asking` are the cars whose places depend on it."""
    position = positions[name].one(*_POSITIONS)
    _check_orientation(position)
    match position.tag:
        case "WorldPosition":
            for turn in ("p", "r"):
                if position.number(turn, 0.0) != 0.0:
                    raise position.wrong(turn, "0, the road is level")
            number = position.number
            return Place(_WORLD, number("x"), number("y"), number("z", 0.0), number("h", 0.0))
        case "LanePosition":
            road, lane = position.word("roadId"), position.word("laneId")
            if not lane.startswith("-") or not lane[1:].isdecimal():
                raise position.wrong("laneId", "a lane that runs with its road, -1 or less")
            frame = f"lane {lane} of road {road}"
            return Place(frame, position.number("s"), position.number("offset", 0.0))
        case "RoadPosition":
            return Place(f"road {position.word('roadId')}", position.number("s"), position.number("t"))
        case _:
            other = position.word("entityRef")
            if other not in positions or other == name:
                raise position.error(f"entityRef: {unknown('car', other, set(positions) - {name})}")
            if other in asking:
                raise position.error(f"{name!r} is placed by {other!r}, which is placed by {name!r}")
            return _beside(position, _place(other, positions, (*asking, name)))


def _beside(position: Element, other: Place) -> Place:
    """The place that `position` gives relative to `other`."""
    match position.tag:
        case "RelativeLanePosition":
            if position.number("dLane") != 0.0:
                raise position.wrong("dLane", "0, the lane of the other car")
            along_m = position.number("dsLane" if position.has("dsLane") else "ds")
            offset_m = position.number("offset", 0.0)
            across_m = offset_m - other.across_m if other.frame.startswith("lane ") else offset_m
        case "RelativeRoadPosition":
            along_m, across_m = position.number("ds"), position.number("dt")
        case "RelativeObjectPosition":
            along_m, across_m = position.number("dx"), position.number("dy")
        case _:
            assert position.tag == "RelativeWorldPosition", position.tag
            if other.frame != _WORLD:
                raise position.error(f"the other car is in {other.frame}, allowed is a WorldPosition")
            moved_m = (other.along_m + position.number("dx"), other.across_m + position.number("dy"))
            above_m = other.above_m + position.number("dz", 0.0)
            return Place(other.frame, *moved_m, above_m, other.heading_rad)
    above_m = position.number("dz", 0.0) if position.tag == "RelativeObjectPosition" else 0.0
    cos, sin = math.cos(other.heading_rad), math.sin(other.heading_rad)
    return Place(
        other.frame,
        other.along_m + along_m * cos - across_m * sin,
        other.across_m + along_m * sin + across_m * cos,
        other.above_m + above_m,
        other.heading_rad,
    )


def _check_orientation(position: Element) -> None:
    turned = position.maybe("Orientation")
    if turned is None:
        return
    turned.choice("type", ("relative", "absolute"), "absolute")
    for angle in ("h", "p", "r"):
        if turned.number(angle, 0.0) != 0.0:
            raise turned.wrong(angle, "0, along the lane")

"""The cars at the start: the gap between their bumpers, from positions and vehicle lengths; the road's shape.

A position in OpenSCENARIO is that of a car's reference point, the middle of its rear axle. A radar sees the
gap from bumper to bumper, so the bounding boxes are needed: from the file itself, or from the vehicle catalog
that it refers to.

Positions are compared in the frame in which they are given: along one lane, along one road, or in the world,
along the heading of the ego. Relative positions are resolved from the other car. Two cars in different
frames, beside each other, with different headings or on different levels are refused: the road is one
straight, level lane. Lanes that run against their road (`laneId` above 0) are refused too: which way is
"ahead" on them depends on the side of traffic, which is only in the road's own file.

Of the road's own file (OpenDRIVE), if it exists, only one thing is checked: the roads on which cars are
placed consist of lines in one direction and have no slope. A file that is missing or too large is not read;
the road then counts as straight and level, and the import prints that.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.errors import unknown
from aftbed.interop.openscenario.document import FILE_BYTES_MAX, Element, read_tree, refuse
from aftbed.interop.openscenario.expression import replaced_below

VEHICLES: Final = ("car", "van", "truck", "bus", "motorbike")
BESIDE_M_MAX: Final = 0.01  # tolerance for rounded positions
TURNED_RAD_MAX: Final = 0.001
LENGTH_M_MAX: Final = 100.0
CATALOG_FILES_MAX: Final = 100
_WORLD: Final = "the world"


class CarShape(msgspec.Struct, frozen=True):
    """Name of a car, and the distances of its bumpers from its reference point."""

    name: str
    front_m: float
    rear_m: float


class RoadPlace(msgspec.Struct, frozen=True):
    """Position of a reference point in a frame, and the heading of the car in it."""

    frame: str
    along_m: float
    across_m: float
    above_m: float = 0.0
    heading_rad: float = 0.0


# -- the cars


def read_cars(root: Element) -> tuple[dict[str, CarShape], list[Element]]:
    """The cars by name, in the order of the file, and the catalog entries that were read for them."""
    found: dict[str, CarShape] = {}
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


def _car(name: str, vehicle: Element) -> CarShape:
    vehicle.choice("vehicleCategory", VEHICLES)
    for label in ("mass", "role"):
        vehicle.word(label, "")
    box = vehicle.one("BoundingBox")
    centre, size = box.one("Center"), box.one("Dimensions")
    for element, names in ((centre, ("y", "z")), (size, ("width", "height"))):
        for across in names:  # without effect along the lane
            element.number(across, 0.0)
    length_m = size.number("length")
    if not 0.0 < length_m <= LENGTH_M_MAX:
        raise size.wrong("length", f"more than 0 and at most {LENGTH_M_MAX:g}")
    ahead_m = centre.number("x")
    return CarShape(name, ahead_m + length_m / 2, length_m / 2 - ahead_m)


def _entry(root: Element, reference: Element) -> Element:
    """The catalog vehicle to which `reference` refers."""
    catalog, name = reference.word("catalogName"), reference.word("entryName")
    assigned = reference.maybe("ParameterAssignments")
    values = {
        one.word("parameterRef").removeprefix("$"): one.word("value")
        for one in (assigned.every("ParameterAssignment") if assigned else [])
    }
    entries: list[str] = []
    for path in _catalog_files(root, reference):
        for group in read_tree(path).every("Catalog"):
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


def gap_m(ego: CarShape, lead: CarShape, positions: Mapping[str, Element]) -> float:
    """Metres from the ego's front bumper to the rear bumper of the car ahead."""
    return distance_m(ego, lead, positions) - ego.front_m - lead.rear_m


def distance_m(ego: CarShape, lead: CarShape, positions: Mapping[str, Element]) -> float:
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


def _place(name: str, positions: Mapping[str, Element], asking: tuple[str, ...]) -> RoadPlace:
    """The place of the car `name`; `asking` are the cars whose places depend on it."""
    position = positions[name].one(
        "WorldPosition", "LanePosition", "RoadPosition", "RelativeLanePosition", "RelativeRoadPosition",
        "RelativeObjectPosition", "RelativeWorldPosition",
    )  # fmt: skip
    if (turned := position.maybe("Orientation")) is not None:
        turned.choice("type", ("relative", "absolute"), "absolute")
        for angle in ("h", "p", "r"):
            if turned.number(angle, 0.0) != 0.0:
                raise turned.wrong(angle, "0, along the lane")
    number = position.number
    match position.tag:
        case "WorldPosition":
            for turn in ("p", "r"):
                if number(turn, 0.0) != 0.0:
                    raise position.wrong(turn, "0, the road is level")
            return RoadPlace(_WORLD, number("x"), number("y"), number("z", 0.0), number("h", 0.0))
        case "LanePosition":
            road, lane = position.word("roadId"), position.word("laneId")
            if not lane.startswith("-") or not lane[1:].isdecimal():
                raise position.wrong("laneId", "a lane that runs with its road, -1 or less")
            return RoadPlace(f"lane {lane} of road {road}", number("s"), number("offset", 0.0))
        case "RoadPosition":
            return RoadPlace(f"road {position.word('roadId')}", number("s"), number("t"))
        case _:
            other = position.word("entityRef")
            if other not in positions or other == name:
                raise position.error(f"entityRef: {unknown('car', other, set(positions) - {name})}")
            if other in asking:
                raise position.error(f"{name!r} is placed by {other!r}, which is placed by {name!r}")
            return _beside(position, _place(other, positions, (*asking, name)))


def _beside(position: Element, other: RoadPlace) -> RoadPlace:
    """The place that `position` gives relative to `other`."""
    number, above_m, heading_rad = position.number, other.above_m, other.heading_rad
    match position.tag:
        case "RelativeLanePosition":
            if number("dLane") != 0.0:
                raise position.wrong("dLane", "0, the lane of the other car")
            along_m = number("dsLane" if position.has("dsLane") else "ds")
            across_m = number("offset", 0.0)
            if other.frame.startswith("lane "):
                across_m -= other.across_m
        case "RelativeRoadPosition":
            along_m, across_m = number("ds"), number("dt")
        case "RelativeObjectPosition":
            along_m, across_m = number("dx"), number("dy")
            above_m += number("dz", 0.0)
        case _:
            assert position.tag == "RelativeWorldPosition", position.tag
            if other.frame != _WORLD:
                raise position.error(f"the other car is in {other.frame}, allowed is a WorldPosition")
            along_m, across_m = number("dx"), number("dy")
            above_m += number("dz", 0.0)
            heading_rad = 0.0  # of the frame in which the distances are given
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    return RoadPlace(
        other.frame,
        other.along_m + along_m * cos - across_m * sin,
        other.across_m + along_m * sin + across_m * cos,
        above_m,
        other.heading_rad,
    )


# -- the road


def check_road(root: Element) -> None:
    """Raise ConfigError if a road on which a car stands is known to be curved or to climb."""
    network = root.maybe("RoadNetwork")
    if network is None:
        return
    signals = network.maybe("TrafficSignals")
    if signals is not None and not signals.children:
        signals.ignored = "there are none"
    logic = network.maybe("LogicFile")
    if logic is None:
        return
    path = Path(root.path).parent / logic.word("filepath")
    roads = {one.attributes["roadId"] for one in root.walk() if one.visited and one.has("roadId")}
    try:
        is_readable = path.is_file() and path.stat().st_size <= FILE_BYTES_MAX
    except (OSError, ValueError):
        is_readable = False
    if not roads or not is_readable:
        logic.ignored = "not read: the road is taken to be straight and level"
        return
    for road in read_tree(path).children:
        if road.tag == "road" and road.attributes.get("id") in roads:
            _check(road)
    logic.ignored = "nothing but its being straight and level was looked at"


def _check(road: Element) -> None:
    headings = []
    for geometry in (one for one in road.walk() if one.tag == "geometry"):
        for shape in geometry.children:
            if shape.tag not in ("line", "userData"):
                raise shape.error("a curve; the road has to be straight")
        headings.append(geometry.number("hdg"))
        if abs(headings[-1] - headings[0]) > TURNED_RAD_MAX:
            raise geometry.error("another direction; the road has to be straight")
    for elevation in (one for one in road.walk() if one.tag == "elevation"):
        for slope in ("b", "c", "d"):  # of height = a + b s + c s^2 + d s^3
            if elevation.number(slope, 0.0) != 0.0:
                raise elevation.wrong(slope, "0; the road has to be level")

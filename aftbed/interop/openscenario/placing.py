"""The cars at the start: where another car is, seen from the ego; their sizes; the shape of the road.

A position in OpenSCENARIO is that of a car's reference point, the middle of its rear axle. A radar sees the
gap from bumper to bumper, so the bounding boxes are needed: from the file itself, or from the catalog that it
refers to. A pedestrian or an object has a bounding box too, and is a car ahead like any other.

Positions are compared in the frame in which they are given: along a lane, along a road, or in the world,
along the heading of the ego. Relative positions are resolved from the other car. Two cars in different
frames, with different headings or on different levels are refused: the road is straight and level. Another
lane of the same road is beside the ego. Lanes that run against their road (`laneId` above 0) are refused:
which way is "ahead" on them depends on the side of traffic, which is only in the road's own file.

Whether a car that is offset within the lane is in the way, a drive of aftbed decides by `IN_THE_WAY_M`, the
file by the widths of its cars. An offset at which the two differ is refused.

Of the road's own file (OpenDRIVE), if it exists, only one thing is checked: the roads on which cars are
placed consist of lines in one direction and have no slope. A file that is missing or too large is not read;
the road then counts as straight and level, and the import prints that. An empty road may have any shape.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.errors import unknown
from aftbed.interop.openscenario.catalog import Catalogs
from aftbed.interop.openscenario.document import FILE_BYTES_MAX, Cause, Element, read_tree, refuse
from aftbed.vehicle.plant import IN_THE_WAY_M

VEHICLES: Final = ("car", "van", "truck", "bus", "motorbike", "bicycle", "trailer", "semitrailer")
ROAD_USERS: Final = ("Vehicle", "Pedestrian", "MiscObject")
SAME_M: Final = 0.01  # tolerance for rounded positions
TURNED_RAD_MAX: Final = 0.001
LENGTH_M_MAX: Final = 100.0
_WORLD: Final = "the world"
_LABELS: Final = ("mass", "role", "model", "pedestrianCategory", "miscObjectCategory")


class CarShape(msgspec.Struct, frozen=True):
    """Name of a car, the distances of its bumpers from its reference point, and its width, 0 if unknown."""

    name: str
    front_m: float
    rear_m: float
    width_m: float


class RoadPlace(msgspec.Struct, frozen=True):
    """Position of a reference point in a frame, and the heading of the car in it.

    `lane` tells the lanes of one frame apart; `across_m` is within the lane.
    """

    frame: str
    along_m: float
    across_m: float
    above_m: float = 0.0
    heading_rad: float = 0.0
    lane: int = 0


class RelativePlace(msgspec.Struct, frozen=True):
    """Where a car is, seen from the ego.

    `distance_m` is between the reference points, `gap_m` between the bumpers, `lateral_m` to the left.
    `aside` says why the car is not in the way, and is None for one that is.
    """

    distance_m: float
    gap_m: float
    lateral_m: float
    aside: str | None


# -- the cars


def read_cars(root: Element, catalogs: Catalogs) -> tuple[dict[str, CarShape], list[Element]]:
    """The cars by name, in the order of the file, and the catalog entries that were read for them.

    The size of a car that is alone does not matter, and is not read.
    """
    found: dict[str, CarShape] = {}
    entries = []
    things = root.one("Entities").every("ScenarioObject")
    for thing in things:
        name = thing.word("name")
        if name in found:
            raise thing.error(f"the name {name!r} stands twice")
        user = thing.one(*ROAD_USERS, "CatalogReference")
        if len(things) == 1:
            user.ignored = "the road is empty: what the car is does not matter"
            found[name] = CarShape(name, 0.0, 0.0, 0.0)
            continue
        if user.tag == "CatalogReference":
            user = catalogs.entry(root, user, *ROAD_USERS, needed="the gap needs the car's length")
            refuse(user)
            entries.append(user)
        found[name] = _car(name, user)
    return found, entries


def _car(name: str, user: Element) -> CarShape:
    if user.tag == "Vehicle":
        user.choice("vehicleCategory", VEHICLES)
        _check_trailer(user)
    for label in _LABELS:
        user.word(label, "")
    box = user.one("BoundingBox")
    centre, size = box.one("Center"), box.one("Dimensions")
    for element, names in ((centre, ("y", "z")), (size, ("height",))):
        for across in names:  # without effect along the lane
            element.number(across, 0.0)
    length_m = size.number("length")
    if not 0.0 < length_m <= LENGTH_M_MAX:
        raise size.wrong("length", f"more than 0 and at most {LENGTH_M_MAX:g}")
    ahead_m = centre.number("x")
    return CarShape(name, ahead_m + length_m / 2, length_m / 2 - ahead_m, size.number("width", 0.0))


def _check_trailer(vehicle: Element) -> None:
    trailer = vehicle.maybe("Trailer")
    if trailer is None:
        return
    reference = trailer.maybe("TrailerRef")
    if trailer.children and (reference is None or reference.word("entityRef")):
        raise trailer.error("a trailer; one car ahead is all there is", Cause.ROAD_USERS)
    trailer.ignored = "there is none"


# -- the places


def relative_place(ego: CarShape, other: CarShape, positions: Mapping[str, Element]) -> RelativePlace:
    """Where `other` is, seen from the ego. Raises ConfigError if it is off the ego's straight, level road."""
    behind = _place(ego.name, positions, ())
    ahead = _place(other.name, positions, ())
    where = positions[other.name]
    if behind.frame != ahead.frame:
        reason = f"found {ahead.frame}, allowed is {behind.frame}, where {ego.name!r} is"
        raise where.error(reason, Cause.ROAD)
    x_m, y_m = ahead.along_m - behind.along_m, ahead.across_m - behind.across_m
    cos, sin = math.cos(behind.heading_rad), math.sin(behind.heading_rad)
    distance_m, lateral_m = x_m * cos + y_m * sin, y_m * cos - x_m * sin
    lateral_m = 0.0 if abs(lateral_m) <= SAME_M else lateral_m
    gap_m = distance_m - ego.front_m - other.rear_m
    if ahead.lane != behind.lane:
        return RelativePlace(distance_m, gap_m, lateral_m, "it is in another lane than the ego")
    if abs(math.remainder(ahead.heading_rad - behind.heading_rad, math.tau)) > TURNED_RAD_MAX:
        raise where.error(f"heads elsewhere than {ego.name!r}; the road is straight", Cause.LATERAL)
    if abs(ahead.above_m - behind.above_m) > SAME_M:
        raise where.error(f"found another level than that of {ego.name!r}; the road is level", Cause.ROAD)
    if distance_m + other.front_m <= -ego.rear_m:
        return RelativePlace(distance_m, gap_m, lateral_m, "it is behind the ego")
    if not _in_the_way(ego, other, lateral_m, where):
        return RelativePlace(distance_m, gap_m, lateral_m, f"it is {lateral_m:g} m beside the ego's line")
    return RelativePlace(distance_m, gap_m, lateral_m, None)


def _in_the_way(ego: CarShape, other: CarShape, lateral_m: float, where: Element) -> bool:
    """Whether the cars would touch; refused where a drive of aftbed and the widths say different things."""
    in_drive = abs(lateral_m) < IN_THE_WAY_M
    if ego.width_m > 0.0 and other.width_m > 0.0:
        touch_m = (ego.width_m + other.width_m) / 2
        if (abs(lateral_m) < touch_m) != in_drive:
            found = f"found {lateral_m:g} m beside the line of {ego.name!r}, where these cars"
            reason = f"{found} touch below {touch_m:g} m and those of a drive below {IN_THE_WAY_M:g} m"
            raise where.error(reason, Cause.LATERAL)
    return in_drive


def _place(name: str, positions: Mapping[str, Element], asking: tuple[str, ...]) -> RoadPlace:
    """The place of the car `name`; `asking` are the cars whose places depend on it."""
    position = positions[name].one(
        "WorldPosition", "LanePosition", "RoadPosition", "RelativeLanePosition", "RelativeRoadPosition",
        "RelativeObjectPosition", "RelativeWorldPosition",
    )  # fmt: skip
    turned_rad, relative = _orientation(position)
    number = position.number
    match position.tag:
        case "WorldPosition":
            for turn in ("p", "r"):
                if number(turn, 0.0) != 0.0:
                    raise position.wrong(turn, "0, the road is level", Cause.ROAD)
            return RoadPlace(_WORLD, number("x"), number("y"), number("z", 0.0), number("h", 0.0))
        case "LanePosition":
            road, lane = position.word("roadId"), position.word("laneId")
            if not lane.startswith("-") or not lane[1:].isdecimal() or len(lane) > 4:
                raise position.wrong("laneId", "a lane that runs with its road, -1 or less", Cause.ROAD)
            place = RoadPlace(f"a lane of road {road}", number("s"), number("offset", 0.0), lane=int(lane))
        case "RoadPosition":
            place = RoadPlace(f"road {position.word('roadId')}", number("s"), number("t"))
        case _:
            other = position.word("entityRef")
            if other not in positions or other == name:
                raise position.error(f"entityRef: {unknown('car', other, set(positions) - {name})}")
            if other in asking:
                raise position.error(f"{name!r} is placed by {other!r}, which is placed by {name!r}")
            place = _relative(position, _place(other, positions, (*asking, name)))
    heading_rad = place.heading_rad + turned_rad if relative else turned_rad
    return msgspec.structs.replace(place, heading_rad=heading_rad)


def _orientation(position: Element) -> tuple[float, bool]:
    """The heading that a position gives, along a lane to the lane, and whether it is relative."""
    turned = position.maybe("Orientation")
    if turned is None:
        return 0.0, True
    relative = turned.choice("type", ("relative", "absolute"), "absolute") == "relative"
    for angle in ("p", "r"):
        if turned.number(angle, 0.0) != 0.0:
            raise turned.wrong(angle, "0, the road is level", Cause.ROAD)
    return turned.number("h", 0.0), relative


def _relative(position: Element, other: RoadPlace) -> RoadPlace:
    """The place that `position` gives relative to `other`."""
    number, above_m, lane = position.number, other.above_m, other.lane
    along_road = position.tag in ("RelativeLanePosition", "RelativeRoadPosition") and other.frame != _WORLD
    heading_rad = 0.0 if along_road else other.heading_rad  # of the axes of the distances that are given
    match position.tag:
        case "RelativeLanePosition":
            lanes = number("dLane")
            if lanes != int(lanes):
                raise position.wrong("dLane", "a whole number")
            lane += int(lanes)
            along_m = number("dsLane" if position.has("dsLane") else "ds")
            across_m = number("offset", 0.0)
            if other.lane:  # the offset is from the middle of the lane
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
            heading_rad = 0.0
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    return RoadPlace(
        other.frame,
        other.along_m + along_m * cos - across_m * sin,
        other.across_m + along_m * sin + across_m * cos,
        above_m,
        other.heading_rad,
        lane,
    )


# -- the road


def check_road(root: Element, empty: bool) -> None:
    """Raise ConfigError if a road on which a car stands is known to be curved or to climb."""
    network = root.maybe("RoadNetwork")
    if network is None:
        return
    logic = network.maybe("LogicFile")
    if logic is None:
        return
    if empty:
        logic.ignored = "not read: the road is empty, its shape does not matter"
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
                raise shape.error("a curve; the road has to be straight", Cause.ROAD)
        headings.append(geometry.number("hdg"))
        if abs(headings[-1] - headings[0]) > TURNED_RAD_MAX:
            raise geometry.error("another direction; the road has to be straight", Cause.ROAD)
    for elevation in (one for one in road.walk() if one.tag == "elevation"):
        for slope in ("b", "c", "d"):  # of height = a + b s + c s^2 + d s^3
            if elevation.number(slope, 0.0) != 0.0:
                raise elevation.wrong(slope, "0; the road has to be level", Cause.ROAD)

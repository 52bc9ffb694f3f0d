"""The road's own file (OpenDRIVE), where it is at hand: the road has to be straight and level.

Only that is looked at: the roads on which the cars are placed have a plan of lines in one direction and no
slope. A file that is not there, or is too large, is not read; then the road is taken to be straight and
level, and the import says so.
"""

from pathlib import Path
from typing import Final

from aftbed.vehicle.xosc.tree import FILE_BYTES_MAX, Element, read_tree

TURN_RAD_MAX: Final = 1e-3
_SLOPES: Final = ("b", "c", "d")  # of height = a + b s + c s^2 + d s^3


def check_road(root: Element) -> None:
    """Raise ConfigError if a road on which a car stands is known to be curved or to climb."""
    network = root.maybe("RoadNetwork")
    if network is None:
        return
    signals = network.maybe("TrafficSignals")
    if signals is not None and not signals.children:
        signals.ignore("there are none")
    logic = network.maybe("LogicFile")
    if logic is None:
        return
    path = Path(root.path).parent / logic.word("filepath")
    roads = {one.attributes["roadId"] for one in root.walk() if one.visited() and one.has("roadId")}
    if not roads or not _at_hand(path):
        logic.ignore("not read: the road is taken to be straight and level")
        return
    for road in read_tree(path).children:
        if road.tag == "road" and road.attributes.get("id") in roads:
            _check(road)
    logic.ignore("nothing but its being straight and level was looked at")


def _at_hand(path: Path) -> bool:
    try:
        return path.is_file() and path.stat().st_size <= FILE_BYTES_MAX
    except (OSError, ValueError):
        return False


def _check(road: Element) -> None:
    headings = []
    for geometry in (one for one in road.walk() if one.tag == "geometry"):
        for shape in geometry.children:
            if shape.tag not in ("line", "userData"):
                raise shape.error("a curve; the road has to be straight")
        headings.append(geometry.number("hdg"))
        if abs(headings[-1] - headings[0]) > TURN_RAD_MAX:
            raise geometry.error("another direction; the road has to be straight")
    for elevation in (one for one in road.walk() if one.tag == "elevation"):
        for slope in _SLOPES:
            if elevation.number(slope, 0.0) != 0.0:
                raise elevation.wrong(slope, "0; the road has to be level")

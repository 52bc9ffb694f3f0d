"""Units as DBCs spell them: metres, Meter, m/sec, KPH, mph, Unit_MeterPerSec, °."""

import re
from collections.abc import Mapping
from enum import StrEnum
from math import radians
from typing import Final

import msgspec


class Dimension(StrEnum):
    DISTANCE = "a distance"
    SPEED = "a speed"
    ANGLE = "an angle"


class Unit(msgspec.Struct, frozen=True):
    """`si` is how many metres, metres per second, or radians it is."""

    name: str
    dimension: Dimension
    si: float


_SPELLINGS: Final[Mapping[Unit, str]] = {
    Unit("m", Dimension.DISTANCE, 1.0): "m meter meters metre metres mtr",
    Unit("cm", Dimension.DISTANCE, 0.01): "cm centimeter centimeters centimetre centimetres",
    Unit("mm", Dimension.DISTANCE, 0.001): "mm millimeter millimeters millimetre millimetres",
    Unit("ft", Dimension.DISTANCE, 0.3048): "ft foot feet",
    Unit("m/s", Dimension.SPEED, 1.0): (
        "m/s mps m/sec meter/s meters/s metre/s metres/s meter/sec meters/sec metre/sec metres/sec"
        " meterpersec meterspersec meterpersecon meterpersecond meterspersecond"
    ),
    Unit("km/h", Dimension.SPEED, 1 / 3.6): (
        "km/h kmh kph kmph km/hr km/hour kmperhour kilometer/hour kilometerperhour kilometersperhour"
    ),
    Unit("mph", Dimension.SPEED, 0.44704): "mph mi/h mile/h miles/h mi/hr mileperhour milesperhour",
    Unit("deg", Dimension.ANGLE, radians(1.0)): "deg degs degree degrees ° degreofarc degreeofarc",
    Unit("rad", Dimension.ANGLE, 1.0): "rad rads radian radians",
    Unit("mrad", Dimension.ANGLE, 0.001): "mrad milliradian milliradians",
}
_BY_SPELLING: Final = {word: unit for unit, words in _SPELLINGS.items() for word in words.split()}
_IGNORED: Final = re.compile(r"[\s\[\]()_.]|unit")


def unit_of(text: str) -> Unit | None:
    """The unit that `text` spells; None if it is none of ours."""
    return _BY_SPELLING.get(_IGNORED.sub("", text.lower()))


def unit_names(dimension: Dimension) -> list[str]:
    return [unit.name for unit in _SPELLINGS if unit.dimension is dimension]

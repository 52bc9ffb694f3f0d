"""What a map file may hold, key by key: the shape, and nothing of the DBC. `mapfile` checks the rest.

    strict         false: the DBC may contradict itself where the map does not look (see `dbcfile`)
    cycle_end      the message that ends a radar cycle; its arrival makes the request
    ego.speed      the ego's own speed
    tracks         the radar's targets: one message for each slot, `name` with {n} (or {n:02}, with zeros in
                   front) from `first` to `last`; or one message for all, with the number of the object in
                   the signal `slot`, and, where the radar says ahead how many will come, `count`
    others         messages that are judged and counted, but not used

A quantity that the DBC does not know may be given by its place in the data (`raw`), in the DBC's own way
of counting bits. A target's place beside our path is its `lateral_offset`, or follows from its `angle`.
"""

import re
from collections.abc import Mapping
from math import radians
from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from aftbed.vehicle.e2eprofiles import DATA_ID_MAX, P01Mode
from aftbed.vehicle.frame import CAN_ID_MAX

SpeedUnit = Literal["m/s", "km/h"]
DistanceUnit = Literal["m", "cm"]
AngleUnit = Literal["deg", "rad"]
Sum = Literal["toyota", "none"]
Length = Annotated[int, Meta(ge=1, le=8)]
DataId = Annotated[int, Meta(ge=0, le=DATA_ID_MAX)]

TO_SI: Final[Mapping[str, float]] = {
    "m": 1.0,
    "cm": 0.01,
    "m/s": 1.0,
    "km/h": 1 / 3.6,
    "deg": radians(1.0),
    "rad": 1.0,
}
_NUMBER: Final = re.compile(r"\{n(?::0([1-9]))?\}")


class RawSignal(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A place in the data, as in a DBC: `start_bit` is the highest bit if big-endian, else the lowest."""

    start_bit: Annotated[int, Meta(ge=0, le=63)]
    length_bits: Annotated[int, Meta(ge=1, le=32)]
    byte_order: Literal["big_endian", "little_endian"]
    signed: bool = False
    scale: Annotated[float, Meta(ge=-1e6, le=1e6)] = 1.0
    offset: Annotated[float, Meta(ge=-1e6, le=1e6)] = 0.0

    def first_bit(self) -> int:
        """Bits to the left of the signal: of all data if big-endian, else to the right."""
        if self.byte_order == "little_endian":
            return self.start_bit
        return self.start_bit // 8 * 8 + 7 - self.start_bit % 8

    def read(self, data: bytes) -> float:
        """The value in `data`, which is long enough."""
        if self.byte_order == "little_endian":
            number = int.from_bytes(data, "little") >> self.first_bit()
        else:
            number = int.from_bytes(data, "big") >> (8 * len(data) - self.first_bit() - self.length_bits)
        number &= (1 << self.length_bits) - 1
        if self.signed and number >> (self.length_bits - 1):
            number -= 1 << self.length_bits
        return number * self.scale + self.offset


class Speed(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A speed: a signal of the DBC, or raw."""

    unit: SpeedUnit
    signal: str | None = None
    raw: RawSignal | None = None


class Distance(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A distance: a signal of the DBC, or raw."""

    unit: DistanceUnit
    signal: str | None = None
    raw: RawSignal | None = None


class Angle(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An angle from straight ahead, to either side: a signal of the DBC, or raw."""

    unit: AngleUnit
    signal: str | None = None
    raw: RawSignal | None = None


Quantity = Speed | Distance | Angle


class Counter(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A counter that rises by one with each frame, and starts over at `modulo`.

    A counter of two values is none: where one frame is lost, the next looks like the one before.
    """

    signal: str
    modulo: Annotated[int, Meta(ge=3, le=65536)]


class E2EMap(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An E2E profile. `data_ids`: of P02 its list, else one for each of the messages.

    `cycle_ms` is how often the message comes, else that of the radar; without a good frame for `timeout_ms`,
    else six cycles, the sequence is void. `offset`, of the header, is in bytes.
    """

    profile: Literal["p01", "p02", "p05", "p11"]
    data_id: DataId | None = None
    data_ids: tuple[DataId, ...] | None = None
    mode: P01Mode = "both"
    offset: Annotated[int, Meta(ge=0, le=6)] = 0
    cycle_ms: Annotated[int, Meta(ge=1, le=1000)] | None = None
    timeout_ms: Annotated[int, Meta(ge=1, le=100_000)] | None = None


Checksum = Sum | E2EMap


class Messages(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One message, or those whose names have the numbers `first` to `last` in the place of {n}."""

    name: str
    first: Annotated[int, Meta(ge=0, le=255)] = 0
    last: Annotated[int, Meta(ge=0, le=255)] = 0

    def names(self) -> list[str]:
        """All of them, in order."""
        return [
            _NUMBER.sub(lambda found, number=number: f"{number:0{found[1] or 0}}", self.name)  # type: ignore[misc]
            for number in range(self.first, self.last + 1)
        ]


class Flag(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Yes, if the signal has one of the values."""

    signal: str
    values: Annotated[tuple[int, ...], Meta(min_length=1)]


class Count(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How many objects follow, said by a message that comes before them."""

    message: str
    signal: str


class EgoMap(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The message with the ego speed: by `message` in the DBC, or by `can_id`. Unknown after `timeout_ms`."""

    length: Length
    speed: Speed
    message: str | None = None
    can_id: Annotated[int, Meta(ge=0, le=CAN_ID_MAX)] | None = None
    checksum: Checksum = "none"
    counter: Counter | None = None
    timeout_ms: Annotated[int, Meta(ge=1, le=10_000)] = 200


class TrackMap(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The radar's targets. `valid`, `new`: signals that are 1 for yes, or flags; without `valid` all are."""

    messages: Messages
    length: Length
    range: Distance
    relative_speed: Speed
    lateral_offset: Distance | None = None
    angle: Angle | None = None
    slot: str | None = None
    count: Count | None = None
    valid: str | Flag | None = None
    new: str | Flag | None = None
    checksum: Checksum = "none"
    counter: Counter | None = None


class OtherMap(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Messages of the radar that say nothing that is needed, or only how many objects there are."""

    messages: Messages
    length: Length
    checksum: Checksum = "none"
    counter: Counter | None = None


class MapFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A map, key by key."""

    description: str
    cycle_ms: Annotated[int, Meta(ge=1, le=1000)]
    ego: EgoMap
    tracks: TrackMap
    cycle_end: str | None = None
    others: tuple[OtherMap, ...] = ()
    lane_half_width_m: Annotated[float, Meta(gt=0, le=10)] = 1.5
    strict: bool = True

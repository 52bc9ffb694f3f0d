"""Map files: which messages and signals of another car's bus mean what to the protected function.

A map is YAML; `MapFile` is its shape, key by key. It names messages and signals of a DBC, the unit of each
quantity, the length of each message, and the rules for its checksum and counter:

    strict         false: messages of the DBC that contradict themselves are taken (see `dbc_file`)
    cycle_end      the message that ends a radar cycle; its arrival makes the request
    ego.speed      the ego's own speed
    tracks         the radar's targets: one message for each slot, `name` with {n} (or {n:02}, with zeros in
                   front) from `first` to `last`; or one message for all, with the number of the object in
                   the signal `slot`, and, where the radar announces how many will come, `count`
    others         messages that are judged and counted, but not used

A quantity that the DBC does not have may be given by its place in the data (`raw`), in the DBC's own way of
counting bits. A target's place beside our path is its `lateral_offset`, or follows from its `angle`.

`bind` checks the whole map against the DBC, so a map that binds cannot fail later: the result has one
`FrameRule` per CAN id.
"""

import re
from collections.abc import Mapping
from math import radians
from pathlib import Path
from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from aftbed.core.errors import ConfigError, unknown
from aftbed.core.yaml_file import read_yaml
from aftbed.vehicle.aeb.messages import SLOTS
from aftbed.vehicle.can.dbc_file import Codec, load_dbc
from aftbed.vehicle.can.e2e import (
    DATA_ID_MAX,
    LIST_ID_MAX,
    LIST_IDS,
    NIBBLE_ID_MAX,
    P02,
    WITH_ONE_ID,
    P01Mode,
    Profile,
    Supervision,
)
from aftbed.vehicle.can.frame import CAN_ID_MAX

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


class MappedQuantity(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A quantity: a signal of the DBC, or raw."""

    unit: str
    signal: str | None = None
    raw: RawSignal | None = None

    def si(self, signals: Mapping[str, float], data: bytes) -> float:
        """Its value in a message, in metres, metres per second, or radians."""
        if self.raw is not None:
            return self.raw.read(data) * TO_SI[self.unit]
        assert self.signal is not None
        return signals[self.signal] * TO_SI[self.unit]


class Speed(MappedQuantity, frozen=True):
    """A speed."""

    unit: Literal["m/s", "km/h"]


class Distance(MappedQuantity, frozen=True):
    """A distance."""

    unit: Literal["m", "cm"]


class Angle(MappedQuantity, frozen=True):
    """An angle from straight ahead, to either side."""

    unit: Literal["deg", "rad"]


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
        return [
            _NUMBER.sub(lambda found, number=number: f"{number:0{found[1] or 0}}", self.name)  # type: ignore[misc]
            for number in range(self.first, self.last + 1)
        ]


class Flag(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Yes, if the signal has one of the values."""

    signal: str
    values: Annotated[tuple[int, ...], Meta(min_length=1)]


class ObjectCount(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where a message that comes before the objects announces how many there are."""

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
    count: ObjectCount | None = None
    valid: str | Flag | None = None
    new: str | Flag | None = None
    checksum: Checksum = "none"
    counter: Counter | None = None


class OtherMap(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Messages of the radar that are not needed, or only for the number of objects."""

    messages: Messages
    length: Length
    checksum: Checksum = "none"
    counter: Counter | None = None


class MapFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    description: str
    cycle_ms: Annotated[int, Meta(ge=1, le=1000)]
    ego: EgoMap
    tracks: TrackMap
    cycle_end: str | None = None
    others: tuple[OtherMap, ...] = ()
    lane_half_width_m: Annotated[float, Meta(gt=0, le=10)] = 1.5
    strict: bool = True


SHIPPED: Final = Path(__file__).resolve().parent / "maps"  # maps, and the DBCs that go with them
E2E_TIMEOUT_CYCLES: Final = 6  # as on our own bus


class FrameRule(msgspec.Struct, frozen=True):
    """How to judge the frames of one CAN id.

    `name` None: not in the DBC. `watch`: by E2E, and then there is neither checksum nor counter beside it.
    `slot`: which of the tracks' messages it is; None: not a track.
    """

    can_id: int
    name: str | None
    length: int
    checksum: Sum
    counter: Counter | None
    watch: Supervision | None
    slot: int | None = None


class BoundMap(msgspec.Struct, frozen=True):
    """A map that was checked against its DBC.

    A radar cycle ends with a frame of `cycle_end_id`, or else with the last of the objects that a frame of
    `count_id` has announced: one of the two is None. `allots`: the objects are more than slots, or have
    numbers of their own.
    """

    map: MapFile
    codec: Codec
    rules: dict[int, FrameRule]
    ego_id: int
    cycle_end_id: int | None
    count_id: int | None
    allots: bool


def find_map(name_or_path: str) -> Path:
    """A shipped map by name, or the path as it is: whatever has a slash or ends in .yaml or .yml."""
    is_path = "/" in name_or_path or name_or_path.endswith((".yaml", ".yml"))
    return Path(name_or_path) if is_path else _shipped("map", name_or_path, ".yaml")


def find_dbc(name_or_path: str) -> Path:
    """A shipped DBC by name, or the path as it is: whatever has a slash or a dot in it, or is a file."""
    path = Path(name_or_path)
    is_path = "/" in name_or_path or "." in name_or_path or path.is_file()
    return path if is_path else _shipped("DBC", name_or_path, ".dbc")


def _shipped(what: str, name: str, ending: str) -> Path:
    names = sorted(path.stem for path in SHIPPED.glob(f"*{ending}"))
    if name not in names:
        raise unknown(what, name, names)
    return SHIPPED / f"{name}{ending}"


def load_mapped(path: Path, dbc: Path) -> Codec:
    """The DBC as the map at `path` wants it read: strictly, or not. Raises ConfigError."""
    return load_dbc(dbc, strict=read_yaml(path, MapFile).strict)


def bind(path: Path, dbc: Path) -> BoundMap:
    """Read the map at `path` and check all of it against the DBC. Raises ConfigError."""
    file = read_yaml(path, MapFile)
    return _Binding(path, load_dbc(dbc, strict=file.strict), file).bound()


Source = EgoMap | TrackMap | OtherMap


class _Binding:
    """The checks; each error names the file, the key, what was found and what is allowed."""

    def __init__(self, path: Path, codec: Codec, file: MapFile) -> None:
        self._path = path
        self._codec = codec
        self._file = file
        self._rules: dict[int, FrameRule] = {}

    def bound(self) -> BoundMap:
        file, tracks = self._file, self._file.tracks
        ego = self._bind_ego(file.ego)
        self._bind_tracks(tracks)
        for index, other in enumerate(file.others):
            names = self._names(f"others[{index}].messages", other.messages)
            for number, name in enumerate(names):
                self._add(f"others[{index}]", other, name, number, len(names))
        self._check_one("cycle_end", "cycle_end and tracks.count", file.cycle_end, tracks.count)
        end = None if file.cycle_end is None else self._mapped("cycle_end", file.cycle_end)
        count = None
        if tracks.count is not None:
            count = self._mapped("tracks.count.message", tracks.count.message)
            self._check_whole("tracks.count.signal", tracks.count.message, tracks.count.signal)
        allots = tracks.slot is not None or len(tracks.messages.names()) > SLOTS
        return BoundMap(file, self._codec, self._rules, ego, end, count, allots)

    def _bind_ego(self, ego: EgoMap) -> int:
        self._check_one("ego", "message and can_id", ego.message, ego.can_id)
        if ego.message is not None:
            self._check_message("ego.message", ego.message)
            can_id = self._add("ego", ego, ego.message, 0, 1)
        else:
            assert ego.can_id is not None
            can_id = ego.can_id
            if ego.counter is not None:
                raise self._error("ego.counter", "a signal", "none, as ego is given by can_id")
            self._rules[can_id] = self._rule("ego", ego, can_id, None, 0, 1)
        self._check_quantity("ego.speed", ego.speed, ego.message, ego.length)
        return can_id

    def _bind_tracks(self, tracks: TrackMap) -> None:
        names = self._names("tracks.messages", tracks.messages)
        if tracks.slot is not None and len(names) > 1:
            raise self._error("tracks.slot", f"a signal, for {len(names)} messages", "one for one message")
        if tracks.count is not None and tracks.slot is None:
            raise self._error("tracks.count", "count without slot", "both, or neither")
        self._check_one("tracks", "lateral_offset and angle", tracks.lateral_offset, tracks.angle)
        for number, name in enumerate(names):
            self._add("tracks", tracks, name, number, len(names))
            quantities: tuple[tuple[str, MappedQuantity | None], ...] = (
                ("range", tracks.range),
                ("relative_speed", tracks.relative_speed),
                ("lateral_offset", tracks.lateral_offset),
                ("angle", tracks.angle),
            )
            for key, quantity in quantities:
                if quantity is not None:
                    self._check_quantity(f"tracks.{key}", quantity, name, tracks.length)
            if tracks.slot is not None:
                self._check_whole("tracks.slot", name, tracks.slot)
            for key, flag in (("tracks.valid", tracks.valid), ("tracks.new", tracks.new)):
                if isinstance(flag, Flag):
                    self._check_whole(f"{key}.signal", name, flag.signal)
                elif flag is not None:
                    self._check_signal(key, name, flag)

    # -- rules

    def _add(self, key: str, given: Source, name: str, number: int, of: int) -> int:
        """Make the rule of one message of the DBC, `number` of as many with the same; its id."""
        can_id, length = self._codec.can_id(name), self._codec.length(name)
        if given.length != length:
            raise self._error(f"{key}.length", str(given.length), f"{length}, as {name} has in the DBC")
        if can_id in self._rules:
            raise self._error(key, f"{name} ({can_id:#05x}) mapped twice", "once")
        if self._codec.multiplexed(name):
            raise self._error(key, f"{name}, which is multiplexed", "a message with the same signals always")
        if given.counter is not None:
            self._check_whole(f"{key}.counter.signal", name, given.counter.signal)
        self._rules[can_id] = self._rule(key, given, can_id, name, number, of)
        return can_id

    def _rule(
        self, key: str, given: Source, can_id: int, name: str | None, number: int, of: int
    ) -> FrameRule:
        slot = number if isinstance(given, TrackMap) else None
        if not isinstance(given.checksum, E2EMap):
            return FrameRule(can_id, name, given.length, given.checksum, given.counter, None, slot)
        if given.counter is not None:
            raise self._error(f"{key}.counter", "a signal", f"none, as {given.checksum.profile} has its own")
        watch = self._watch(f"{key}.checksum", given.checksum, given.length, number, of)
        return FrameRule(can_id, name, given.length, "none", None, watch, slot)

    def _watch(self, key: str, given: E2EMap, length: int, number: int, of: int) -> Supervision:
        """The supervision of one message by E2E."""
        profile = self._profile(key, given, number, of)
        if length < profile.bytes_min:
            allowed = f"at most {given.offset - profile.bytes_min + length}, by the length"
            raise self._error(f"{key}.offset", str(given.offset), allowed)
        cycle_ms = given.cycle_ms or self._file.cycle_ms
        timeout_ms = given.timeout_ms or E2E_TIMEOUT_CYCLES * cycle_ms
        turn_ms = profile.counter_count * cycle_ms
        if not cycle_ms < timeout_ms < turn_ms:
            allowed = (
                f"more than {cycle_ms}, a cycle, and less than {turn_ms}, in which the counter comes round"
            )
            raise self._error(f"{key}.timeout_ms", str(timeout_ms), allowed)
        return Supervision(profile, cycle_ms * 1000, timeout_ms * 1000, length)

    def _profile(self, key: str, given: E2EMap, number: int, of: int) -> Profile:
        """That of the one of `of` messages with this number."""
        if given.profile == "p02":
            ids = given.data_ids
            if given.data_id is not None or ids is None or len(ids) != LIST_IDS or max(ids) > LIST_ID_MAX:
                found = "data_id" if given.data_id is not None else str(list(ids or ()))
                raise self._error(f"{key}.data_ids", found, "a list of 16 numbers from 0 to 255")
            if given.mode != "both" or given.offset:
                raise self._error(key, "mode or offset", "neither, in p02")
            return P02(bytes(ids))
        make, modes = WITH_ONE_ID[given.profile]
        if given.mode not in modes:
            raise self._error(f"{key}.mode", given.mode, f"{' or '.join(modes)}, in {given.profile}")
        self._check_one(key, "data_id and data_ids", given.data_id, given.data_ids)
        ids = given.data_ids
        if ids is not None and len(ids) != of:
            raise self._error(f"{key}.data_ids", f"{len(ids)} numbers", f"{of}, one for each message")
        data_id = given.data_id if ids is None else ids[number]
        assert data_id is not None
        if given.mode == "nibble" and data_id > NIBBLE_ID_MAX:
            raise self._error(
                key, f"data id {data_id:#06x}", f"at most {NIBBLE_ID_MAX:#06x} with mode nibble"
            )
        return make(data_id, given.mode, given.offset)

    def _mapped(self, key: str, message: str) -> int:
        """The id of a message that has a rule."""
        ids = {rule.name: rule.can_id for rule in self._rules.values() if rule.name is not None}
        if message not in ids:
            raise ConfigError(f"{self._path}: {key}: {unknown('mapped message', message, ids)}")
        return ids[message]

    # -- names and places

    def _names(self, key: str, messages: Messages) -> list[str]:
        if messages.last < messages.first:
            raise self._error(f"{key}.last", str(messages.last), f"{messages.first} (first) or more")
        for name in messages.names():
            self._check_message(f"{key}.name", name)
        return messages.names()

    def _check_quantity(self, key: str, quantity: MappedQuantity, name: str | None, length: int) -> None:
        self._check_one(key, "signal and raw", quantity.signal, quantity.raw)
        if quantity.raw is not None:
            end_bit = quantity.raw.first_bit() + quantity.raw.length_bits
            if end_bit > 8 * length:
                raise self._error(f"{key}.raw", f"{end_bit} bits", f"at most {8 * length}, by the length")
            return
        assert quantity.signal is not None
        if name is None:
            raise self._error(f"{key}.signal", quantity.signal, "raw, as the message is given by can_id")
        self._check_signal(f"{key}.signal", name, quantity.signal)
        unit = self._codec.unit(name, quantity.signal)
        if unit not in ("", quantity.unit):
            raise self._error(f"{key}.unit", quantity.unit, f"{unit}, as {quantity.signal} has in the DBC")

    def _check_message(self, key: str, name: str) -> None:
        if name not in self._codec.names():
            reason = unknown("message", name, self._codec.names())
            raise ConfigError(f"{self._path}: {key}: {reason}, by {self._codec.path}")

    def _check_signal(self, key: str, name: str, signal: str) -> None:
        if signal not in self._codec.signal_names(name):
            reason = unknown(f"signal of {name}", signal, self._codec.signal_names(name))
            raise ConfigError(f"{self._path}: {key}: {reason}, by {self._codec.path}")
        if signal in self._codec.misfits(name):
            raise self._error(key, f"{signal}, which does not lie in {name}", "a signal that does")

    def _check_whole(self, key: str, name: str, signal: str) -> None:
        self._check_signal(key, name, signal)
        if not self._codec.whole(name, signal):
            raise self._error(key, f"{signal}, which has a scale", "a whole number")

    def _check_one(self, key: str, names: str, first: object, second: object) -> None:
        if (first is None) == (second is None):
            raise self._error(key, names, "exactly one of them")

    def _error(self, key: str, found: str, allowed: str) -> ConfigError:
        return ConfigError(f"{self._path}: {key}: found {found}, allowed is {allowed}")

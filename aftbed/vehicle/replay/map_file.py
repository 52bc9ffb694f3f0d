"""Map files: which messages and signals of another car's bus mean what to the protected function.

A map is YAML; `MapFile` is its shape, key by key. It names messages and signals of a DBC, the unit of each
quantity, the length of each message, and the rules for its checksum and counter:

    strict         false: messages of the DBC that contradict themselves are taken (see `dbc_file`)
    cycle_end      the message that ends a radar cycle; its arrival makes the request
    ego.speed      the ego's own speed
    tracks         the radar's targets: one message for each slot, by a list of names, or by a `name` with {n}
                   (or {n:02}, with zeros in front, {n:x} or {n:X}, hexadecimal) from `first` to `last`; or
                   one message for all, with the number of the object in the signal `slot`, and, where the
                   radar announces how many will come, `count`
    others         messages that are judged and counted, but not used

{n} may also stand in the names of signals. A quantity that the DBC does not have may be given by its place in
the data (`raw`), in the DBC's own way of counting bits. A target's place beside our path is its
`lateral_offset`, or follows from its `angle`.

`bind` checks the whole map against the DBC, so a map that binds cannot fail later: the result has one
`FrameRule` per CAN id, in which all names are those of the DBC.
"""

import re
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from aftbed.core.errors import ConfigError, FileKeyError, unknown
from aftbed.core.yaml_file import in_file, read_yaml
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
from aftbed.vehicle.replay.units import Dimension, Unit, unit_names, unit_of

Sum = Literal["toyota", "none"]
Length = Annotated[int, Meta(ge=1, le=8)]
DataId = Annotated[int, Meta(ge=0, le=DATA_ID_MAX)]

MESSAGES_MAX: Final = 256  # under one key
NAMES_SHOWN_MAX: Final = 10  # of the DBC, where one that the map has is not there
NUMBER_MAX: Final = 65535
_NUMBER: Final = re.compile(r"\{n(?::(?:0([1-9]))?([xX])?)?\}")


class RawSignal(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A place in the data, as in a DBC: `start_bit` is the highest bit if big-endian, else the lowest."""

    start_bit: Annotated[int, Meta(ge=0, le=63)]  # the highest bit if big-endian, else the lowest
    length_bits: Annotated[int, Meta(ge=1, le=32)]  # of the signal
    byte_order: Literal["big_endian", "little_endian"]  # as in a DBC
    signed: bool = False  # two's complement
    scale: Annotated[float, Meta(ge=-1e6, le=1e6)] = 1.0  # times the number in the data
    offset: Annotated[float, Meta(ge=-1e6, le=1e6)] = 0.0  # added then

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
    """A quantity: a signal of the DBC, or raw; its value is multiplied by `scale`.

    Without `unit` it is in the unit that the DBC has.
    """

    unit: str | None = None  # as m, m/s, km/h, mph, deg; none: that of the DBC
    signal: str | None = None  # by its name in the DBC; or raw
    raw: RawSignal | None = None  # a place in the data
    scale: Annotated[float, Meta(ge=-1e6, le=1e6)] = 1.0  # times the value: -1 turns a direction round


class Counter(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A counter that rises by one with each frame, and starts over at `modulo`.

    A counter of two values is none: where one frame is lost, the next looks like the one before.
    """

    signal: str  # by its name in the DBC
    modulo: Annotated[int, Meta(ge=3, le=65536)]  # it starts over here


class E2EMap(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An E2E profile. `data_ids`: of P02 its list, else one for each of the messages.

    `cycle_ms` is how often the message comes, else that of the radar; without a good frame for `timeout_ms`,
    else six cycles, the sequence is void. `offset`, of the header, is in bytes.
    """

    profile: Literal["p01", "p02", "p05", "p11"]  # of AUTOSAR E2E
    data_id: DataId | None = None  # of the message
    data_ids: tuple[DataId, ...] | None = None
    mode: P01Mode = "both"  # how the data id is in the CRC
    offset: Annotated[int, Meta(ge=0, le=6)] = 0  # of the header, in bytes
    cycle_ms: Annotated[int, Meta(ge=1, le=1000)] | None = None  # of the message; none: of the radar
    timeout_ms: Annotated[int, Meta(ge=1, le=100_000)] | None = None  # no good frame: void


Checksum = Sum | E2EMap


class Messages(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One message, or those whose names have the numbers `first` to `last` in the place of {n}."""

    name: str  # as in the DBC, with {n} where the number is; {n:02}, {n:x}
    first: Annotated[int, Meta(ge=0, le=NUMBER_MAX)] = 0  # number
    last: Annotated[int, Meta(ge=0, le=NUMBER_MAX)] = 0  # number
    step: Annotated[int, Meta(ge=1, le=NUMBER_MAX)] = 1  # from a number to the next

    def numbers(self) -> range:
        return range(self.first, self.last + 1, self.step)

    def names(self) -> list[str]:
        return [numbered(self.name, number) for number in self.numbers()]


Names = Annotated[tuple[str, ...], Meta(min_length=1, max_length=MESSAGES_MAX)]


def numbered(name: str, number: int) -> str:
    """`name` with the number in the place of {n}."""

    def shown(found: re.Match[str]) -> str:
        return f"{number:0{found[1] or 0}{found[2] or 'd'}}"

    return _NUMBER.sub(shown, name)


class Flag(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Yes, if the signal has one of the values."""

    signal: str  # by its name in the DBC
    values: Annotated[tuple[int, ...], Meta(min_length=1)]  # one of these means yes


class ObjectCount(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where a message that comes before the objects announces how many there are."""

    message: str  # by its name in the DBC; it must be in others
    signal: str  # with the number of objects


class EgoMap(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The message with the ego speed: by `message` in the DBC, or by `can_id`. Unknown after `timeout_ms`."""

    length: Length  # bytes of data, as in the DBC
    speed: MappedQuantity  # of the car
    message: str | None = None  # by its name in the DBC; or can_id
    can_id: Annotated[int, Meta(ge=0, le=CAN_ID_MAX)] | None = None  # where the DBC does not have the message
    checksum: Checksum = "none"  # none, toyota, or an E2E profile
    counter: Counter | None = None  # that rises by one with each frame
    timeout_ms: Annotated[int, Meta(ge=1, le=10_000)] = 200  # an older speed is unknown


class TrackMap(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The radar's targets. `valid`, `new`: signals that are 1 for yes, or flags; without `valid` all are."""

    messages: Messages | Names  # {name: ...} with first and last for numbered ones, or a list of names
    length: Length  # bytes of data, as in the DBC
    range: MappedQuantity  # to the target
    relative_speed: MappedQuantity  # negative where it comes nearer
    lateral_offset: MappedQuantity | None = None  # to the left of the middle; or angle
    angle: MappedQuantity | None = None  # in polar coordinates
    slot: str | None = None  # one message carries all targets: the signal with the number of each
    count: ObjectCount | None = None  # with slot: what announces how many follow
    valid: str | Flag | None = None
    new: str | Flag | None = None
    checksum: Checksum = "none"  # none, toyota, or an E2E profile
    counter: Counter | None = None  # that rises by one with each frame


class OtherMap(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Messages of the radar that are not needed, or only for the number of objects."""

    messages: Messages | Names  # {name: ...} with first and last for numbered ones, or a list of names
    length: Length  # bytes of data, as in the DBC
    checksum: Checksum = "none"  # none, toyota, or an E2E profile
    counter: Counter | None = None  # that rises by one with each frame


class MapFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    description: str  # for people
    cycle_ms: Annotated[int, Meta(ge=1, le=1000)]  # how often the radar reports
    ego: EgoMap  # the message with the car's own speed
    tracks: TrackMap  # the radar's targets
    cycle_end: str | None = None  # the message that ends a cycle of the radar; not with tracks.count
    others: tuple[OtherMap, ...] = ()  # messages that are judged, and not used
    lane_half_width_m: Annotated[float, Meta(gt=0, le=10)] = 1.5  # a target beyond is not in our path
    strict: bool = True  # false: take messages of the DBC that contradict themselves, too


SHIPPED: Final = Path(__file__).resolve().parent / "maps"  # maps, and the DBCs that go with them
E2E_TIMEOUT_CYCLES: Final = 6  # as on our own bus


class Reading(msgspec.Struct, frozen=True):
    """Where a quantity is: in the signal, or else raw. `factor` makes metres, m/s or radians of its value."""

    signal: str | None
    raw: RawSignal | None
    factor: float

    def si(self, signals: Mapping[str, float], data: bytes) -> float:
        """Its value in a message that is long enough."""
        if self.raw is not None:
            return self.raw.read(data) * self.factor
        assert self.signal is not None
        return signals[self.signal] * self.factor


class FlagReading(msgspec.Struct, frozen=True):
    """Yes, if the signal has one of the values; without values, if it is not 0."""

    signal: str
    values: tuple[int, ...] | None

    def is_set(self, signals: Mapping[str, float]) -> bool:
        value = signals[self.signal]
        return bool(value) if self.values is None else int(value) in self.values


class TrackReading(msgspec.Struct, frozen=True):
    """Where a message has its target. One of `lateral_offset` and `angle` is None.

    `number`: which of the tracks' messages it is; `slot`: the signal with the number of the object instead.
    """

    number: int
    range: Reading
    relative_speed: Reading
    lateral_offset: Reading | None
    angle: Reading | None
    slot: str | None
    valid: FlagReading | None
    new: FlagReading | None


class FrameRule(msgspec.Struct, frozen=True):
    """How to judge the frames of one CAN id, and what they hold.

    `name` None: not in the DBC. `watch`: by E2E, and then there is neither checksum nor counter beside it.
    `track` None: not a track.
    """

    can_id: int
    name: str | None
    length: int
    checksum: Sum
    counter: Counter | None
    watch: Supervision | None
    track: TrackReading | None = None


class BoundMap(msgspec.Struct, frozen=True):
    """A map that was checked against its DBC.

    A radar cycle ends with a frame of `cycle_end_id`, or else with the last of the objects that a frame of
    `count_id` has announced: one of the two is None. `allots`: the objects are more than slots, or have
    numbers of their own. `problems`: what a person should look at.
    """

    map: MapFile
    codec: Codec
    rules: dict[int, FrameRule]
    ego_id: int
    ego_speed: Reading
    cycle_end_id: int | None
    count_id: int | None
    allots: bool
    problems: tuple[str, ...]


def find_map(name_or_path: str) -> Path:
    """A shipped map by name, or the path as it is: whatever has a slash or ends in .yaml or .yml."""
    is_path = "/" in name_or_path or name_or_path.endswith((".yaml", ".yml"))
    return Path(name_or_path) if is_path else _shipped("map", name_or_path, ".yaml")


def find_dbc(name_or_path: str) -> Path:
    """A shipped DBC by name, or the path as it is: whatever has a slash or a dot in it, or is a file."""
    path = Path(name_or_path)
    is_path = "/" in name_or_path or "." in name_or_path or path.is_file()
    return path if is_path else _shipped("DBC", name_or_path, ".dbc")


def shipped_maps() -> list[str]:
    return sorted(path.stem for path in SHIPPED.glob("*.yaml"))


def shipped_dbcs() -> list[str]:
    return sorted(path.stem for path in SHIPPED.glob("*.dbc"))


def read_map(path: Path) -> MapFile:
    """Raises ConfigError naming file, key, what was found and what is allowed."""
    return read_yaml(path, MapFile)


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
    codec = load_dbc(dbc, strict=file.strict)
    with in_file(path):
        return bind_file(file, codec)


def bind_file(file: MapFile, codec: Codec) -> BoundMap:
    """Check a map that was read, or is going to be written. Raises ConfigError."""
    return _Binding(codec, file).bound()


Source = EgoMap | TrackMap | OtherMap


class _Binding:
    """The checks; each error names the file, the key, what was found and what is allowed."""

    def __init__(self, codec: Codec, file: MapFile) -> None:
        self._codec = codec
        self._file = file
        self._rules: dict[int, FrameRule] = {}
        self._problems: dict[str, None] = dict.fromkeys(codec.notes)  # each once, in order

    def bound(self) -> BoundMap:
        file, tracks = self._file, self._file.tracks
        ego, ego_speed = self._bind_ego(file.ego)
        names = self._bind_tracks(tracks)
        for index, other in enumerate(file.others):
            messages = self._messages(f"others[{index}].messages", other.messages)
            for place, (number, name) in enumerate(messages):
                self._add(f"others[{index}]", other, name, number, place, len(messages))
        self._check_one("cycle_end", "cycle_end and tracks.count", file.cycle_end, tracks.count)
        end = None if file.cycle_end is None else self._mapped("cycle_end", file.cycle_end)
        count = None
        if tracks.count is not None:
            count = self._mapped("tracks.count.message", tracks.count.message)
            self._check_whole("tracks.count.signal", tracks.count.message, tracks.count.signal)
        allots = tracks.slot is not None or len(names) > SLOTS
        problems = tuple(self._problems)
        return BoundMap(file, self._codec, self._rules, ego, ego_speed, end, count, allots, problems)

    def _bind_ego(self, ego: EgoMap) -> tuple[int, Reading]:
        self._check_one("ego", "message and can_id", ego.message, ego.can_id)
        if ego.message is not None:
            self._check_message("ego.message", ego.message)
            can_id = self._add("ego", ego, ego.message, 0, 0, 1)
        else:
            assert ego.can_id is not None
            can_id = ego.can_id
            if ego.counter is not None:
                raise self._error("ego.counter", "a signal", "none, as ego is given by can_id")
            self._rules[can_id] = self._rule("ego", ego, can_id, None, None, 0, 1)
        return can_id, self._reading("ego.speed", Dimension.SPEED, ego.speed, ego.message, 0, ego.length)

    def _bind_tracks(self, tracks: TrackMap) -> list[str]:
        messages = self._messages("tracks.messages", tracks.messages)
        if tracks.slot is not None and len(messages) > 1:
            raise self._error("tracks.slot", f"a signal, for {len(messages)} messages", "one for one message")
        if tracks.count is not None and tracks.slot is None:
            raise self._error("tracks.count", "count without slot", "both, or neither")
        self._check_one("tracks", "lateral_offset and angle", tracks.lateral_offset, tracks.angle)
        for place, (number, name) in enumerate(messages):
            can_id = self._add("tracks", tracks, name, number, place, len(messages))
            track = self._track(tracks, name, number, place)
            self._rules[can_id] = msgspec.structs.replace(self._rules[can_id], track=track)
        return [name for _, name in messages]

    def _track(self, tracks: TrackMap, name: str, number: int, place: int) -> TrackReading:
        def reading(key: str, dimension: Dimension, quantity: MappedQuantity | None) -> Reading | None:
            if quantity is None:
                return None
            return self._reading(f"tracks.{key}", dimension, quantity, name, number, tracks.length)

        def flag(key: str, given: str | Flag | None) -> FlagReading | None:
            if given is None:
                return None
            if isinstance(given, Flag):
                signal = numbered(given.signal, number)
                self._check_whole(f"tracks.{key}.signal", name, signal)
                return FlagReading(signal, given.values)
            self._check_signal(f"tracks.{key}", name, numbered(given, number))
            return FlagReading(numbered(given, number), None)

        along = reading("range", Dimension.DISTANCE, tracks.range)
        speed = reading("relative_speed", Dimension.SPEED, tracks.relative_speed)
        assert along is not None
        assert speed is not None
        slot = None if tracks.slot is None else numbered(tracks.slot, number)
        if slot is not None:
            self._check_whole("tracks.slot", name, slot)
        return TrackReading(
            place,
            along,
            speed,
            reading("lateral_offset", Dimension.DISTANCE, tracks.lateral_offset),
            reading("angle", Dimension.ANGLE, tracks.angle),
            slot,
            flag("valid", tracks.valid),
            flag("new", tracks.new),
        )

    # -- rules

    def _add(self, key: str, given: Source, name: str, number: int, place: int, of: int) -> int:
        """Make the rule of one message of the DBC, the one at `place` of as many with the same; its id.

        `number` stands for {n}.
        """
        can_id, length = self._codec.can_id(name), self._codec.length(name)
        if self._codec.extended(name):
            raise self._error(key, f"{name} ({can_id:#x}, of 29 bits)", "an id of 11 bits")
        if given.length != length:
            raise self._error(f"{key}.length", str(given.length), f"{length}, as {name} has in the DBC")
        if can_id in self._rules:
            raise self._error(key, f"{name} ({can_id:#05x}) mapped twice", "once")
        if self._codec.multiplexed(name):
            raise self._error(key, f"{name}, which is multiplexed", "a message with the same signals always")
        counter = given.counter
        if counter is not None:
            counter = Counter(numbered(counter.signal, number), counter.modulo)
            self._check_whole(f"{key}.counter.signal", name, counter.signal)
        self._rules[can_id] = self._rule(key, given, can_id, name, counter, place, of)
        return can_id

    def _rule(
        self,
        key: str,
        given: Source,
        can_id: int,
        name: str | None,
        counter: Counter | None,
        place: int,
        of: int,
    ) -> FrameRule:
        if not isinstance(given.checksum, E2EMap):
            return FrameRule(can_id, name, given.length, given.checksum, counter, None)
        if given.counter is not None:
            raise self._error(f"{key}.counter", "a signal", f"none, as {given.checksum.profile} has its own")
        watch = self._watch(f"{key}.checksum", given.checksum, given.length, place, of)
        return FrameRule(can_id, name, given.length, "none", None, watch)

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
            raise FileKeyError(key, unknown("mapped message", message, ids))
        return ids[message]

    # -- names and places

    def _messages(self, key: str, messages: Messages | tuple[str, ...]) -> list[tuple[int, str]]:
        """The number for {n} and the name of each; of a list, the place in it."""
        if not isinstance(messages, Messages):
            for name in messages:
                self._check_message(key, name)
            return list(enumerate(messages))
        if messages.last < messages.first:
            raise self._error(f"{key}.last", str(messages.last), f"{messages.first} (first) or more")
        if len(messages.numbers()) > MESSAGES_MAX:
            raise self._error(key, f"{len(messages.numbers())} messages", f"at most {MESSAGES_MAX}")
        found = [(number, numbered(messages.name, number)) for number in messages.numbers()]
        for _, name in found:
            self._check_message(f"{key}.name", name)
        return found

    def _reading(
        self,
        key: str,
        dimension: Dimension,
        quantity: MappedQuantity,
        name: str | None,
        number: int,
        length: int,
    ) -> Reading:
        self._check_one(key, "signal and raw", quantity.signal, quantity.raw)
        if quantity.raw is not None:
            end_bit = quantity.raw.first_bit() + quantity.raw.length_bits
            if end_bit > 8 * length:
                raise self._error(f"{key}.raw", f"{end_bit} bits", f"at most {8 * length}, by the length")
            unit = self._unit(key, dimension, quantity.unit, None, "")
            return Reading(None, quantity.raw, unit.si * quantity.scale)
        assert quantity.signal is not None
        signal = numbered(quantity.signal, number)
        if name is None:
            raise self._error(f"{key}.signal", signal, "raw, as the message is given by can_id")
        self._check_signal(f"{key}.signal", name, signal)
        unit = self._unit(key, dimension, quantity.unit, signal, self._codec.unit(name, signal))
        return Reading(signal, None, unit.si * quantity.scale)

    def _unit(
        self, key: str, dimension: Dimension, given: str | None, signal: str | None, in_dbc: str
    ) -> Unit:
        """The unit of a quantity: that of the map, which must agree with the DBC's, or else the DBC's."""
        key, allowed = f"{key}.unit", f"{dimension}, in {', '.join(unit_names(dimension))}"
        known = unit_of(in_dbc)
        if given is None:
            if known is None:
                unit = f"the unit {in_dbc!r}" if in_dbc.strip() else "no unit"
                has = "raw has none" if signal is None else f"{signal} has {unit} in the DBC"
                raise self._error(key, "none", f"{allowed}, as {has}")
            if known.dimension is not dimension:
                raise self._error(key, f"{in_dbc}, as {signal} has in the DBC", allowed)
            return known
        unit_given = unit_of(given)
        if unit_given is None or unit_given.dimension is not dimension:
            raise self._error(key, given, allowed)
        if known is not None and known != unit_given:
            raise self._error(key, given, f"{in_dbc}, as {signal} has in the DBC")
        if known is None and in_dbc.strip():
            odd = f"{signal} has the unit {in_dbc!r} in the DBC, which aftbed does not know"
            self._problems[f"{key}: {odd}; {unit_given.name} is taken"] = None
        return unit_given

    def _check_message(self, key: str, name: str) -> None:
        if name not in self._codec.names():
            raise self._unknown(key, "message", name, self._codec.names())

    def _check_signal(self, key: str, name: str, signal: str) -> None:
        if signal not in self._codec.signal_names(name):
            raise self._unknown(key, f"signal of {name}", signal, self._codec.signal_names(name))
        if signal in self._codec.misfits(name):
            raise self._error(key, f"{signal}, which does not lie in {name}", "a signal that does")

    def _unknown(self, key: str, what: str, found: str, names: Sequence[str]) -> ConfigError:
        """Names the nearest of many: on a DBC of another radar, all are of no help."""
        near = get_close_matches(found, names, n=NAMES_SHOWN_MAX, cutoff=0.0)
        more = f" and {len(names) - len(near)} more" if len(names) > len(near) else ""
        reason = f"{unknown(what, found, near)}{more}, by {self._codec.path}{self._codec.left_out()}"
        return FileKeyError(key, reason)

    def _check_whole(self, key: str, name: str, signal: str) -> None:
        self._check_signal(key, name, signal)
        if not self._codec.whole(name, signal):
            raise self._error(key, f"{signal}, which has a scale", "a whole number")

    def _check_one(self, key: str, names: str, first: object, second: object) -> None:
        if (first is None) == (second is None):
            raise self._error(key, names, "exactly one of them")

    def _error(self, key: str, found: str, allowed: str) -> ConfigError:
        return FileKeyError(key, f"found {found}, allowed is {allowed}")

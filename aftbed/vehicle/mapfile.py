"""Maps: which messages and signals of somebody else's bus mean what to the protected function.

A map is YAML. It names messages and signals of a DBC, the unit in which each quantity comes, the length
of each message, and the rules for its checksum and counter. `bind` checks it whole against the DBC, so a
map that binds cannot fail later: what is left is one `Rule` per CAN id. A quantity that the DBC does not
know may be given by its place in the data (`raw`), in the DBC's own way of counting bits.

    cycle_end   the message that ends a radar cycle; its arrival makes the request
    ego.speed   the ego's own speed
    tracks      the radar's slots, up to 16: one message each, `name` with {n} from `first` to `last`
    others      messages that are judged and counted, but not used
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from aftbed.core.errors import ConfigError, unknown
from aftbed.vehicle.aebmessages import SLOTS
from aftbed.vehicle.dbcfile import Codec
from aftbed.vehicle.frame import CAN_ID_MAX
from aftbed.vehicle.yamlfile import read_yaml

SpeedUnit = Literal["m/s", "km/h"]
DistanceUnit = Literal["m", "cm"]
ChecksumRule = Literal["toyota", "none"]
Length = Annotated[int, Meta(ge=1, le=8)]

TO_SI: Final[Mapping[str, float]] = {"m": 1.0, "cm": 0.01, "m/s": 1.0, "km/h": 1 / 3.6}
_FOLDER: Final = Path(__file__).resolve().parent / "maps"


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


Quantity = Speed | Distance


class Counter(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A counter that rises by one with each frame, and starts over at `modulo`."""

    signal: str
    modulo: Annotated[int, Meta(ge=2, le=65536)]


class Messages(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One message, or those whose names have the numbers `first` to `last` in the place of {n}."""

    name: str
    first: Annotated[int, Meta(ge=0, le=255)] = 0
    last: Annotated[int, Meta(ge=0, le=255)] = 0

    def names(self) -> list[str]:
        """All of them, in order."""
        return [self.name.replace("{n}", str(number)) for number in range(self.first, self.last + 1)]


class EgoMap(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The message with the ego speed: by `message` in the DBC, or by `can_id`. Unknown after `timeout_ms`."""

    length: Length
    speed: Speed
    message: str | None = None
    can_id: Annotated[int, Meta(ge=0, le=CAN_ID_MAX)] | None = None
    checksum: ChecksumRule = "none"
    counter: Counter | None = None
    timeout_ms: Annotated[int, Meta(ge=1, le=10_000)] = 200


class TrackMap(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The radar's slots. `valid` and `new` are signals that are 1 for yes."""

    messages: Messages
    length: Length
    range: Distance
    relative_speed: Speed
    lateral_offset: Distance
    valid: str
    new: str | None = None
    checksum: ChecksumRule = "none"
    counter: Counter | None = None


class OtherMap(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Messages that belong to the radar but say nothing that is needed."""

    messages: Messages
    length: Length
    checksum: ChecksumRule = "none"
    counter: Counter | None = None


class MapFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A map, key by key."""

    description: str
    cycle_ms: Annotated[int, Meta(ge=1, le=1000)]
    cycle_end: str
    ego: EgoMap
    tracks: TrackMap
    others: tuple[OtherMap, ...] = ()
    lane_half_width_m: Annotated[float, Meta(gt=0, le=10)] = 1.5


class Rule(msgspec.Struct, frozen=True):
    """How to judge the frames of one CAN id. `name` None: not in the DBC. `slot` None: not a track."""

    can_id: int
    name: str | None
    length: int
    checksum: ChecksumRule
    counter: Counter | None
    slot: int | None = None


class BoundMap(msgspec.Struct, frozen=True):
    """A map that was checked against its DBC."""

    map: MapFile
    codec: Codec
    rules: dict[int, Rule]
    ego_id: int
    cycle_end_id: int


def find_map(name_or_path: str) -> Path:
    """A shipped map by name, or the path as it is: whatever has a slash or ends in .yaml or .yml."""
    if "/" in name_or_path or name_or_path.endswith((".yaml", ".yml")):
        return Path(name_or_path)
    names = sorted(path.stem for path in _FOLDER.glob("*.yaml"))
    if name_or_path not in names:
        raise unknown("map", name_or_path, names)
    return _FOLDER / f"{name_or_path}.yaml"


def bind(path: Path, codec: Codec) -> BoundMap:
    """Read the map at `path` and check all of it against the DBC. Raises ConfigError."""
    return _Binding(path, codec).bound(read_yaml(path, MapFile))


class _Binding:
    """The checks; each says the file, the key, what was found and what is allowed."""

    def __init__(self, path: Path, codec: Codec) -> None:
        self._path = path
        self._codec = codec
        self._rules: dict[int, Rule] = {}

    def bound(self, file: MapFile) -> BoundMap:
        ego = self._ego(file.ego)
        self._tracks(file.tracks)
        for index, other in enumerate(file.others):
            for name in self._names(f"others[{index}].messages", other.messages):
                self._add(f"others[{index}]", other, name, None)
        ids = {rule.name: rule.can_id for rule in self._rules.values() if rule.name is not None}
        if file.cycle_end not in ids:
            raise ConfigError(f"{self._path}: cycle_end: {unknown('mapped message', file.cycle_end, ids)}")
        return BoundMap(file, self._codec, self._rules, ego, ids[file.cycle_end])

    def _ego(self, ego: EgoMap) -> int:
        if (ego.message is None) == (ego.can_id is None):
            raise self._error("ego", "message and can_id", "exactly one of them")
        if ego.can_id is None:
            assert ego.message is not None
            self._message("ego.message", ego.message)
            can_id = self._add("ego", ego, ego.message, None)
        else:
            can_id = ego.can_id
            if ego.counter is not None:
                raise self._error("ego.counter", "a signal", "none, as ego is given by can_id")
            self._rules[can_id] = Rule(can_id, None, ego.length, ego.checksum, None)
        self._quantity("ego.speed", ego.speed, ego.message, ego.length)
        return can_id

    def _tracks(self, tracks: TrackMap) -> None:
        names = self._names("tracks.messages", tracks.messages)
        if len(names) > SLOTS:
            raise self._error("tracks.messages", f"{len(names)} messages", f"at most {SLOTS}")
        for slot, name in enumerate(names):
            self._add("tracks", tracks, name, slot)
            self._quantity("tracks.range", tracks.range, name, tracks.length)
            self._quantity("tracks.relative_speed", tracks.relative_speed, name, tracks.length)
            self._quantity("tracks.lateral_offset", tracks.lateral_offset, name, tracks.length)
            self._signal("tracks.valid", name, tracks.valid)
            if tracks.new is not None:
                self._signal("tracks.new", name, tracks.new)

    def _add(self, key: str, given: EgoMap | TrackMap | OtherMap, name: str, slot: int | None) -> int:
        """Make the rule of one message of the DBC."""
        can_id, length = self._codec.can_id(name), self._codec.length(name)
        if given.length != length:
            raise self._error(f"{key}.length", str(given.length), f"{length}, as {name} has in the DBC")
        if can_id in self._rules:
            raise self._error(key, f"{name} ({can_id:#05x}) mapped twice", "once")
        if self._codec.multiplexed(name):
            raise self._error(key, f"{name}, which is multiplexed", "a message with the same signals always")
        if given.counter is not None:
            self._counter(f"{key}.counter.signal", name, given.counter.signal)
        self._rules[can_id] = Rule(can_id, name, length, given.checksum, given.counter, slot)
        return can_id

    def _names(self, key: str, messages: Messages) -> list[str]:
        if messages.last < messages.first:
            raise self._error(f"{key}.last", str(messages.last), f"{messages.first} (first) or more")
        for name in messages.names():
            self._message(f"{key}.name", name)
        return messages.names()

    def _quantity(self, key: str, quantity: Quantity, name: str | None, length: int) -> None:
        if (quantity.signal is None) == (quantity.raw is None):
            raise self._error(key, "signal and raw", "exactly one of them")
        if quantity.raw is not None:
            end_bit = quantity.raw.first_bit() + quantity.raw.length_bits
            if end_bit > 8 * length:
                raise self._error(f"{key}.raw", f"{end_bit} bits", f"at most {8 * length}, by the length")
            return
        assert quantity.signal is not None
        if name is None:
            raise self._error(f"{key}.signal", quantity.signal, "raw, as the message is given by can_id")
        self._signal(f"{key}.signal", name, quantity.signal)
        unit = self._codec.unit(name, quantity.signal)
        if unit not in ("", quantity.unit):
            raise self._error(f"{key}.unit", quantity.unit, f"{unit}, as {quantity.signal} has in the DBC")

    def _message(self, key: str, name: str) -> None:
        if name not in self._codec.names():
            reason = unknown("message", name, self._codec.names())
            raise ConfigError(f"{self._path}: {key}: {reason}, by {self._codec.path}")

    def _signal(self, key: str, name: str, signal: str) -> None:
        if signal not in self._codec.signal_names(name):
            reason = unknown(f"signal of {name}", signal, self._codec.signal_names(name))
            raise ConfigError(f"{self._path}: {key}: {reason}, by {self._codec.path}")

    def _counter(self, key: str, name: str, signal: str) -> None:
        self._signal(key, name, signal)
        if not self._codec.whole(name, signal):
            raise self._error(key, f"{signal}, which has a scale", "a whole number")

    def _error(self, key: str, found: str, allowed: str) -> ConfigError:
        return ConfigError(f"{self._path}: {key}: found {found}, allowed is {allowed}")

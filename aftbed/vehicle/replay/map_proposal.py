"""Proposes a map: which messages of a DBC are the radar's targets, and which signal is the ego's speed.

By names and units first: a signal whose name has the words of a distance, and whose unit is one of a distance
or none, may be the range. Messages with the same signals in the same places are the tracks of one radar; of
several such groups, and of several signals for one quantity, the one whose words say more is taken.

A log says what moves. Then only messages that are in it are proposed, and it also shows the radar's cycle,
which message ends it, whether the counter counts and the checksum is Toyota's, which values of a status come
with a distance, and whether the range changes as the relative speed says: of the other sign, or in another
unit where the DBC has none.

All that was guessed is among the problems of the proposal: a person has to look at it.
"""

import re
from collections import Counter as Counts
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from statistics import median
from typing import Final, TypeVar

import msgspec
import yaml

from aftbed.core.errors import ConfigError, shown
from aftbed.vehicle.aeb.messages import SPEED_MAX_MS
from aftbed.vehicle.can.dbc_file import Codec, SignalPlace
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.replay.map_file import MESSAGES_MAX, NUMBER_MAX, BoundMap, MapFile, bind_file, numbered
from aftbed.vehicle.replay.mapped_gateway import toyota_checksum
from aftbed.vehicle.replay.units import Dimension, unit_of

FRAMES_MAX: Final = 200_000  # of the log, from its beginning: some minutes of a bus, and seconds of work
CYCLE_MS_GUESSED: Final = 50
NEAR_IDS: Final = 16  # a radar's other messages have ids so near those of its tracks
STATUS_BITS_MAX: Final = 4
RANGES_MOVING: Final = 3  # different values of a distance that something real comes to at least
PAIR_MS_MAX: Final = 300  # two frames of one target
PAIR_M_MAX: Final = 5.0  # it moved so far at most: else it is another target
RADIANS_MAX: Final = 3.3  # an angle without a unit whose range ends below is one in radians

_WORD: Final = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[0-9]+")
_DIGITS: Final = re.compile(r"[0-9]+")
_DISTANCE: Final = frozenset(("dist", "distance", "range", "rng", "dst"))
_ALONG: Final = frozenset(("long", "longitudinal", "lon", "lng", "dx"))
_ACROSS: Final = frozenset(("lat", "lateral", "dy", "side"))
_SPEED: Final = frozenset(("speed", "spd", "vel", "velocity", "vrel", "rvel", "relv", "relspd", "vx"))
_ANGLE: Final = frozenset(("angle", "azimuth", "azmth", "azm", "ang", "bearing"))
_RELATIVE: Final = frozenset(("rel", "relative", "vrel", "rvel", "relv", "relspd", "rate"))
_COUNTER: Final = frozenset(("counter", "ctr", "cnt", "rolling", "alive"))
_NUMBER: Final = frozenset(("id", "index", "idx"))
_MANY: Final = frozenset(("nof", "num", "number", "count", "no"))
_OBJECTS: Final = frozenset(("obj", "objs", "object", "objects", "target", "targets", "track", "tracks"))
_OTHERWISE: Final = frozenset(  # words of signals about a quantity, or of another one
    (
        *("accel", "acceleration", "sigma", "rms", "std", "stddev", "err", "error", "confid", "confidence"),
        *("prob", "probability", "var", "width", "height", "length", "size", "class", "type", "mode", "qf"),
        *("quality", "count", "counter", "checksum", "crc", "amplitude", "misalign", "min", "max", "sec"),
        *("bias", "fault", "factor", "units", "unit", "valid", "status", "state", "setting"),
    )
)
_NOT_OURS: Final = _RELATIVE | frozenset(  # words of speeds that are not the ego's over ground
    (
        *(
            "set",
            "limit",
            "lim",
            "target",
            "obj",
            "object",
            "cruise",
            "yaw",
            "offset",
            "fan",
            "engine",
            "wiper",
        ),
        *("map", "fleet", "sign", "gps", "max", "min", "motor", "turbine", "lead", "lateral", "lat", "angle"),
        *("steering", "request", "req", "cmd", "display", "digital", "analog", "inverse", "loc", "blower"),
    )
)
_OURS: Final = frozenset(("vehicle", "veh", "ego", "car", "host", "esp", "abs", "vss", "radardevice"))

Item = TypeVar("Item")


class MapProposal(msgspec.Struct, frozen=True):
    """`map` is a map file as plain values, or None; `bound` is it, checked, if it is whole."""

    map: dict[str, object] | None
    bound: BoundMap | None
    problems: tuple[str, ...]

    def text(self) -> str:
        """The map as YAML, with the problems as a comment."""
        assert self.map is not None
        notes = "".join(f"# - {shown(' '.join(problem.split()))}\n" for problem in self.problems)
        head = "# Proposed by `aftbed map new`"
        body = yaml.dump(self.map, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=118)
        return f"{head}; to be looked at:\n{notes}{body}" if notes else f"{head}.\n{body}"


class _Hex(int):
    """A number that is written in hexadecimal."""


class _Dumper(yaml.SafeDumper):
    """Writes `_Hex` as 0x51f."""

    def ignore_aliases(self, data: object) -> bool:
        return True


_Dumper.add_representer(
    _Hex, lambda dumper, data: dumper.represent_scalar("tag:yaml.org,2002:int", f"{data:#x}")
)


def propose(codecs: Sequence[Codec], frames: Sequence[Frame] = ()) -> MapProposal:
    """A map for the first of the DBCs, not read strictly, that has a radar.

    The ego's speed may be in another of them.
    """
    first = None
    for codec in codecs:
        proposal = _Proposing([codec, *(other for other in codecs if other is not codec)], frames).proposal()
        if proposal.map is not None:
            return proposal
        first = first or proposal
    assert first is not None
    return first


# -- signals by their words -----------------------------------------------------------------------


def words_of(name: str) -> frozenset[str]:
    """The words in the name of a signal, in small letters: DET_RangeRate_04 has det, range, rate and 04."""
    return frozenset(word.lower() for word in _WORD.findall(name))


def _may_be(signal: SignalPlace, dimension: Dimension) -> bool:
    """By its unit."""
    unit = unit_of(signal.unit)
    return not signal.unit.strip() if unit is None else unit.dimension is dimension


def _with_unit(signal: SignalPlace) -> int:
    return 2 if unit_of(signal.unit) is not None else 0


def _is_speed(signal: SignalPlace, words: frozenset[str]) -> bool:
    """Where the unit says it, a V is enough."""
    return bool(words & _SPEED) or ("v" in words and _with_unit(signal) > 0)


def _range(signal: SignalPlace, words: frozenset[str]) -> int:
    if not _may_be(signal, Dimension.DISTANCE) or words & (_ACROSS | _OTHERWISE | {"rate"}):
        return 0
    if not words & (_DISTANCE | {"dx"}):
        return 0
    return 3 + _with_unit(signal) + bool(words & _ALONG)


def _relative_speed(signal: SignalPlace, words: frozenset[str]) -> int:
    if not _may_be(signal, Dimension.SPEED) or words & (_ACROSS | _ANGLE | _OTHERWISE):
        return 0
    if not (_is_speed(signal, words) or (words & _DISTANCE and "rate" in words)):
        return 0
    return 3 + _with_unit(signal) + bool(words & _RELATIVE) + bool(words & _ALONG)


def _lateral_offset(signal: SignalPlace, words: frozenset[str]) -> int:
    if not _may_be(signal, Dimension.DISTANCE) or words & (_OTHERWISE | _SPEED | {"rate"}):
        return 0
    if not (words & _ACROSS and words & (_DISTANCE | {"pos", "position", "offset", "ofst", "dy"})):
        return 0
    return 3 + _with_unit(signal)


def _angle(signal: SignalPlace, words: frozenset[str]) -> int:
    if not _may_be(signal, Dimension.ANGLE) or words & (_OTHERWISE | {"rate"}) or not words & _ANGLE:
        return 0
    return 3 + _with_unit(signal)


def _valid(signal: SignalPlace, words: frozenset[str]) -> int:
    if not signal.whole or signal.length_bits > STATUS_BITS_MAX or words & {"fault", "error", "range"}:
        return 0
    score = 4 if "valid" in words else 3 if words & {"status", "state"} else 2 if "tracked" in words else 0
    return score * 2 - any(word.isdigit() for word in words) if score else 0  # STATE before STATE_2


def _new(signal: SignalPlace, words: frozenset[str]) -> int:
    fits = signal.length_bits == 1 and "new" in words and not words & {"signal", "msg"}
    return 1 if fits else 0


def _counter(signal: SignalPlace, words: frozenset[str]) -> int:
    return 1 if signal.whole and 2 <= signal.length_bits <= 16 and words & _COUNTER else 0


def _slot(signal: SignalPlace, words: frozenset[str]) -> int:
    return 1 if signal.whole and signal.length_bits >= 4 and words & _NUMBER else 0


def _ego_speed(signal: SignalPlace, words: frozenset[str]) -> int:
    if not _may_be(signal, Dimension.SPEED) or not _with_unit(signal) or words & (_NOT_OURS | _OTHERWISE):
        return 0
    if not _is_speed(signal, words):
        return 0
    of_car = 3 * bool(words & _OURS)
    return 3 + of_car - bool(words & {"calc", "raw", "comp"}) - bool(words & {"wheel", "whl"})


Scorer = Callable[[SignalPlace, frozenset[str]], int]
QUANTITIES: Final[Mapping[str, tuple[Scorer, Dimension]]] = {
    "range": (_range, Dimension.DISTANCE),
    "relative_speed": (_relative_speed, Dimension.SPEED),
    "lateral_offset": (_lateral_offset, Dimension.DISTANCE),
    "angle": (_angle, Dimension.ANGLE),
}
MARKS: Final[Mapping[str, Scorer]] = {"valid": _valid, "new": _new, "counter": _counter, "slot": _slot}


def _best(signals: Iterable[SignalPlace], score: Scorer) -> tuple[int, SignalPlace] | None:
    """The signal with the highest score above 0; of several the first, but the shortest name."""
    found = [(score(one, words_of(one.name)), one) for one in signals]
    return max(
        (pair for pair in found if pair[0]), key=lambda pair: (pair[0], -len(pair[1].name)), default=None
    )


class _Group(msgspec.Struct, frozen=True):
    """Messages with the same signals in the same places; `roles` are the signals of the first of them."""

    names: tuple[str, ...]
    roles: dict[str, SignalPlace]
    score: int


# -- names with numbers ---------------------------------------------------------------------------


def name_pattern(names: Sequence[str]) -> tuple[str, range] | None:
    """A name with {n} that gives all of `names` in their order, and the numbers; None if there is none."""
    for digits, base, kind in (("0-9", 10, ""), ("0-9a-f", 16, "x"), ("0-9A-F", 16, "X")):
        found = _split(names, digits)
        if found is None:
            continue
        head, middles, tail = found
        numbers = [int(middle, base) for middle in middles]
        if max(numbers) > NUMBER_MAX:
            continue
        steps = {after - before for before, after in pairwise(numbers)}
        if len(steps) != 1 or min(steps) < 1:
            continue
        run = range(numbers[0], numbers[-1] + 1, steps.pop())
        for spec in (kind, *(f"0{width}{kind}" for width in range(2, 10))):
            pattern = f"{head}{{n{spec and ':'}{spec}}}{tail}"
            if [numbered(pattern, number) for number in run] == list(names):
                return pattern, run
    return None


def _split(names: Sequence[str], digits: str) -> tuple[str, list[str], str] | None:
    """What all names begin and end with, and the digits between."""
    head = re.sub(rf"[{digits}]+$", "", _common(names))
    rests = [name[len(head) :] for name in names]
    tail = re.sub(rf"^[{digits}]+", "", _common([rest[::-1] for rest in rests])[::-1])
    middles = [rest[: len(rest) - len(tail)] for rest in rests]
    return (head, middles, tail) if all(re.fullmatch(rf"[{digits}]+", one) for one in middles) else None


def _common(names: Sequence[str]) -> str:
    """What all names begin with."""
    first, last = min(names), max(names)
    return first[: next((i for i, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), len(first))]


# -- the proposal ---------------------------------------------------------------------------------

Row = tuple[int, str, dict[str, float]]  # time, message, signals


class _Proposing:
    def __init__(self, codecs: Sequence[Codec], frames: Sequence[Frame]) -> None:
        self._codecs = codecs
        self._codec = codecs[0]
        self._by_id: dict[int, list[Frame]] = {}
        for frame in frames[:FRAMES_MAX]:
            self._by_id.setdefault(frame.can_id, []).append(frame)
        self._problems = dict.fromkeys(note for codec in codecs for note in codec.notes)

    def proposal(self) -> MapProposal:
        group = self._group()
        if group is None:
            return MapProposal(None, None, tuple(self._problems))
        rows = self._rows(group)
        messages, numbers = self._messages(group)
        tracks: dict[str, object] = {"messages": messages, "length": self._codec.length(group.names[0])}
        tracks |= self._protection(group, rows, numbers)
        tracks |= self._quantities(group, rows, numbers)
        if "valid" in group.roles:
            tracks["valid"] = self._valid(group, rows, numbers)
        elif group.roles["range"].offset == 0:
            tracks["valid"] = self._name(group, "range", numbers)
            self._note(
                "tracks.valid: no signal says which targets are valid; all with another range than 0 are"
            )
        else:
            self._note("tracks.valid: no signal says which targets are valid, so all are")
        if "new" in group.roles:
            tracks["new"] = self._name(group, "new", numbers)
        plain: dict[str, object] = {
            "description": f"{self._codec.path.stem}, proposed by its names and units"
        }
        count = None
        if "slot" in group.roles:
            tracks["slot"] = group.roles["slot"].name
            count = self._count(group)
        if count is not None:
            end, signal = count
            tracks["count"] = {"message": end, "signal": signal}
        else:
            end = self._cycle_end(group)
            plain["cycle_end"] = end
        plain["cycle_ms"] = self._cycle_ms(end)
        other = {"messages": {"name": end}, "length": self._codec.length(end)}
        others: dict[str, object] = {} if end in group.names else {"others": [other]}
        ego = self._ego(group)
        if ego is not None:
            plain["ego"] = ego
        plain |= {"tracks": tracks} | others
        if any(self._codec.contradicts(name) for name in self._named(plain, group)):
            self._note("strict: signals of messages that are used overlap, or lie outside")
            plain["strict"] = False
        return self._checked(plain)

    def _checked(self, plain: dict[str, object]) -> MapProposal:
        """With the map bound, where it is whole."""
        proposal = MapProposal(plain, None, tuple(self._problems))
        if "ego" not in plain:
            return proposal
        try:
            file = msgspec.convert(yaml.safe_load(proposal.text()), MapFile)
            bound = bind_file(file, self._codec)
        except (ConfigError, msgspec.ValidationError) as error:  # a signal beyond what a map may have
            problem = f"the proposed map: {error}"
            return msgspec.structs.replace(proposal, problems=(*proposal.problems, problem))
        return msgspec.structs.replace(proposal, bound=bound)

    @staticmethod
    def _named(plain: Mapping[str, object], group: _Group) -> list[str]:
        """The messages of the map."""
        ego, others = plain.get("ego"), plain.get("others")
        found = list(group.names)
        found += [str(ego["message"])] if isinstance(ego, dict) and "message" in ego else []
        found += [str(one["messages"]["name"]) for one in others] if isinstance(others, list) else []
        return found

    def _note(self, problem: str) -> None:
        self._problems[problem] = None

    def _seen(self, codec: Codec, name: str) -> list[Frame]:
        return self._by_id.get(codec.can_id(name), [])

    @staticmethod
    def _usable(codec: Codec) -> Iterator[str]:
        """Classic messages with 11-bit ids and the same signals always, in the order of their ids."""
        names = [name for name in codec.names() if codec.flaw(name) is None]
        for name in sorted(names, key=codec.can_id):
            if not codec.extended(name) and not codec.multiplexed(name) and codec.length(name):
                yield name

    # -- which messages

    def _group(self) -> _Group | None:
        """The best of those that have a distance, a relative speed, and a place beside our path."""
        shapes: dict[object, list[str]] = {}
        for name in self._usable(self._codec):
            signals = self._codec.signals(name)
            shape = tuple(
                (
                    _DIGITS.sub("#", one.name),
                    one.start_bit,
                    one.length_bits,
                    one.scale,
                    one.offset,
                    one.signed,
                )
                for one in signals
            )
            shapes.setdefault((self._codec.length(name), shape), []).append(name)
        groups = [group for names in shapes.values() if (group := self._group_of(names)) is not None]
        if not groups:
            self._note("no message has a distance, a relative speed and a lateral offset or an angle")
            return None
        logged = [group for group in groups if any(self._seen(self._codec, name) for name in group.names)]
        if self._by_id and not logged:
            self._note(f"the log has no frame of the radar: none of {groups[0].names[0]}, ...")
        return max(logged or groups, key=self._promise)

    def _group_of(self, names: Sequence[str]) -> _Group | None:
        roles: dict[str, SignalPlace] = {}
        score, left = 0, self._codec.signals(names[0])
        for key, (scorer, _) in QUANTITIES.items():
            if (found := _best(left, scorer)) is not None:
                score += found[0]
                roles[key] = found[1]
                left = [one for one in left if one is not found[1]]
        if not {"range", "relative_speed"} <= roles.keys() or not {"lateral_offset", "angle"} & roles.keys():
            return None
        if "lateral_offset" in roles:
            roles.pop("angle", None)
        for key, mark in MARKS.items():
            if (found := _best(left, mark)) is not None and (key != "slot" or len(names) == 1):
                roles[key] = found[1]
                score += key == "valid"
        return _Group(tuple(names[:MESSAGES_MAX]), roles, score)

    def _promise(self, group: _Group) -> tuple[bool, bool, int, int]:
        ranges = {values[group.roles["range"].name] for _, _, values in self._rows(group)}
        moves = len(ranges) >= RANGES_MOVING
        return moves, len(group.names) > 1 or "slot" in group.roles, group.score, len(group.names)

    def _rows(self, group: _Group) -> list[Row]:
        """The frames of the group in the log, in order, with the signal names of its first message."""
        first = [one.name for one in self._codec.signals(group.names[0])]
        rows = []
        for name in group.names:
            own = [one.name for one in self._codec.signals(name)]
            for frame in self._seen(self._codec, name):
                if len(frame.data) == self._codec.length(name):
                    values = self._codec.decode(name, frame.data)
                    rows.append((frame.t_us, name, {a: values[b] for a, b in zip(first, own, strict=True)}))
        return sorted(rows, key=lambda row: row[0])

    def _messages(self, group: _Group) -> tuple[object, Sequence[int]]:
        """The key `messages`, and the number of each for {n}."""
        names = group.names
        if len(names) == 1:
            return {"name": names[0]}, [0]
        found = name_pattern(names)
        if found is None:
            return list(names), range(len(names))
        pattern, run = found
        write = _Hex if pattern.partition("{n")[2].partition("}")[0].lower().endswith("x") else int
        key: dict[str, object] = {"name": pattern, "first": write(run[0]), "last": write(run[-1])}
        return key | ({"step": run.step} if run.step > 1 else {}), run

    def _name(self, group: _Group, role: str, numbers: Sequence[int]) -> str:
        """The name of a signal in all messages of the group, with {n} where it has the number."""
        first = self._codec.signals(group.names[0])
        place = first.index(group.roles[role])
        names = [self._codec.signals(name)[place].name for name in group.names]
        if len(set(names)) == 1:
            return names[0]
        for spec in ("", *(f"0{width}" for width in range(2, 5)), "x", "X", "02x", "02X", "03x", "03X"):
            text = numbered(f"{{n{spec and ':'}{spec}}}", numbers[0])
            for found in re.finditer(re.escape(text), names[0]):
                pattern = f"{names[0][: found.start()]}{{n{spec and ':'}{spec}}}{names[0][found.end() :]}"
                if [numbered(pattern, number) for number in numbers] == names:
                    return pattern
        self._note(f"tracks.{role}: {names[0]}, {names[1]}, ... have no numbers in common with the messages")
        return names[0]

    # -- what the signals mean

    def _quantities(self, group: _Group, rows: list[Row], numbers: Sequence[int]) -> dict[str, object]:
        found: dict[str, object] = {}
        speed_unit, scale = self._motion(group, rows)
        for key, (_, dimension) in QUANTITIES.items():
            if key not in group.roles:
                continue
            signal = group.roles[key]
            unit = unit_of(signal.unit)
            name = unit.name if unit is not None else speed_unit if key == "relative_speed" else "m"
            if unit is None and dimension is Dimension.ANGLE:
                name = "rad" if signal.high is not None and abs(signal.high) <= RADIANS_MAX else "deg"
            if unit is None:
                self._note(f"tracks.{key}: {signal.name} has no unit in the DBC; {name} is taken")
            quantity: dict[str, object] = {"signal": self._name(group, key, numbers), "unit": name}
            found[key] = quantity | ({"scale": scale} if key == "relative_speed" and scale != 1 else {})
        return found

    def _motion(self, group: _Group, rows: list[Row]) -> tuple[str, int]:
        """The unit of the relative speed where the DBC has none, and its sign, by how the range changes."""
        along, speed = group.roles["range"], group.roles["relative_speed"]
        distance, unit = unit_of(along.unit), unit_of(speed.unit)
        to_m, to_ms = (1.0 if distance is None else distance.si), (1.0 if unit is None else unit.si)
        last: dict[object, tuple[int, float]] = {}
        product = square = 0.0
        for t_us, name, values in rows:
            number = values[group.roles["slot"].name] if "slot" in group.roles else name
            range_m, speed_ms = values[along.name] * to_m, values[speed.name] * to_ms
            before = last.get(number)
            last[number] = (t_us, range_m)
            if before is None or not 0 < t_us - before[0] < PAIR_MS_MAX * 1000 or 0 in (range_m, before[1]):
                continue
            moved_m = range_m - before[1]
            if abs(moved_m) < PAIR_M_MAX:
                product += moved_m / (t_us - before[0]) * 1e6 * speed_ms
                square += speed_ms * speed_ms
        if square == 0 or product == 0:
            return "m/s", 1
        ratio = product / square
        names = {1.0: "m/s", 1 / 3.6: "km/h", 0.44704: "mph"} if unit is None else {1.0: ""}
        nearest = min(names, key=lambda one: abs(one - abs(ratio)))
        if abs(abs(ratio) / nearest - 1) > 0.3:
            off = f"{speed.name} is {1 / ratio:.2g} times as fast as {along.name} changes"
            self._note(f"tracks.relative_speed: {off}")
        if ratio < 0:
            self._note(f"tracks.relative_speed: {speed.name} is positive where a target comes nearer")
        return names[nearest] or "m/s", -1 if ratio < 0 else 1

    def _valid(self, group: _Group, rows: list[Row], numbers: Sequence[int]) -> object:
        signal, along = group.roles["valid"], group.roles["range"]
        name = self._name(group, "valid", numbers)
        if signal.length_bits == 1:
            return name
        most = 2**signal.length_bits
        named = [
            value for value, text in signal.choices if not words_of(text) & {"no", "not", "invalid", "none"}
        ]
        seen = sorted({int(values[signal.name]) for _, _, values in rows if values[along.name]} - {0})
        values = named or seen or list(range(1, most))
        why = "by their names" if named else "seen with a distance in the log" if seen else "all but 0"
        taken = ", ".join(map(str, values))
        self._note(f"tracks.valid: {signal.name} has {most} values; taken for valid: {taken} ({why})")
        return {"signal": name, "values": values}

    def _protection(self, group: _Group, rows: list[Row], numbers: Sequence[int]) -> dict[str, object]:
        found: dict[str, object] = {}
        frames = [(frame, name) for name in group.names for frame in self._seen(self._codec, name)]
        sums = [
            one for one in self._codec.signals(group.names[0]) if words_of(one.name) & {"checksum", "crc"}
        ]
        if frames and all(_is_toyota(frame) for frame, _ in frames):
            found["checksum"] = "toyota"
        elif sums:
            self._note(f"tracks.checksum: {sums[0].name} is not checked: aftbed does not know how")
        if "counter" in group.roles:
            signal = group.roles["counter"]
            modulo = 2**signal.length_bits
            steps = Counts[bool]()
            last: dict[str, float] = {}
            for _, name, values in rows:
                value = values[signal.name]
                if name in last:
                    steps[(value - last[name]) % modulo == 1] += 1
                last[name] = value
            if steps[True] > 9 * steps[False]:
                found["counter"] = {"signal": self._name(group, "counter", numbers), "modulo": modulo}
            else:
                why = "it does not rise by one in the log" if steps else "no log shows that it rises by one"
                self._note(f"tracks.counter: {signal.name} is not judged: {why}")
        return found

    # -- the cycle

    def _count(self, group: _Group) -> tuple[str, str] | None:
        """The message and signal that announce how many objects come."""
        for name in self._usable(self._codec):
            if name in group.names or (self._by_id and not self._seen(self._codec, name)):
                continue
            for signal in self._codec.signals(name):
                words = words_of(signal.name)
                if signal.whole and words & _MANY and words & _OBJECTS:
                    return name, signal.name
        return None

    def _cycle_end(self, group: _Group) -> str:
        """By the log the message before the longest gaps, of those that come in each cycle; else the last.

        Beside the tracks it may be a message with an id near theirs that comes as often: of a radar that
        sends its tracks in two halves, the first one is not the end.
        """
        ids = [self._codec.can_id(name) for name in group.names]
        near = range(min(ids) - NEAR_IDS, max(ids) + NEAR_IDS + 1)
        names = {self._codec.can_id(name): name for name in self._usable(self._codec)}
        most = max((len(self._by_id.get(can_id, ())) for can_id in ids), default=0)
        sent = {one: self._by_id[one] for one in names if one in near and one in self._by_id}
        often = {one: frames for one, frames in sent.items() if 9 * most <= 10 * len(frames) <= 11 * most}
        frames = sorted((frame for found in often.values() for frame in found), key=lambda frame: frame.t_us)
        gaps: dict[int, list[int]] = {}
        for before, after in pairwise(frames):
            gaps.setdefault(before.can_id, []).append(after.t_us - before.t_us)
        if not gaps:
            self._note(f"cycle_end: {group.names[-1]} is taken, as no log shows which message comes last")
            return group.names[-1]
        return names[max(gaps, key=lambda can_id: (median(gaps[can_id]), can_id))]

    def _cycle_ms(self, name: str) -> int:
        times = [frame.t_us for frame in self._seen(self._codec, name)]
        steps = [after - before for before, after in pairwise(times)]
        if steps:
            return min(1000, max(1, round(median(steps) / 1000)))
        try:
            return min(1000, max(1, self._codec.cycle_us(name) // 1000))
        except ConfigError:
            self._note(f"cycle_ms: {CYCLE_MS_GUESSED} is taken, as no log shows how often {name} comes")
            return CYCLE_MS_GUESSED

    # -- the ego

    def _ego(self, group: _Group) -> dict[str, object] | None:
        best: tuple[int, Codec, str, SignalPlace] | None = None
        for codec in self._codecs:
            for name in self._usable(codec):
                found = (
                    None
                    if codec is self._codec and name in group.names
                    else _best(codec.signals(name), _ego_speed)
                )
                if found is None or (self._by_id and not self._drives(codec, name, found[1])):
                    continue
                if best is None or found[0] > best[0]:
                    best = (found[0], codec, name, found[1])
        if best is None:
            where = "that is in the log" if self._by_id else "in the DBC"
            self._note(f"ego: no message {where} has the ego's speed; give its DBC with another --dbc")
            return None
        _, codec, name, signal = best
        unit = unit_of(signal.unit)
        assert unit is not None
        head: dict[str, object] = {"message": name, "length": codec.length(name)}
        speed: dict[str, object] = {"signal": signal.name, "unit": unit.name}
        if codec is not self._codec:
            head = {"can_id": _Hex(codec.can_id(name)), "length": codec.length(name)}
            order = "little_endian" if signal.little_endian else "big_endian"
            raw: dict[str, object] = {
                "start_bit": signal.start_bit, "length_bits": signal.length_bits, "byte_order": order,
                "signed": signal.signed, "scale": signal.scale, "offset": signal.offset,
            }  # fmt: skip
            speed = {"unit": unit.name, "raw": raw}
        return head | {"speed": speed}

    def _drives(self, codec: Codec, name: str, signal: SignalPlace) -> bool:
        """Whether the log has the signal, and all of its values are speeds of a car."""
        frames = [one for one in self._seen(codec, name) if len(one.data) == codec.length(name)]
        unit = unit_of(signal.unit)
        assert unit is not None
        speeds = [codec.decode(name, frame.data)[signal.name] * unit.si for frame in frames]
        return bool(speeds) and all(0 <= one <= SPEED_MAX_MS for one in speeds)


def _is_toyota(frame: Frame) -> bool:
    return len(frame.data) > 1 and toyota_checksum(frame.can_id, frame.data) == frame.data[-1]

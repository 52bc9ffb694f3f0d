"""Reading the words of a fault: its name, its subject, then keys with their values in any order.

    crash primary at checkpoint.sent nth 100
    NAME  SUBJECT KEY VALUE          KEY VALUE

Each kind of fault says which keys it takes (`FaultKind.KEYS`) and reads their values. What several kinds
share means the same in all of them, and is here:

*Bits*: which bits of some bytes a fault changes. What a pattern leaves open (which bit, which value) follows
from the *draw*, a number that the seed of the run gives to each fault. So pattern, bytes and draw determine
the bits, and a lasting fault hits the same place each time, as a broken cell does. A stuck bit has a value:
where the bit already has that value, nothing changes.

*Trigger*: at the nth occurrence of an event, some time after arming, or when the car is in a condition.

*Persistence*: what happens after the first strike.

    (none)                     once: a transient fault
    permanent                  at each occurrence from the first strike on
    intermittent every 7       at each 7th occurrence from the first strike on
    intermittent p 0.1         at each occurrence with that chance, by the seed of the run
    for 500ms                  at each occurrence for that long (bus and radar only)

The kind of fault says what an occurrence is: a frame on the bus, a message on a channel, a value in hand.
Only bus and radar count `for`, because only they have a time of their own.
"""

import math
import re
from collections.abc import Iterable, Sequence
from typing import Final, assert_never, cast

import msgspec

from aftbed.core.errors import ConfigError, unknown
from aftbed.core.events import event_named
from aftbed.core.units import duration, milliseconds, number
from aftbed.vehicle.condition import QUANTITIES, Condition, Quantity

NUMBER: Final = re.compile(r"-?[0-9]{1,9}(\.[0-9]{1,6})?")
PERMANENT, INTERMITTENT, BYTE = "permanent", "intermittent", "byte"
WHEN_KEYS: Final = ("at", "nth", "after", "when")
REPEAT_KEYS: Final = (PERMANENT, INTERMITTENT)
_VALUE_WORDS: Final = {INTERMITTENT: 2, "when": 3}  # of all other keys the value is one word
_TIME: Final = re.compile(r"[0-9.]+(us|ms|s)")
_UNITS: Final = ("us", "ms", "s")
_NUMBER: Final = re.compile(r"[0-9.]+")
_MEANT: Final = {  # keys by what others call them
    "@": "at",
    "on": "at",
    "in": "after",
    "p": INTERMITTENT,
    "every": INTERMITTENT,
    "chance": INTERMITTENT,
    "always": PERMANENT,
    "during": "for",
    "if": "when",
    "number": "nth",
}
_WHOLE: Final = re.compile(r"[0-9]{1,12}")


def count_of_values(key: str) -> int:
    """How many words stand behind `key` as its value; behind `byte` there may be none."""
    return 0 if key == PERMANENT else _VALUE_WORDS.get(key, 1)


class FaultWords:
    """The words of one fault: name, subject, keys with their values.

    Raises ConfigError where a key is unknown, double or without value.
    """

    def __init__(self, words: Sequence[str], keys: Sequence[str]) -> None:
        self.text = " ".join(words)
        self.name, self.subject, *rest = words
        if self.subject in keys:
            raise ConfigError(
                f"fault {self.text!r}: what it strikes is missing: {self.name} TARGET {self.subject} ..."
            )
        self._values: dict[str, str] = {}
        while rest:
            key = rest.pop(0)
            if key not in keys:
                raise self._stray(key, keys)
            if key in self._values:
                raise ConfigError(f"fault {self.text!r}: {key!r} twice")
            alone = key == BYTE and (not rest or rest[0].isalpha())
            count = 0 if alone else count_of_values(key)
            if len(rest) < count:
                raise ConfigError(f"fault {self.text!r}: {key!r} lacks its value")
            if key == "at" and _TIME.fullmatch(rest[0]):
                raise ConfigError(
                    f"fault {self.text!r}: 'at' is followed by an event, 'after {rest[0]}' by a time"
                )
            self._values[key] = " ".join(rest.pop(0) for _ in range(count))

    def _stray(self, word: str, keys: Sequence[str]) -> ConfigError:
        """`word` stands where a key is due."""
        for key, value in self._values.items():
            if word in _UNITS and _NUMBER.fullmatch(value):
                return ConfigError(f"fault {self.text!r}: a duration is one word: '{key} {value}{word}'")
        if self._values.get("at") == "request" and _WHOLE.fullmatch(word):
            meant = f"'at server.enter nth {word}', or another event"
            return ConfigError(f"fault {self.text!r}: 'at' is followed by an event: {meant}")
        return unknown(f"word in fault {self.text!r}:", word, keys, _MEANT)

    def __contains__(self, key: str) -> bool:
        return key in self._values

    def __getitem__(self, key: str) -> str:
        return self._values[key]

    def get(self, key: str, default: str = "") -> str:
        return self._values.get(key, default)

    def first_of(self, keys: Sequence[str]) -> str | None:
        return next((key for key in keys if key in self._values), None)

    def not_both(self, one: str, other: str) -> None:
        """Raise ConfigError where both keys are given."""
        if one in self and other in self:
            raise ConfigError(f"'{one} {self[one]}' and '{other} {self[other]}': one of them is allowed")

    def nth_needs_event(self) -> None:
        """Raise ConfigError where `nth` is given without the event that it counts."""
        if "nth" in self and "at" not in self:
            nth = self["nth"]
            raise ConfigError(f"'nth {nth}' counts an event: 'at EVENT nth {nth}' is allowed")


def whole(what: str, text: str, least: int, most: int | None = None) -> int:
    """A whole number in its limits. Raises ConfigError."""
    value = int(text) if _WHOLE.fullmatch(text) else least - 1
    if value < least or (most is not None and value > most):
        limits = f"from {least} on" if most is None else f"from {least} to {most}"
        raise ConfigError(f"{what} {text[:40]!r}: a whole number {limits} is allowed")
    return value


# -- which bits ----------------------------------------------------------------------------------


BIT_MAX: Final = 2**32 - 1  # the largest state has 2**29 bits
BITS_MAX: Final = 64  # at a time: each has its record
BYTE_BITS: Final = 8
WORD: Final = 2**64
PATTERN_KEYS: Final = ("bits", BYTE, "burst", "stuck", "bit")  # `bit` also says where a burst begins
_STUCK: Final = re.compile(r"([0-9]{1,12})=([01])")


class Bit(msgspec.Struct, frozen=True, tag="bit"):
    """Bit `at`, counted from bit 0 of byte 0, is inverted; None: it is drawn."""

    at: int | None = None

    def __str__(self) -> str:
        return "" if self.at is None else f"bit {self.at}"


class Bits(msgspec.Struct, frozen=True, tag="bits"):
    """`count` different bits, all drawn, are inverted."""

    count: int

    def __str__(self) -> str:
        return f"bits {self.count}"


class Byte(msgspec.Struct, frozen=True, tag="byte"):
    """Byte `at`, or a drawn one, gets another value, which is drawn."""

    at: int | None = None

    def __str__(self) -> str:
        return "byte" if self.at is None else f"byte {self.at}"


class BitBurst(msgspec.Struct, frozen=True, tag="burst"):
    """`count` neighbouring bits are inverted, from bit `at` on, or from a drawn one."""

    count: int
    at: int | None = None

    def __str__(self) -> str:
        return f"burst {self.count}" + ("" if self.at is None else f" bit {self.at}")


class StuckBit(msgspec.Struct, frozen=True, tag="stuck"):
    """Bit `at` has `value`, 0 or 1, whatever it should be."""

    at: int
    value: int

    def __str__(self) -> str:
        return f"stuck {self.at}={self.value}"


BitPattern = Bit | Bits | Byte | BitBurst | StuckBit


def read_pattern(words: FaultWords) -> BitPattern:
    """The pattern in `words`. Raises ConfigError where two patterns are mixed."""
    named = [key for key in PATTERN_KEYS if key in words]
    if len(named) > 1 and named != ["burst", "bit"]:
        one, other = (f"{key} {words[key]}".strip() for key in named[:2])
        raise ConfigError(f"{one!r} and {other!r}: one of them is allowed")
    at = whole("bit", words["bit"], 0, BIT_MAX) if "bit" in words else None
    if "bits" in words:
        return Bits(whole("bits", words["bits"], 1, BITS_MAX))
    if BYTE in words:
        return Byte(whole("byte", words[BYTE], 0, BIT_MAX // 8) if words[BYTE] else None)
    if "burst" in words:
        return BitBurst(whole("burst", words["burst"], 1, BITS_MAX), at)
    if "stuck" in words:
        stuck = _STUCK.fullmatch(words["stuck"])
        if stuck is None or int(stuck[1]) > BIT_MAX:
            raise ConfigError(f"stuck {words['stuck'][:40]!r}: a bit and its value are allowed, as 60=1")
        return StuckBit(int(stuck[1]), int(stuck[2]))
    return Bit(at)


def check_pattern(pattern: BitPattern) -> None:
    """Raise ConfigError where a number is out of its range: a pattern need not come from words."""
    match pattern:
        case Bit(at) | BitBurst(_, at) if at is not None and not 0 <= at <= BIT_MAX:
            raise ConfigError(f"bit {at}: 0 to {BIT_MAX} are allowed")
        case Byte(at) if at is not None and not 0 <= at <= BIT_MAX // 8:
            raise ConfigError(f"byte {at}: 0 to {BIT_MAX // 8} are allowed")
        case Bits(count) | BitBurst(count, _) if not 1 <= count <= BITS_MAX:
            raise ConfigError(f"{count} bits: 1 to {BITS_MAX} are allowed")
        case StuckBit(at, value) if not 0 <= at <= BIT_MAX or value not in (0, 1):
            raise ConfigError(f"stuck {at}={value}: a bit from 0 to {BIT_MAX}, and 0 or 1, are allowed")
        case _:
            return


def lacks_bits(pattern: BitPattern, size_bits: int) -> bool:
    """Whether data of so many bits has not all bits that the pattern names."""
    if isinstance(pattern, StuckBit):
        return pattern.at >= size_bits
    return bits_to_flip(pattern, bytes(size_bits // 8), 0) is None


def bits_to_flip(pattern: BitPattern, data: bytes, draw: int) -> tuple[int, ...] | None:
    """The bits of `data` that change, in ascending order; None if `data` has no such bits.

    `()` where a bit is stuck at the value that it has.
    """
    size = 8 * len(data)
    match pattern:
        case Bit(at):
            bits: Iterable[int] = (draw % max(1, size) if at is None else at,)
        case Bits(count):
            bits = _different(count, size, draw)
        case Byte(at):
            byte = draw % max(1, len(data)) if at is None else at
            change = 1 + drawn(draw, 0) % 255
            bits = [8 * byte + bit for bit in range(8) if change >> bit & 1]
        case BitBurst(count, at):
            first = draw % max(1, size - count + 1) if at is None else at
            bits = range(first, first + count)
        case StuckBit(at, value):
            if at < size and data[at // 8] >> at % 8 & 1 == value:
                return ()
            bits = (at,)
        case _:
            assert_never(pattern)
    found = tuple(sorted(bits))
    return found if found and found[-1] < size else None


def _different(count: int, size: int, draw: int) -> list[int]:
    """`count` different numbers below `size`; none if there are not so many."""
    if count > size:
        return []
    found: dict[int, None] = {}
    for index in range(WORD):
        if len(found) == count:
            break
        found[drawn(draw, index) % size] = None
    return list(found)


def with_flipped(data: bytes, bits: Iterable[int]) -> bytes:
    """`data` with these bits inverted; `data` has them."""
    out = bytearray(data)
    for bit in bits:
        assert 0 <= bit < 8 * len(data), f"bit {bit} of {len(data)} bytes"
        out[bit // 8] ^= 1 << bit % 8
    return bytes(out)


def bit_names(bits: Iterable[int]) -> str:
    """`bit 3`, or `bits 3, 17`."""
    found = list(bits)
    return f"bit{'s' * (len(found) > 1)} {', '.join(map(str, found))}"


def drawn(draw: int, index: int) -> int:
    """Number `index` of the sequence that `draw` begins: 64 bits (SplitMix64; Steele, Lea, Flood 2014)."""
    mixed = (draw + (index + 1) * 0x9E3779B97F4A7C15) % WORD
    mixed = (mixed ^ mixed >> 30) * 0xBF58476D1CE4E5B9 % WORD
    mixed = (mixed ^ mixed >> 27) * 0x94D049BB133111EB % WORD
    return mixed ^ mixed >> 31


# -- when, and how often again ---------------------------------------------------------------------


EVERY, CHANCE, FOR = "every", "p", "for"
COUNT_MAX: Final = 10**12 - 1
_CHANCE: Final = re.compile(r"[01](\.[0-9]{1,6})?")


class Trigger(msgspec.Struct, frozen=True):
    """The `nth` occurrence of the event with label `event`, or `after_ms` milliseconds after arming.

    A channel fault waits for no event: it strikes the `nth` message. `when` delays the arming until the first
    step of the car at which the condition holds.
    """

    event: str = ""
    nth: int = 1
    after_ms: float = 0.0
    when: Condition | None = None

    def __post_init__(self) -> None:
        if self.after_ms and self.when is not None:
            raise ValueError("a fault that strikes after a time and on a condition")

    def words(self, *, counts_messages: bool) -> list[str]:
        """As `read_trigger` reads it; without an event, `nth` is written only where it counts messages."""
        when = "" if self.when is None else f"when {self.when}"
        if self.event:
            return [f"at {self.event} nth {self.nth}", when]
        if self.after_ms:
            return [f"after {duration(self.after_ms)}"]
        return [f"nth {self.nth}" if counts_messages else "", when]


def read_trigger(words: FaultWords, default_event: str = "") -> Trigger:
    """The trigger in `words`. Raises ConfigError. `nth` alone counts `default_event`."""
    words.not_both("at", "after")
    words.not_both("after", "when")
    nth = whole("nth", words["nth"], 1) if "nth" in words else 1
    event = words.get("at", default_event if "nth" in words else "")
    if event:
        event_named(event)
    after_ms = milliseconds("duration", words["after"]) if "after" in words else 0.0
    return Trigger(event, nth, after_ms, condition(*words["when"].split(" ")) if "when" in words else None)


def condition(quantity: str, relation: str, value: str) -> Condition:
    """The condition behind `when`: `ttc < 1.2`. Raises ConfigError."""
    if quantity not in QUANTITIES:
        raise unknown("quantity of the car", quantity[:40], QUANTITIES)
    if relation not in ("<", ">"):
        raise ConfigError(f"found {relation[:40]!r} where '<' or '>' is expected")
    if not NUMBER.fullmatch(value):
        raise ConfigError(
            f"{quantity} {relation} {value[:40]!r}: a number is allowed (ttc in s, gap in m, speed in m/s)"
        )
    return Condition(cast("Quantity", quantity), relation == "<", float(value))


class Transient(msgspec.Struct, frozen=True, tag="transient"):
    """Strike once."""

    def __str__(self) -> str:
        return ""


class Permanent(msgspec.Struct, frozen=True, tag="permanent"):
    """Strike every occurrence from the first strike on."""

    def __str__(self) -> str:
        return PERMANENT


class Every(msgspec.Struct, frozen=True, tag="every"):
    """Strike every `count`th occurrence from the first strike on."""

    count: int

    def __str__(self) -> str:
        return f"{INTERMITTENT} {EVERY} {self.count}"


class Chance(msgspec.Struct, frozen=True, tag="chance"):
    """Strike each occurrence with chance `p`, drawn from the seed of the run."""

    p: float

    def __str__(self) -> str:
        return f"{INTERMITTENT} {CHANCE} {number(self.p)}"


class Lasting(msgspec.Struct, frozen=True, tag="lasting"):
    """Strike every occurrence for that long, counted from the first strike."""

    for_us: int

    def __str__(self) -> str:
        return f"{FOR} {duration(self.for_us / 1000)}"


Persistence = Transient | Permanent | Every | Chance  # counted in occurrences
ONCE: Final = Transient()


def read_persistence(words: FaultWords) -> Persistence:
    """The persistence in `words`. Raises ConfigError."""
    if PERMANENT in words and INTERMITTENT in words:
        raise ConfigError(f"{PERMANENT!r} and '{INTERMITTENT} {words[INTERMITTENT]}': one of them is allowed")
    if PERMANENT in words:
        return Permanent()
    return intermittent(*words[INTERMITTENT].split(" ", 1)) if INTERMITTENT in words else ONCE


def intermittent(word: str, text: str) -> Every | Chance:
    """What stands behind `intermittent`: `every N`, or `p CHANCE`. Raises ConfigError."""
    if word == EVERY:
        return Every(whole(EVERY, text, 1, COUNT_MAX))
    if word != CHANCE:
        raise unknown(f"word behind {INTERMITTENT!r}:", word[:40], (EVERY, CHANCE))
    p = float(text) if _CHANCE.fullmatch(text) else 0.0
    if not 0 < p <= 1:
        raise ConfigError(f"p {text[:40]!r}: a chance above 0 and up to 1 is allowed, as 0.1")
    return Chance(p)


def gap(persistence: Persistence, draw: int, strikes: int) -> int:
    """How many occurrences after strike number `strikes` the next one is; 0: there is no next one."""
    match persistence:
        case Transient():
            return 0
        case Permanent():
            return 1
        case Every(count):
            return count
        case Chance(p):
            return _next_success(p, draw, strikes)
        case _:
            assert_never(persistence)


def _next_success(p: float, draw: int, index: int) -> int:
    """How many trials of chance `p` it takes until the next success: 1 at least (geometric distribution)."""
    if p >= 1.0:
        return 1
    uniform = (drawn(draw, index) + 0.5) / WORD
    return 1 + math.floor(math.log(uniform) / math.log1p(-p))

"""The words of a fault, the same on `run --inject "..."` and on `aftbed inject ...`.

crash   TARGET                                  [at EVENT [nth N] | after 200ms]
hang    TARGET [for 50ms]                       [at EVENT [nth N] | after 200ms]
slow    TARGET [by 2ms | share 25%] [for 500ms] [at EVENT [nth N] | after 200ms]
omission|duplicate CHANNEL           [in REPLICA] [nth N | after 200ms] [AGAIN]
delay|reorder      CHANNEL [by 20ms] [in REPLICA] [nth N | after 200ms] [AGAIN]
bitflip PLACE [BITS] [in REPLICA] [at EVENT] [nth N] | [after 200ms] [AGAIN]
bitflip state.FIELD [BITS] [in REPLICA] [at EVENT] [nth N] | [after 200ms]
bitflip memory [bit K] [address 0x...] [in TARGET] [at EVENT [nth N] | after 200ms]
                                                [when ttc|gap|speed <|> VALUE], with each, but for `after`

BITS  = bit K | bits N | byte [K] | burst N [bit K] | stuck K=0|1
AGAIN = permanent | intermittent every N | intermittent p 0.1

A bitflip strikes where its value is in hand: without a word about when, at the next such event. That of a
field strikes memory, which is there at any time: without a word about when, at once.

Faults of the bus have words of their own: see `buswords`.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Final

from aftbed.core.errors import ConfigError, unknown
from aftbed.core.events import event_named
from aftbed.core.fault import (
    BYTE_BITS,
    DISTURBED_MS,
    HANG_FOREVER_MS,
    LATER,
    MEMORY,
    SHARE_MAX,
    SHARE_MIN,
    SLOW_MS,
    SLOW_MS_MAX,
    Crash,
    Disturb,
    Fault,
    FlipMemory,
    Hang,
    How,
    Slow,
    Trigger,
    on_bus,
)
from aftbed.core.persistence import INTERMITTENT, ONCE, PERMANENT, Permanent, Persistence
from aftbed.core.units import milliseconds, whole_milliseconds
from aftbed.core.valuefault import (
    BIT_MAX,
    BITFLIP,
    BITS_MAX,
    FLIPPED_AT,
    Bit,
    Bits,
    Burst,
    Byte,
    Flip,
    Pattern,
    Place,
    Stuck,
)
from aftbed.inject import buswords
from aftbed.inject.parts import condition, intermittent, whole

GRAMMAR: Final = (
    "crash|hang|slow TARGET [by 2ms | share 25%] [for 50ms] [at EVENT [nth N] | after 200ms],"
    " omission|delay|duplicate|reorder CHANNEL [by 20ms] [in primary|backup|a|b] [nth N | after 200ms],"
    " or bitflip PLACE|state.FIELD|memory [bit K] [in primary|backup|a|b] [at EVENT] [nth N] | [after 200ms],"
    " each with [when ttc < 1.2] in place of after"
)
ANYBODY: Final = "primary"  # where no replica is named
_BYTE: Final = "byte"
_STUCK: Final = re.compile(r"([0-9]{1,12})=([01])")
_SHARE: Final = re.compile(r"([0-9]{1,3}(?:\.[0-9]{1,3})?)%")
_ADDRESS: Final = re.compile(r"0x[0-9a-fA-F]{1,12}")
_FIELD: Final = re.compile(r"[A-Za-z0-9_]+(\.[A-Za-z0-9_]+)*")
FIELD_CHARACTERS_MAX: Final = 60
_WHEN: Final = ("at", "nth", "after", "when")
_AGAIN: Final = (PERMANENT, INTERMITTENT)
_PATTERNS: Final = ("bits", _BYTE, "burst", "stuck", "bit")  # `bit` says where a burst begins, too
_CHANNEL: Final = {how.value: how for how in How}
_KEYS: Final[dict[str, tuple[str, ...]]] = {
    "crash": ("for", *_WHEN),
    "hang": ("for", *_WHEN),
    "slow": ("by", "share", "for", *_WHEN),
    BITFLIP: (*_PATTERNS, "address", "in", *_WHEN, *_AGAIN),
    **dict.fromkeys(_CHANNEL, ("by", "in", "nth", "after", "when", *_AGAIN)),
}
_VALUES: Final = {INTERMITTENT: 2, "when": 3}  # words; of all others one
KINDS: Final = tuple(_KEYS)
Found = Mapping[str, str]


def parse(text: str) -> Fault:
    """The fault that `text` means. Raises ConfigError naming the word that is wrong."""
    return read(text.split())


def read(words: Sequence[str]) -> Fault:
    """The same, of words that were told apart already."""
    text = " ".join(words)
    if buswords.speaks_of_the_bus(words):
        return on_bus(buswords.parse(text))
    if len(words) < 2:
        raise ConfigError(f"fault {text!r}: expected {GRAMMAR}")
    kind, what, *rest = words
    if kind not in _KEYS:
        raise unknown("fault", kind, {*_KEYS, *buswords.VERBS})
    found = _told(text, rest, _KEYS[kind])
    if kind == BITFLIP:
        return _flip_memory(found) if what == MEMORY else _flip(what, found)
    if kind in _CHANNEL:
        return _disturb(_CHANNEL[kind], what, found)
    return _of_a_process(kind, what, found)


def _told(text: str, words: list[str], keys: tuple[str, ...]) -> dict[str, str]:
    """The rest of a fault: words that say what the word behind them is, if one has to be."""
    rest, found = list(words), dict[str, str]()
    while rest:
        key = rest.pop(0)
        if key not in keys:
            raise unknown(f"word in fault {text!r}:", key, keys)
        if key in found:
            raise ConfigError(f"fault {text!r}: {key!r} twice")
        found[key] = _value(text, key, rest)
    return found


def _value(text: str, key: str, rest: list[str]) -> str:
    """What belongs to `key`, taken from `rest`."""
    if key == PERMANENT or (key == _BYTE and not (rest and _is_value(rest[0]))):
        return ""
    wanted = _VALUES.get(key, 1)
    if len(rest) < wanted:
        raise ConfigError(f"fault {text!r}: {key!r} lacks its value")
    taken = [rest.pop(0) for _ in range(wanted)]
    return " ".join(taken)


def _is_value(word: str) -> bool:
    return not word.isalpha()


# -- the three families --------------------------------------------------------------------------


def _of_a_process(kind: str, target: str, found: Found) -> Fault:
    """A crash, a hang, or a slow one."""
    duration, nth = found.get("for"), found.get("nth")
    if duration is not None and kind == "crash":
        raise ConfigError(f"'for {duration}': a crash has no duration; a hang and a slow have")
    if nth is not None and "at" not in found:
        raise ConfigError(f"'nth {nth}' counts an event: 'at EVENT nth {nth}' is allowed")
    trigger = _trigger(found)
    for_ms = whole_milliseconds("duration", duration) if duration is not None else HANG_FOREVER_MS
    if kind == "crash":
        return Fault(Crash(), target, trigger)
    if kind == "hang":
        return Fault(Hang(for_ms), target, trigger)
    return Fault(_slow(for_ms, found), target, trigger)


def _slow(for_ms: int, found: Found) -> Slow:
    _not_both(found, "by", "share")
    if "share" in found:
        return Slow(0.0, for_ms, _share(found["share"]))
    by_ms = milliseconds("delay", found["by"]) if "by" in found else SLOW_MS
    if by_ms > SLOW_MS_MAX:
        raise ConfigError(f"'by {found['by']}': a step can be slower by {SLOW_MS_MAX:g}ms at most")
    return Slow(by_ms, for_ms)


def _disturb(how: How, channel: str, found: Found) -> Fault:
    if "by" in found and how not in LATER:
        later = " and a ".join(h.value for h in LATER)
        raise ConfigError(f"'by {found['by']}': {how.value} holds nothing back; a {later} does")
    _not_both(found, "nth", "after")
    by_ms = milliseconds("delay", found["by"]) if "by" in found else DISTURBED_MS
    action = Disturb(how, channel, by_ms)
    return Fault(action, found.get("in", ANYBODY), _trigger(found), _persistence(found))


def _flip_memory(found: Found) -> Fault:
    """As it is said of a process, since it strikes one."""
    other = next((word for word in (*_PATTERNS, *_AGAIN) if word in found and word != "bit"), None)
    if other is not None:
        raise ConfigError(f"{other!r}: of memory one bit is flipped, once: 'bit 0' to 'bit 7' of a byte")
    if "nth" in found and "at" not in found:
        raise ConfigError(f"'nth {found['nth']}' counts an event: 'at EVENT nth {found['nth']}' is allowed")
    bit = whole("bit", found["bit"], 0, BYTE_BITS - 1) if "bit" in found else None
    address = _address(found["address"]) if "address" in found else None
    return Fault(FlipMemory(bit, address), found.get("in", ANYBODY), _trigger(found))


def _flip(what: str, found: Found) -> Fault:
    place, dot, field = what.partition(".")
    places = [p.value for p in Place]
    if place not in places:
        raise unknown("place of a bitflip", place, (*places, MEMORY))
    if "address" in found:
        raise ConfigError(f"'address {found['address'][:40]}': only memory has addresses: 'bitflip {MEMORY}'")
    if dot:
        _check_field(place, field, found)
    flip = Flip(Place(place), _pattern(found), field)
    _not_both(found, "nth", "after")
    if "nth" in found and "at" not in found:
        found = {**found, "at": FLIPPED_AT[flip.place][0].label}
    return Fault(flip, found.get("in", ANYBODY), _trigger(found), _persistence(found))


def _check_field(place: str, field: str, found: Found) -> None:
    """Raise ConfigError unless `place.field` can be one, and what is said of it too."""
    if place != Place.STATE.value:
        raise ConfigError(f"{place + '.' + field[:40]!r}: only the state has fields, as state.ego_ms")
    if not _FIELD.fullmatch(field) or len(field) > FIELD_CHARACTERS_MAX:
        named = f"letters, digits, _ and . are allowed, {FIELD_CHARACTERS_MAX} at most"
        raise ConfigError(f"field {field[:40]!r} of the state: {named}")
    lasting = next((word for word in _AGAIN if word in found), None)
    if lasting is not None:
        raise ConfigError(f"{lasting!r}: a bitflip of a field strikes once; that of a whole state can last")


# -- parts ----------------------------------------------------------------------------------------


def _pattern(found: Found) -> Pattern:
    """Which bits. Raises ConfigError where two ways of saying it are mixed."""
    named = [key for key in _PATTERNS if key in found]
    if len(named) > 1 and named != ["burst", "bit"]:
        one, other = (f"{key} {found[key]}".strip() for key in named[:2])
        raise ConfigError(f"{one!r} and {other!r}: one of them is allowed")
    at = whole("bit", found["bit"], 0, BIT_MAX) if "bit" in found else None
    if "bits" in found:
        return Bits(whole("bits", found["bits"], 1, BITS_MAX))
    if _BYTE in found:
        return Byte(whole("byte", found[_BYTE], 0, BIT_MAX // 8) if found[_BYTE] else None)
    if "burst" in found:
        return Burst(whole("burst", found["burst"], 1, BITS_MAX), at)
    if "stuck" in found:
        stuck = _STUCK.fullmatch(found["stuck"])
        if stuck is None or int(stuck[1]) > BIT_MAX:
            raise ConfigError(f"stuck {found['stuck'][:40]!r}: a bit and its value are allowed, as 60=1")
        return Stuck(int(stuck[1]), int(stuck[2]))
    return Bit(at)


def _persistence(found: Found) -> Persistence:
    if PERMANENT in found and INTERMITTENT in found:
        raise ConfigError(f"{PERMANENT!r} and '{INTERMITTENT} {found[INTERMITTENT]}': one of them is allowed")
    if PERMANENT in found:
        return Permanent()
    if INTERMITTENT not in found:
        return ONCE
    return intermittent(*found[INTERMITTENT].split(" ", 1))


def _trigger(found: Found) -> Trigger:
    event, after = found.get("at"), found.get("after")
    _not_both(found, "at", "after")
    _not_both(found, "after", "when")
    nth = whole("nth", found["nth"], 1) if "nth" in found else 1
    if event is not None:
        event_named(event)
    after_ms = milliseconds("duration", after) if after is not None else 0.0
    return Trigger(
        event or "", nth, after_ms, condition(*found["when"].split(" ")) if "when" in found else None
    )


def _share(text: str) -> float:
    """Of a CPU, as `25%`. Raises ConfigError."""
    found = _SHARE.fullmatch(text)
    share = float(found[1]) / 100 if found else 0.0
    if not SHARE_MIN <= share <= SHARE_MAX:
        limits = f"{100 * SHARE_MIN:g}% to {100 * SHARE_MAX:g}% of a CPU are allowed, as 25%"
        raise ConfigError(f"share {text[:40]!r}: {limits}")
    return share


def _address(text: str) -> int:
    if not _ADDRESS.fullmatch(text):
        raise ConfigError(f"address {text[:40]!r}: a hexadecimal number is allowed, as 0x7f0012345678")
    return int(text, 16)


def _not_both(found: Found, one: str, other: str) -> None:
    if one in found and other in found:
        raise ConfigError(f"'{one} {found[one]}' and '{other} {found[other]}': one of them is allowed")

"""The words of a fault, the same on `run --inject "..."` and on `aftbed inject ...`.

crash   TARGET [at EVENT [nth N] | after 200ms]
hang    TARGET [for 50ms] [at EVENT [nth N] | after 200ms]
bitflip result|state [bit K] [in primary|backup|a|b] [at EVENT] [nth N] | [after 200ms]

A bitflip strikes at an execution: without a word about when, at the next one (`at server.exit`).
"""

import re
from typing import Final

from aftbed.core.errors import ConfigError, unknown
from aftbed.core.event import Event, event_named
from aftbed.core.fault import BIT_MAX, HANG_FOREVER_MS, Act, Fault, Flip, Place, Trigger
from aftbed.core.words import milliseconds, whole_milliseconds

GRAMMAR: Final = (
    "crash|hang TARGET [for 50ms] [at EVENT [nth N] | after 200ms],"
    " or bitflip result|state [bit K] [in primary|backup|a|b] [at EVENT] [nth N] | [after 200ms]"
)
TARGET_OF_A_FLIP: Final = "primary"
_WHOLE: Final = re.compile(r"[0-9]{1,12}")
_WHEN: Final = ("at", "nth", "after")
_KEYS: Final = {Act.CRASH: ("for", *_WHEN), Act.HANG: ("for", *_WHEN), Act.BITFLIP: ("bit", "in", *_WHEN)}


def parse(text: str) -> Fault:
    """The fault that `text` means. Raises ConfigError naming the word that is wrong."""
    words = text.split()
    if len(words) < 2:
        raise ConfigError(f"fault {text!r}: expected {GRAMMAR}")
    if words[0] not in {act.value for act in Act}:
        raise unknown("fault", words[0], [act.value for act in Act])
    act = Act(words[0])
    found = _pairs(text, words[2:], _KEYS[act])
    when = (found.get("at"), found.get("nth"), found.get("after"))
    if act is Act.BITFLIP:
        return build_flip(words[1], found.get("bit"), found.get("in"), *when)
    return build(act, words[1], found.get("for"), *when)


def _pairs(text: str, words: list[str], keys: tuple[str, ...]) -> dict[str, str]:
    """The rest of a fault: words that say what the word behind them is."""
    rest, found = list(words), dict[str, str]()
    while rest:
        key = rest.pop(0)
        if key not in keys:
            raise unknown(f"word in fault {text!r}:", key, keys)
        if key in found or not rest:
            raise ConfigError(f"fault {text!r}: {key!r} {'twice' if key in found else 'lacks its value'}")
        found[key] = rest.pop(0)
    return found


def build(
    act: Act, target: str, duration: str | None, event: str | None, nth: str | None, after: str | None
) -> Fault:
    """A crash or a hang out of its parts. Raises ConfigError where they contradict each other."""
    if duration is not None and act is not Act.HANG:
        raise ConfigError(f"'for {duration}': a {act.value} has no duration; only a hang has")
    if nth is not None and event is None:
        raise ConfigError(f"'nth {nth}' counts an event: 'at EVENT nth {nth}' is allowed")
    trigger = _trigger(event, nth, after)
    hang_ms = whole_milliseconds("duration", duration) if duration else HANG_FOREVER_MS
    return Fault(act, target, trigger, hang_ms)


def build_flip(
    place: str, bit: str | None, replica: str | None, event: str | None, nth: str | None, after: str | None
) -> Fault:
    """A bitflip out of its parts. Raises ConfigError where they contradict each other."""
    places = [p.value for p in Place]
    if place not in places:
        raise unknown("place of a bitflip", place, places)
    if bit is not None and not (_WHOLE.fullmatch(bit) and int(bit) <= BIT_MAX):
        raise ConfigError(f"bit {bit[:40]!r}: a whole number from 0 to {BIT_MAX} is allowed")
    if nth is not None and after is not None:
        raise ConfigError(f"'nth {nth}' and 'after {after}': one of them is allowed")
    if nth is not None and event is None:
        event = Event.SERVER_EXIT.label
    trigger = _trigger(event, nth, after)
    flip = Flip(Place(place), None if bit is None else int(bit))
    return Fault(Act.BITFLIP, replica or TARGET_OF_A_FLIP, trigger, flip=flip)


def _trigger(event: str | None, nth: str | None, after: str | None) -> Trigger:
    if event is not None and after is not None:
        raise ConfigError(f"'at {event}' and 'after {after}': one of them is allowed")
    if nth is not None and not (_WHOLE.fullmatch(nth) and int(nth) >= 1):
        raise ConfigError(f"nth {nth[:40]!r}: a whole number from 1 on is allowed")
    if event is not None:
        event_named(event)
    return Trigger(event or "", int(nth or 1), milliseconds("duration", after) if after else 0.0)

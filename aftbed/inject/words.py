"""The words of a fault, the same on `run --inject "..."` and on `aftbed inject ...`.

crash TARGET [at EVENT [nth N] | after 200ms]
hang  TARGET [for 50ms] [at EVENT [nth N] | after 200ms]
"""

import re
from typing import Final

from aftbed.core.errors import ConfigError, unknown
from aftbed.core.event import event_named
from aftbed.core.fault import HANG_FOREVER_MS, Act, Fault, Trigger

GRAMMAR: Final = "crash|hang TARGET [for 50ms] [at EVENT [nth N] | after 200ms]"
DURATION_MS_MAX: Final = 3_600_000
_NUMBER: Final = re.compile(r"[0-9]{1,10}(\.[0-9]{1,6})?")
_WHOLE: Final = re.compile(r"[0-9]{1,12}")
_KEYS: Final = ("for", "at", "nth", "after")


def milliseconds(text: str) -> int:
    """`50ms` or `2s` as whole milliseconds. Raises ConfigError."""
    for unit, factor in (("ms", 1), ("s", 1000)):
        number = text.removesuffix(unit)
        if number != text and _NUMBER.fullmatch(number):
            value = round(float(number) * factor)
            if 0 < value <= DURATION_MS_MAX:
                return value
    raise ConfigError(f"duration {text[:40]!r}: a positive number with its unit is allowed, as 50ms or 2s")


def parse(text: str) -> Fault:
    """The fault that `text` means. Raises ConfigError naming the word that is wrong."""
    words = text.split()
    if len(words) < 2:
        raise ConfigError(f"fault {text!r}: expected {GRAMMAR}")
    if words[0] not in {act.value for act in Act}:
        raise unknown("fault", words[0], [act.value for act in Act])
    rest, found = words[2:], dict[str, str]()
    while rest:
        key = rest.pop(0)
        if key not in _KEYS:
            raise unknown(f"word in fault {text!r}:", key, _KEYS)
        if key in found or not rest:
            raise ConfigError(f"fault {text!r}: {key!r} {'twice' if key in found else 'lacks its value'}")
        found[key] = rest.pop(0)
    return build(
        Act(words[0]), words[1], found.get("for"), found.get("at"), found.get("nth"), found.get("after")
    )


def build(
    act: Act,
    target: str,
    duration: str | None,
    event: str | None,
    nth: str | None,
    after: str | None,
) -> Fault:
    """A fault out of its parts. Raises ConfigError where they contradict each other."""
    if duration is not None and act is not Act.HANG:
        raise ConfigError(f"'for {duration}': a {act.value} has no duration; only a hang has")
    if event is not None and after is not None:
        raise ConfigError(f"'at {event}' and 'after {after}': one of them is allowed")
    if nth is not None and event is None:
        raise ConfigError(f"'nth {nth}' counts an event: 'at EVENT nth {nth}' is allowed")
    if nth is not None and not (_WHOLE.fullmatch(nth) and int(nth) >= 1):
        raise ConfigError(f"nth {nth[:40]!r}: a whole number from 1 on is allowed")
    if event is not None:
        event_named(event)
    trigger = Trigger(event or "", int(nth or 1), milliseconds(after) if after else 0)
    return Fault(act, target, trigger, milliseconds(duration) if duration else HANG_FOREVER_MS)

"""When a fault strikes, and how often it strikes again. The words are the same for all kinds.

*Trigger*: at the nth occurrence of an event, some time after arming, or when the car is in a condition.

*Persistence*: what happens after the first strike.

    (none)                     once: a transient fault
    permanent                  at each occurrence from the first strike on
    intermittent every 7       at each 7th occurrence from the first strike on
    intermittent p 0.1         at each occurrence with that chance, by the seed of the run
    for 500ms                  at each occurrence for that long, counted from the first strike (bus only)

The kind of fault says what an occurrence is: a frame on the bus, a message on a channel, a value in hand.
Only the bus counts `for`, because only the bus has a time of its own.
"""

import math
import re
from typing import Final, assert_never, cast

import msgspec

from aftbed.core.errors import ConfigError, unknown
from aftbed.core.events import event_named
from aftbed.core.units import duration, milliseconds, number
from aftbed.inject.bit_patterns import WORD, drawn
from aftbed.inject.grammar import INTERMITTENT, NUMBER, PERMANENT, FaultWords, whole
from aftbed.vehicle.condition import QUANTITIES, Condition, Quantity

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


# -- persistence ----------------------------------------------------------------------------------


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

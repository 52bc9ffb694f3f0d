"""For how long a fault lasts: whether, and when, it strikes again. The same words for all that is struck.

    (none)                     once: a transient fault
    permanent                  at each occurrence from the first strike on
    intermittent every 7       at each 7th occurrence from the first strike on
    intermittent p 0.1         at each occurrence with that chance, by the seed of the run
    for 500ms                  at each occurrence for that long, counted from the first strike

What an occurrence is, the fault says: a frame on the bus, a message of a channel, a value in hand. The last
form counts bus time, which nothing but a bus has.
"""

from typing import Final, assert_never

import msgspec

from aftbed.core.units import duration, number
from aftbed.core.valuefault import next_success

PERMANENT, INTERMITTENT, EVERY, CHANCE, FOR = "permanent", "intermittent", "every", "p", "for"


class Transient(msgspec.Struct, frozen=True, tag="transient"):
    """It strikes once."""

    def __str__(self) -> str:
        return ""


class Permanent(msgspec.Struct, frozen=True, tag="permanent"):
    """Every occurrence from the first strike on."""

    def __str__(self) -> str:
        return PERMANENT


class Every(msgspec.Struct, frozen=True, tag="every"):
    """Every `count`th occurrence from the first strike on."""

    count: int

    def __str__(self) -> str:
        return f"{INTERMITTENT} {EVERY} {self.count}"


class Chance(msgspec.Struct, frozen=True, tag="chance"):
    """Each occurrence with chance `p`, by the seed of the run."""

    p: float

    def __str__(self) -> str:
        return f"{INTERMITTENT} {CHANCE} {number(self.p)}"


class Lasting(msgspec.Struct, frozen=True, tag="lasting"):
    """Every occurrence for that long, counted from the first."""

    for_us: int

    def __str__(self) -> str:
        return f"{FOR} {duration(self.for_us / 1000)}"


Persistence = Transient | Permanent | Every | Chance  # counted in occurrences
ONCE: Final = Transient()


def gap(persistence: Persistence, draw: int, struck: int) -> int:
    """How many occurrences on from strike number `struck` the next one is; 0 if there is none."""
    match persistence:
        case Transient():
            return 0
        case Permanent():
            return 1
        case Every(count):
            return count
        case Chance(p):
            return next_success(p, draw, struck)
        case _:
            assert_never(persistence)

"""Value faults: which bits of what a brick makes, hands out or remembers come to be wrong.

A pattern says it of any number of bytes; what it leaves open (which bit, which value) hangs on the *draw*, a
number that the seed of the run gives to each fault. So a pattern, the bytes and the draw tell the bits, and a
fault that lasts hits the same place each time, as a broken cell does.

A bit that is stuck has a value and not a change: where it has that value already, nothing comes of it.
"""

import math
from collections.abc import Iterable
from enum import Enum
from typing import Final, assert_never

import msgspec

from aftbed.core.events import Event

BIT_MAX: Final = 2**32 - 1  # the largest state has 2**29 bits
BITS_MAX: Final = 64  # at a time: each has its record
_WORD: Final = 2**64


class Place(Enum):
    """What is hit."""

    RESULT = "result"  # what one execution answers
    STATE = "state"  # what the function remembers
    REQUEST = "request"  # what the Server is handed
    CHECKPOINT = "checkpoint"  # the state, and behind it the reply, on their way to the backup
    LOG = "log"  # the reply that a Protocol keeps, to answer with once more


EXECUTED: Final = (Place.RESULT, Place.STATE)  # what one execution leaves behind: what TR compares
FLIPPED_AT: Final = {  # where somebody has it in hand; the first is meant if none is named
    Place.RESULT: (Event.SERVER_EXIT,),
    Place.STATE: (Event.SERVER_EXIT, Event.STATE_CAPTURED, Event.STATE_RESTORED),
    Place.REQUEST: (Event.SERVER_ENTER,),
    Place.CHECKPOINT: (Event.CHECKPOINT_SENT,),
    Place.LOG: (Event.REPLY_STORED, Event.DEDUPE_HIT, Event.CHECKPOINT_APPLIED),
}


class Bit(msgspec.Struct, frozen=True, tag="bit"):
    """Bit `at`, counted from bit 0 of byte 0, is the other way round; without one it is drawn."""

    at: int | None = None

    def __str__(self) -> str:
        return "" if self.at is None else f"bit {self.at}"


class Bits(msgspec.Struct, frozen=True, tag="bits"):
    """`count` different bits, all drawn."""

    count: int

    def __str__(self) -> str:
        return f"bits {self.count}"


class Byte(msgspec.Struct, frozen=True, tag="byte"):
    """Byte `at`, or a drawn one, has another value, which is drawn."""

    at: int | None = None

    def __str__(self) -> str:
        return "byte" if self.at is None else f"byte {self.at}"


class Burst(msgspec.Struct, frozen=True, tag="burst"):
    """`count` bits side by side, the first of them `at`, or drawn."""

    count: int
    at: int | None = None

    def __str__(self) -> str:
        return f"burst {self.count}" + ("" if self.at is None else f" bit {self.at}")


class Stuck(msgspec.Struct, frozen=True, tag="stuck"):
    """Bit `at` has `value`, 0 or 1, whatever it should be."""

    at: int
    value: int

    def __str__(self) -> str:
        return f"stuck {self.at}={self.value}"


Pattern = Bit | Bits | Byte | Burst | Stuck


BITFLIP: Final = "bitflip"


class Flip(msgspec.Struct, frozen=True, tag=BITFLIP):
    """Where, and which bits. Those of a `field` of the state are flipped in memory, at any moment."""

    place: Place
    pattern: Pattern = Bit()
    field: str = ""

    @property
    def where(self) -> str:
        """In words."""
        return f"{self.place.value}.{self.field}" if self.field else self.place.value


def hit(pattern: Pattern, data: bytes, draw: int) -> tuple[int, ...] | None:
    """The bits of `data` that change, in their order; None if there are no such bits in it.

    None of them, `()`, where a bit is stuck at what it is.
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
        case Burst(count, at):
            first = draw % max(1, size - count + 1) if at is None else at
            bits = range(first, first + count)
        case Stuck(at, value):
            if at < size and data[at // 8] >> at % 8 & 1 == value:
                return ()
            bits = (at,)
        case _:
            assert_never(pattern)
    found = tuple(sorted(bits))
    return found if found and found[-1] < size else None


def _different(count: int, size: int, draw: int) -> list[int]:
    """`count` numbers below `size`, no two the same; none if there are not so many."""
    if count > size:
        return []
    found: dict[int, None] = {}
    for index in range(_WORD):
        if len(found) == count:
            break
        found[drawn(draw, index) % size] = None
    return list(found)


def changed(data: bytes, bits: Iterable[int]) -> bytes:
    """`data` with these bits the other way round; there are such bits in it."""
    for bit in bits:
        data = flipped(data, bit)
    return data


def flipped(data: bytes, bit: int) -> bytes:
    """`data` with this bit the other way round; there is such a bit in it."""
    assert 0 <= bit < 8 * len(data), f"bit {bit} of {len(data)} bytes"
    out = bytearray(data)
    out[bit // 8] ^= 1 << bit % 8
    return bytes(out)


def drawn(draw: int, index: int) -> int:
    """Number `index` of the sequence that `draw` begins: 64 bits (SplitMix64; Steele, Lea, Flood 2014)."""
    mixed = (draw + (index + 1) * 0x9E3779B97F4A7C15) % _WORD
    mixed = (mixed ^ mixed >> 30) * 0xBF58476D1CE4E5B9 % _WORD
    mixed = (mixed ^ mixed >> 27) * 0x94D049BB133111EB % _WORD
    return mixed ^ mixed >> 31


def next_success(p: float, draw: int, index: int) -> int:
    """At which trial of chance `p` the next success comes: 1 at least, drawn (geometric)."""
    if p >= 1.0:
        return 1
    uniform = (drawn(draw, index) + 0.5) / _WORD
    return 1 + math.floor(math.log(uniform) / math.log1p(-p))

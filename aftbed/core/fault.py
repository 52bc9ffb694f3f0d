"""Faults as values, and the trigger that says when: the words of `aftbed inject`.

A fault is aimed at a node, a replica or a role; it fires at the nth occurrence of a named event, or
some time after it was armed. The node that emits the event acts on itself at that very point; where
the target is another one, the emitter waits until the target has been hit, so the point is as exact.

A bitflip is a *value fault*: one bit of one execution in one replica, of what it answers (`result`) or
of what it remembers (`state`). It can only strike where a Server has just executed, captured or restored.
"""

from enum import Enum
from typing import Final

import msgspec

from aftbed.core.event import Event

HANG_FOREVER_MS: Final = 0
BIT_MAX: Final = 2**32 - 1  # the largest state has 2**29 bits
_BIT_SHIFT: Final = 32


class Act(Enum):
    """What is done to the target."""

    CRASH = "crash"  # SIGKILL
    HANG = "hang"  # SIGSTOP
    BITFLIP = "bitflip"


class Place(Enum):
    """What of an execution a bit is flipped in."""

    RESULT = "result"
    STATE = "state"


FLIPPED_AT: Final = {  # where a Server has just made, or handed out, what is flipped
    Place.RESULT: (Event.SERVER_EXIT,),
    Place.STATE: (Event.SERVER_EXIT, Event.STATE_CAPTURED, Event.STATE_RESTORED),
}


class Flip(msgspec.Struct, frozen=True):
    """Bit `bit`, counted from bit 0 of byte 0; without one it is drawn, by the seed of the run."""

    place: Place
    bit: int | None = None


class Trigger(msgspec.Struct, frozen=True):
    """At the `nth` occurrence of the event called `event`, or `after_ms` after arming."""

    event: str = ""
    nth: int = 1
    after_ms: float = 0.0


class Fault(msgspec.Struct, frozen=True):
    """`target` is `primary`, `backup` or the name of a node; `for_ms` 0 hangs for good.

    A bitflip has a `flip`, and a role or a replica for its target. Raises ValueError on a mixture.
    """

    act: Act
    target: str
    trigger: Trigger
    for_ms: int = HANG_FOREVER_MS
    flip: Flip | None = None

    def __post_init__(self) -> None:
        if (self.act is Act.BITFLIP) != (self.flip is not None):
            raise ValueError(f"a {self.act.value} {'without' if self.flip is None else 'with'} a bit to flip")

    @property
    def event(self) -> str:
        """The event that it waits for, or `""`: a bitflip can wait for nothing less than an execution."""
        return self.trigger.event or (Event.SERVER_EXIT.label if self.flip is not None else "")

    def __str__(self) -> str:
        words = [self.act.value, *self._whom()]
        if self.for_ms:
            words += ["for", f"{self.for_ms}ms"]
        if self.trigger.event:
            words += ["at", self.trigger.event, "nth", str(self.trigger.nth)]
        elif self.trigger.after_ms:
            words += ["after", f"{self.trigger.after_ms:.6f}".rstrip("0").rstrip(".") + "ms"]
        return " ".join(words)

    def _whom(self) -> list[str]:
        if self.flip is None:
            return [self.target]
        bit = [] if self.flip.bit is None else ["bit", str(self.flip.bit)]
        return [self.flip.place.value, *bit, "in", self.target]


def flipped(data: bytes, bit: int) -> bytes:
    """`data` with this bit the other way round; there is such a bit in it."""
    assert 0 <= bit < 8 * len(data), f"bit {bit} of {len(data)} bytes"
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


def mark(number: int, bits: int = 0) -> int:
    """What the record of fault `number` has for its detail: the bit, or how many there are."""
    return bits << _BIT_SHIFT | number


def marked(detail: int) -> tuple[int, int]:
    """The number and the bits of a `mark`."""
    return detail & (1 << _BIT_SHIFT) - 1, detail >> _BIT_SHIFT

"""Faults as values, and the trigger that says when: the words of `aftbed inject`.

A fault of a *process* (`crash`, `hang`, `slow`) is aimed at a node, a replica or a role; it fires at the nth
occurrence of a named event, or some time after it was armed. The node that emits the event acts on itself at
that very point; where the target is another one, the emitter waits until the target has been hit, so the
point is as exact.

A fault of a *channel* (`omission`, `delay`, `duplicate`, `reorder`) strikes the nth message on it, where it
is sent. A *value fault* (`bitflip`, see `core.valuefault`) strikes what somebody has in hand at an event.

What strikes a message or a value can come again. A fault that lasts belongs to the process that it struck
first, as a broken part of hardware does: who takes the place of that process is sound.

A bitflip of a *field* of the state strikes memory, and waits as a fault of a process does. So does one of
the *memory* of a process as it is, whatever is kept there.

Any of them can wait for a condition of the car first: it is as if it were armed then.

A fault of the *bus* is a value of its own, with its own words for when and for how long: see `core.busfault`.
"""

from enum import Enum
from typing import Final, assert_never

import msgspec

from aftbed.core.busfault import BusFault, Condition
from aftbed.core.persistence import ONCE, Persistence
from aftbed.core.units import duration, number
from aftbed.core.valuefault import BITFLIP, FLIPPED_AT, Flip, Place

HANG_FOREVER_MS: Final = 0
SLOW_MS: Final = 2.0
SLOW_MS_MAX: Final = 500.0  # a step: orders are answered between two of them, and within 2 s
SHARE_MIN, SHARE_MAX = 0.01, 0.99  # of a CPU; a step of some milliseconds then is within SLOW_MS_MAX
DISTURBED_MS: Final = 20.0
MEMORY: Final = "memory"  # where a bit is flipped that is no value of anybody's
BYTE_BITS: Final = 8
BUS: Final = "bus"  # the target of a fault of the bus
_BIT_SHIFT: Final = 32
FIRED: Final = ("applied", "activated")  # receipts of a fault that happened


class Crash(msgspec.Struct, frozen=True, tag="crash"):
    """SIGKILL."""


class Hang(msgspec.Struct, frozen=True, tag="hang"):
    """SIGSTOP, and SIGCONT after `for_ms`, if that is not 0."""

    for_ms: int = HANG_FOREVER_MS


class Slow(msgspec.Struct, frozen=True, tag="slow"):
    """Each step of the target's bricks takes `by_ms` longer; for good, if `for_ms` is 0.

    Or, with a `share` of a CPU, each takes as much longer as it would if it had no more than that.
    """

    by_ms: float = SLOW_MS
    for_ms: int = 0
    share: float | None = None

    @property
    def how(self) -> str:
        """In words."""
        return f"by {duration(self.by_ms)}" if self.share is None else f"share {number(100 * self.share)}%"


class How(Enum):
    """What is done to a message."""

    OMISSION = "omission"  # it is not sent
    DELAY = "delay"  # it is sent later, and what comes behind it too
    DUPLICATE = "duplicate"  # it is sent twice
    REORDER = "reorder"  # it is sent behind its successor, if that comes in time


LATER: Final = (How.DELAY, How.REORDER)


class Disturb(msgspec.Struct, frozen=True, tag="disturb"):
    """Messages on `channel` are not sent as they should; LATER holds one back for `by_ms` at most."""

    how: How
    channel: str
    by_ms: float = DISTURBED_MS


class FlipMemory(msgspec.Struct, frozen=True, tag="memory"):
    """Bit `bit` of one byte of a process's own memory; what is left out is drawn, from what it can write."""

    bit: int | None = None
    address: int | None = None


Action = Crash | Hang | Slow | Disturb | Flip | FlipMemory | BusFault


class Trigger(msgspec.Struct, frozen=True):
    """At the `nth` occurrence of the event called `event`, or `after_ms` after arming.

    Of a fault of a channel, which waits for no event: at the `nth` message from the arming on. With `when`,
    that is the first step of the car at which the condition holds.
    """

    event: str = ""
    nth: int = 1
    after_ms: float = 0.0
    when: Condition | None = None

    def __post_init__(self) -> None:
        if self.after_ms and self.when is not None:
            raise ValueError("a fault that strikes after a time and on a condition")


class Fault(msgspec.Struct, frozen=True):
    """`target` is `primary`, `backup` or the name of a node; of a value or a channel, a role or a replica.

    Raises ValueError on a mixture that means nothing.
    """

    action: Action
    target: str
    trigger: Trigger
    persistence: Persistence = ONCE

    def __post_init__(self) -> None:
        if isinstance(self.action, BusFault) and (self.trigger, self.target) != (Trigger(), BUS):
            raise ValueError("a fault of the bus has its own words for when")
        if self.persistence != ONCE and not isinstance(self.action, Flip | Disturb):
            raise ValueError(f"a {self.word} strikes once")
        if isinstance(self.action, Flip) and self.action.field:
            if self.action.place is not Place.STATE:
                raise ValueError(f"a {self.action.place.value} has no fields")
            if self.persistence != ONCE:
                raise ValueError("a bitflip of a field strikes once")
        if isinstance(self.action, Disturb) and self.trigger.event:
            raise ValueError(f"a fault of a channel waits for no event: {self.trigger.event}")

    @property
    def word(self) -> str:
        """What it is called."""
        return word_of(self.action)

    @property
    def event(self) -> str:
        """The event that it waits for, or `""`: a value fault can wait for nothing less than a value.

        But memory is always there.
        """
        if isinstance(self.action, Flip) and not self.action.field:
            return self.trigger.event or FLIPPED_AT[self.action.place][0].label
        return self.trigger.event

    def __str__(self) -> str:
        if isinstance(self.action, BusFault):
            return str(self.action)
        words = [self.word, *_whom(self.action, self.target), *self._when(), str(self.persistence)]
        return " ".join(filter(None, words))

    def _when(self) -> list[str]:
        trigger = self.trigger
        when = "" if trigger.when is None else f"when {trigger.when}"
        if trigger.event:
            return [f"at {trigger.event} nth {trigger.nth}", when]
        if trigger.after_ms:
            return [f"after {duration(trigger.after_ms)}"]
        return [f"nth {trigger.nth}" if isinstance(self.action, Disturb) else "", when]


def on_bus(fault: BusFault) -> Fault:
    """A fault of the bus, among the others."""
    return Fault(fault, BUS, Trigger())


def word_of(action: Action) -> str:
    """What a fault with that action is called."""
    match action:
        case Crash():
            return "crash"
        case Hang():
            return "hang"
        case Slow():
            return "slow"
        case Flip() | FlipMemory():
            return BITFLIP
        case Disturb(how):
            return how.value
        case BusFault():
            return action.verb
        case _:
            assert_never(action)


def _whom(action: Action, target: str) -> list[str]:
    """The words between what it is called and when it strikes."""
    match action:
        case Crash():
            return [target]
        case Hang(for_ms):
            return [target, f"for {for_ms}ms" if for_ms else ""]
        case Slow(_, for_ms):
            return [target, action.how, f"for {for_ms}ms" if for_ms else ""]
        case FlipMemory(bit, address):
            at = "" if address is None else f"address {address:#x}"
            return [MEMORY, "" if bit is None else f"bit {bit}", at, "in", target]
        case Flip(_, pattern):
            return [action.where, str(pattern), "in", target]
        case Disturb(how, channel, by_ms):
            return [channel, f"by {duration(by_ms)}" if how in LATER else "", "in", target]
        case BusFault():
            raise AssertionError(f"{action} has words of its own")
        case _:
            assert_never(action)


def mark(number: int, bits: int = 0) -> int:
    """What the record of fault `number` has for its detail: the bit, or how many there are."""
    return bits << _BIT_SHIFT | number


def marked(detail: int) -> tuple[int, int]:
    """The number and the bits of a `mark`."""
    return detail & (1 << _BIT_SHIFT) - 1, detail >> _BIT_SHIFT

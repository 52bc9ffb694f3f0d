"""Faults as values, and the trigger that says when: the words of `aftbed inject`.

A fault is aimed at a node, a replica or a role; it fires at the nth occurrence of a named event, or
some time after it was armed. The node that emits the event acts on itself at that very point; where
the target is another one, the emitter waits until the target has been hit, so the point is as exact.
"""

from enum import Enum
from typing import Final

import msgspec

HANG_FOREVER_MS: Final = 0


class Act(Enum):
    """What is done to the target's processes."""

    CRASH = "crash"  # SIGKILL
    HANG = "hang"  # SIGSTOP


class Trigger(msgspec.Struct, frozen=True):
    """At the `nth` occurrence of the event called `event`, or `after_ms` after arming."""

    event: str = ""
    nth: int = 1
    after_ms: int = 0


class Fault(msgspec.Struct, frozen=True):
    """`target` is `primary`, `backup` or the name of a node; `for_ms` 0 hangs for good."""

    act: Act
    target: str
    trigger: Trigger
    for_ms: int = HANG_FOREVER_MS

    def __str__(self) -> str:
        words = [self.act.value, self.target]
        if self.for_ms:
            words += ["for", f"{self.for_ms}ms"]
        if self.trigger.event:
            words += ["at", self.trigger.event, "nth", str(self.trigger.nth)]
        elif self.trigger.after_ms:
            words += ["after", f"{self.trigger.after_ms}ms"]
        return " ".join(words)

"""Every point at which a fault can be aimed, as one closed enumeration.

Bricks emit them with `Note`, hosts with their journal. The injector, the checkers and the reports use the
same names.
"""

from enum import Enum
from typing import Final

from aftbed.core.errors import unknown


class Weight(Enum):
    """How much an event matters to a reader of a run."""

    ROUTINE = "routine"  # a request leaves it where nothing goes wrong
    NOTABLE = "notable"
    TURNING_POINT = "turning point"  # the run is another one after it


class Event(Enum):
    """A named event; `code` is its number in a journal, and is never reused for another."""

    REQUEST_SENT = (1, "request.sent", Weight.ROUTINE)
    REQUEST_RECEIVED = (2, "request.received", Weight.ROUTINE)
    BEFORE_EXIT = (3, "before.exit", Weight.ROUTINE)
    PROCEED_ENTER = (4, "proceed.enter", Weight.ROUTINE)
    SERVER_ENTER = (5, "server.enter", Weight.ROUTINE)
    SERVER_EXIT = (6, "server.exit", Weight.ROUTINE)
    STATE_CAPTURED = (7, "state.captured", Weight.ROUTINE)
    CHECKPOINT_SENT = (8, "checkpoint.sent", Weight.ROUTINE)
    REPLY_STORED = (9, "reply.stored", Weight.ROUTINE)
    REPLY_SENT = (10, "reply.sent", Weight.ROUTINE)
    REPLY_DELIVERED = (11, "reply.delivered", Weight.ROUTINE)
    DEDUPE_HIT = (12, "dedupe.hit")
    CHECKPOINT_APPLIED = (13, "checkpoint.applied", Weight.ROUTINE)
    REPLY_ACCEPTED = (14, "reply.accepted", Weight.ROUTINE)
    REPLY_REFUSED = (15, "reply.refused")
    FOLLOWER_FORWARDED = (16, "follower.forwarded", Weight.ROUTINE)
    FOLLOWER_NOTIFIED = (17, "follower.notified", Weight.ROUTINE)
    FOLLOWER_DIVERGED = (18, "follower.diverged", Weight.TURNING_POINT)
    VOTE_COMPARED = (19, "vote.compared", Weight.ROUTINE)
    WATCHDOG_SUSPECT = (20, "watchdog.suspect", Weight.TURNING_POINT)
    RECOVERY_ENTER = (21, "recovery.enter", Weight.TURNING_POINT)
    RECOVERY_EXIT = (22, "recovery.exit", Weight.TURNING_POINT)
    REPLICA_FENCED = (23, "replica.fenced")
    REPLICA_PROMOTED = (24, "replica.promoted", Weight.TURNING_POINT)
    BACKUP_READY = (25, "backup.ready", Weight.TURNING_POINT)
    DETECTED_STOP = (26, "detected.stop", Weight.TURNING_POINT)
    NODE_DIED = (31, "node.died")
    STATE_RESTORED = (32, "state.restored", Weight.ROUTINE)
    PEER_REFUSED = (35, "peer.refused")
    FAULT_APPLIED = (40, "fault.applied", Weight.TURNING_POINT)
    ADAPT_PLAN = (50, "adapt.plan", Weight.TURNING_POINT)
    ADAPT_STEP_ENTER = (51, "adapt.step.enter")
    ADAPT_STEP_EXIT = (52, "adapt.step.exit")
    ADAPT_COMMIT = (53, "adapt.commit", Weight.TURNING_POINT)
    ADAPT_ROLLBACK = (54, "adapt.rollback", Weight.TURNING_POINT)
    ADAPT_STEP_ACT = (55, "adapt.step.act")

    def __init__(self, code: int, label: str, weight: Weight = Weight.NOTABLE) -> None:
        self.code = code
        self.label = label
        self.weight = weight

    __hash__ = object.__hash__  # that of Enum is a Python function, and records are found by their event

    def __str__(self) -> str:
        return self.label


BY_CODE: Final = {event.code: event for event in Event}
BY_LABEL: Final = {event.label: event for event in Event}

LATE: Final = 1  # detail of `detected.stop`: a deadline had passed; what was late may have been right
RERUN: Final = 1  # detail of `server.enter` and `server.exit`: the request ran again, from the same state

REQUEST_EVENTS: Final = frozenset(event for event in Event if event.weight is Weight.ROUTINE)
STEP_EVENTS: Final = frozenset((Event.ADAPT_STEP_ENTER, Event.ADAPT_STEP_ACT, Event.ADAPT_STEP_EXIT))
FIRST_FAULT: Final = 1_000_001  # number of the first fault of a run; those of orders are smaller


def event_named(label: str) -> Event:
    """The event called `label`; raises ConfigError with the nearest name that exists."""
    event = BY_LABEL.get(label)
    if event is None:
        raise unknown("event", label, BY_LABEL)
    return event

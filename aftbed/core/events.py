"""Every point at which a fault can be aimed, as one closed enumeration.

Bricks emit them with `Note`, hosts with their journal; the injector, the checkers and the reports
use the same names. `REQUEST_PATH` are the events of one request under PBR, in their order.
"""

from enum import Enum
from typing import Final

from aftbed.core.errors import unknown


class Event(Enum):
    """A named event; `code` is its number in a journal, and is never reused for another."""

    REQUEST_SENT = (1, "request.sent")
    REQUEST_RECEIVED = (2, "request.received")
    BEFORE_EXIT = (3, "before.exit")
    PROCEED_ENTER = (4, "proceed.enter")
    SERVER_ENTER = (5, "server.enter")
    SERVER_EXIT = (6, "server.exit")
    STATE_CAPTURED = (7, "state.captured")
    CHECKPOINT_SENT = (8, "checkpoint.sent")
    REPLY_STORED = (9, "reply.stored")
    REPLY_SENT = (10, "reply.sent")
    REPLY_DELIVERED = (11, "reply.delivered")
    DEDUPE_HIT = (12, "dedupe.hit")
    CHECKPOINT_APPLIED = (13, "checkpoint.applied")
    REPLY_ACCEPTED = (14, "reply.accepted")
    REPLY_REFUSED = (15, "reply.refused")
    FOLLOWER_FORWARDED = (16, "follower.forwarded")
    FOLLOWER_NOTIFIED = (17, "follower.notified")
    FOLLOWER_DIVERGED = (18, "follower.diverged")
    VOTE_COMPARED = (19, "vote.compared")
    WATCHDOG_SUSPECT = (20, "watchdog.suspect")
    RECOVERY_ENTER = (21, "recovery.enter")
    RECOVERY_EXIT = (22, "recovery.exit")
    REPLICA_FENCED = (23, "replica.fenced")
    REPLICA_PROMOTED = (24, "replica.promoted")
    BACKUP_READY = (25, "backup.ready")
    DETECTED_STOP = (26, "detected.stop")
    NODE_DIED = (31, "node.died")
    STATE_RESTORED = (32, "state.restored")
    PEER_REFUSED = (35, "peer.refused")
    FAULT_APPLIED = (40, "fault.applied")
    ADAPT_PLAN = (50, "adapt.plan")
    ADAPT_STEP_ENTER = (51, "adapt.step.enter")
    ADAPT_STEP_EXIT = (52, "adapt.step.exit")
    ADAPT_COMMIT = (53, "adapt.commit")
    ADAPT_ROLLBACK = (54, "adapt.rollback")
    ADAPT_STEP_ACT = (55, "adapt.step.act")

    def __init__(self, code: int, label: str) -> None:
        self.code = code
        self.label = label

    def __str__(self) -> str:
        return self.label


BY_CODE: Final = {event.code: event for event in Event}
BY_LABEL: Final = {event.label: event for event in Event}

RERUN: Final = 1  # detail of `server.enter` and `server.exit`: the request ran again, from the same state

REQUEST_PATH: Final = (
    Event.REQUEST_SENT,
    Event.REQUEST_RECEIVED,
    Event.BEFORE_EXIT,
    Event.PROCEED_ENTER,
    Event.SERVER_ENTER,
    Event.SERVER_EXIT,
    Event.STATE_CAPTURED,
    Event.CHECKPOINT_SENT,
    Event.REPLY_STORED,
    Event.REPLY_SENT,
    Event.REPLY_DELIVERED,
)
REQUEST_EVENTS: Final = frozenset(  # records that a request leaves when nothing goes wrong
    (*REQUEST_PATH, Event.REPLY_ACCEPTED, Event.CHECKPOINT_APPLIED, Event.STATE_RESTORED)
    + (Event.FOLLOWER_FORWARDED, Event.FOLLOWER_NOTIFIED, Event.VOTE_COMPARED)
)
STEP_EVENTS: Final = frozenset((Event.ADAPT_STEP_ENTER, Event.ADAPT_STEP_ACT, Event.ADAPT_STEP_EXIT))
FIRST_FAULT: Final = 1_000_001  # number of the first fault of a run, in the detail of `fault.applied`


def event_named(label: str) -> Event:
    """The event called `label`; raises ConfigError with the nearest name that exists."""
    event = BY_LABEL.get(label)
    if event is None:
        raise unknown("event", label, BY_LABEL)
    return event

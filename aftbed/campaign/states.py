"""States that a campaign can ask to have been in: `sometimes: [failover in an adaptation, vote differs]`.

A campaign that never came to what it is about has shown nothing of it, however many experiments passed. So a
state that no experiment was in fails the campaign. Each state is read off the events of a run, or off what
its car did.
"""

from collections.abc import Callable
from enum import StrEnum
from typing import Final

from aftbed.core.events import Event
from aftbed.judge.intervals import AGREED
from aftbed.judge.record import RunRecord


class RunState(StrEnum):
    """What a run can have been in."""

    FAILOVER = "failover"
    IN_ADAPTATION = "failover in an adaptation"
    ROLLED_BACK = "adaptation rolled back"
    NEW_BACKUP = "new backup"
    VOTE_DIFFERS = "vote differs"
    DIVERGENCE = "divergence noticed"
    DETECTED_STOP = "detected stop"
    FROM_LOG = "reply from the log"
    REPLY_REFUSED = "reply refused"
    FALLBACK = "fallback of the brakes"


OF_A_CAR: Final = (RunState.FALLBACK,)  # no other run can be in them


def states_of(record: RunRecord) -> tuple[RunState, ...]:
    """Those that the run was in, in the order of their declaration."""
    return tuple(state for state, was_in in _STATES.items() if was_in(record))


def _happened(event: Event) -> Callable[[RunRecord], bool]:
    return lambda record: bool(record.history.events(event))


def _vote_differs(record: RunRecord) -> bool:
    return any(vote.detail != AGREED for vote in record.history.events(Event.VOTE_COMPARED))


def _fell_back(record: RunRecord) -> bool:
    return record.vehicle is not None and record.vehicle.fallback_s is not None


def _in_adaptation(record: RunRecord) -> bool:
    """A replica was suspected after an adaptation had been planned, and before it was kept or undone."""
    under_way = False
    for happened in record.history.events(
        Event.ADAPT_PLAN, Event.ADAPT_COMMIT, Event.ADAPT_ROLLBACK, Event.WATCHDOG_SUSPECT
    ):
        if happened.event is Event.WATCHDOG_SUSPECT:
            if under_way:
                return True
        else:
            under_way = happened.event is Event.ADAPT_PLAN
    return False


_STATES: Final[dict[RunState, Callable[[RunRecord], bool]]] = {
    RunState.FAILOVER: _happened(Event.REPLICA_PROMOTED),
    RunState.IN_ADAPTATION: _in_adaptation,
    RunState.ROLLED_BACK: _happened(Event.ADAPT_ROLLBACK),
    RunState.NEW_BACKUP: _happened(Event.BACKUP_READY),
    RunState.VOTE_DIFFERS: _vote_differs,
    RunState.DIVERGENCE: _happened(Event.FOLLOWER_DIVERGED),
    RunState.DETECTED_STOP: _happened(Event.DETECTED_STOP),
    RunState.FROM_LOG: _happened(Event.DEDUPE_HIT),
    RunState.REPLY_REFUSED: _happened(Event.REPLY_REFUSED),
    RunState.FALLBACK: _fell_back,
}
assert list(_STATES) == list(RunState)

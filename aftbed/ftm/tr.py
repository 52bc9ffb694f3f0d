"""Before, Proceed and After of TR, time redundancy: one request, executed twice from the same state.

Paper, III-B: Before captures the Server's state, Proceed computes more than once, After compares. What is
compared is the reply *and* the state after it: a fault that only hits what the function remembers would come
out with some later request, when there is nothing left to compare it with.

| two trials | third trial           | then                                                             |
|------------|-----------------------|------------------------------------------------------------------|
| equal      | -                     | that reply                                                       |
| differ     | equal to one of them  | that reply: the fault was in the other                           |
| differ     | equal to none         | detected stop: no reply leaves, and under a duplex the other one |
|            |                       | executes                                                         |

The Server is left in the state of the majority: the trial that settles a vote is the last one that ran, and
it is one of the equal ones. So nothing has to be restored when the vote is over.

Limits: a fault that hits what was captured, before the first trial, is in all of them. So is one that lasts,
or that comes twice with the same effect. A trial carries the state, and two of them are one packet: a state
may be a third of a packet long.
"""

from enum import auto
from typing import Final

from aftbed.core.brick import Brick, BrickState, Effect, Halt, Note, Send, no_move
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.messages import (
    Again,
    AnyMessage,
    CaptureState,
    Reply,
    Request,
    StateCaptured,
    TakeOver,
    Trial,
    Trials,
    Tried,
)

UNDECIDED: Final = 0  # detail of `vote.compared`: no majority; else how many trials it took

# Bound once: a look-up in an enumeration is slow on the hot path.
_BEFORE_EXIT: Final = Event.BEFORE_EXIT
_PROCEED_ENTER: Final = Event.PROCEED_ENTER
_COMPARED: Final = Event.VOTE_COMPARED


class TrBeforeState(BrickState):
    IDLE = auto()  # no request in progress
    CAPTURING = auto()  # request held, waiting for the Server's state


BEFORE_MOVES: Final = {
    (TrBeforeState.IDLE, Request): TrBeforeState.CAPTURING,
    (TrBeforeState.IDLE, TakeOver): TrBeforeState.IDLE,
    (TrBeforeState.CAPTURING, StateCaptured): TrBeforeState.IDLE,
}
BEFORE_OPEN: Final = {TrBeforeState.IDLE: ("pro2bfr",), TrBeforeState.CAPTURING: ("srv2bfr",)}


class TrBefore(Brick):
    """Captures, for one request at a time, the state that all its trials start from."""

    def __init__(self) -> None:
        self.state = TrBeforeState.IDLE
        self._request: Request | None = None

    def open_ports(self) -> tuple[str, ...]:
        """By state; see BEFORE_OPEN."""
        return BEFORE_OPEN[self.state]

    def quiescent(self) -> bool:
        """No request held."""
        return self.state is TrBeforeState.IDLE

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Handle one message; see BEFORE_MOVES."""
        state = BEFORE_MOVES.get((self.state, type(msg)))
        if state is None:
            return no_move(self.state, port, msg)
        if isinstance(msg, Request):
            self.state, self._request = state, msg
            return [Send("bfr2srv", CaptureState(msg.epoch, msg.request_id))]
        if isinstance(msg, TakeOver):
            return [Send("bfr2prd", msg)]
        assert isinstance(msg, StateCaptured) and self._request is not None
        if msg.request_id != self._request.request_id:
            raise PeerError(f"state for request {msg.request_id}, expected {self._request.request_id}")
        request, self.state, self._request = self._request, state, None
        trial = Trial(request.epoch, request.request_id, request.payload, msg.state, rerun=False)
        return [Note(_BEFORE_EXIT, request.request_id), Send("bfr2prd", trial)]


class TrProceedState(BrickState):
    IDLE = auto()  # no request in progress
    FIRST = auto()  # the Server has the trial, twice
    SECOND = auto()  # one result is there
    VOTING = auto()  # After has both; it asks for a third, or the next request comes
    THIRD = auto()  # the Server has the trial, for the third time


PROCEED_MOVES: Final = {
    (TrProceedState.IDLE, Trial): TrProceedState.FIRST,
    (TrProceedState.IDLE, TakeOver): TrProceedState.IDLE,
    (TrProceedState.FIRST, Tried): TrProceedState.SECOND,
    (TrProceedState.SECOND, Tried): TrProceedState.VOTING,
    (TrProceedState.VOTING, Trial): TrProceedState.FIRST,
    (TrProceedState.VOTING, TakeOver): TrProceedState.VOTING,
    (TrProceedState.VOTING, Again): TrProceedState.THIRD,
    (TrProceedState.THIRD, Tried): TrProceedState.IDLE,
}
PROCEED_OPEN: Final[dict[TrProceedState, tuple[str, ...]]] = {
    TrProceedState.IDLE: ("bfr2prd",),
    TrProceedState.FIRST: ("srv2prd",),
    TrProceedState.SECOND: ("srv2prd",),
    TrProceedState.VOTING: ("bfr2prd", "aft2prd"),
    TrProceedState.THIRD: ("srv2prd",),
}


_VOTING: Final = TrProceedState.VOTING
_NEXT: Final = ("bfr2prd",)


class TrProceed(Brick):
    """`agreed`: the trials of the last request are equal, so that After has nothing more to ask.

    After decides; this is only to know whether a request may still come back here. No two ports have mail
    at a time in VOTING: the next request is let in when this one has been answered.
    """

    def __init__(self) -> None:
        self.state = TrProceedState.IDLE
        self.agreed = True
        self._trial: Trial | None = None
        self._first: Tried | None = None

    def open_ports(self) -> tuple[str, ...]:
        """By state; see PROCEED_OPEN. Where trials are equal, After asks for no third, which saves a poll."""
        return _NEXT if self.agreed and self.state is _VOTING else PROCEED_OPEN[self.state]

    def quiescent(self) -> bool:
        """No trial under way, and none to be asked for."""
        return self.state is TrProceedState.IDLE or (self.state is TrProceedState.VOTING and self.agreed)

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Handle one message; see PROCEED_MOVES."""
        state = PROCEED_MOVES.get((self.state, type(msg)))
        if state is None:
            return no_move(self.state, port, msg)
        if isinstance(msg, Trial):
            self.state, self._trial = state, msg
            # Both at once: the second starts from the same state, whatever the first one says.
            again = self._rerun(msg.request_id)
            return [Note(_PROCEED_ENTER, msg.request_id), Send("prd2srv", msg), Send("prd2srv", again)]
        if isinstance(msg, Tried):
            return self._tried(msg, state)
        if isinstance(msg, Again):
            rerun = self._rerun(msg.request_id)
            self.state = state
            return [Send("prd2srv", rerun)]
        assert isinstance(msg, TakeOver)
        self.state = state
        return [Send("prd2aft", msg)]

    def _tried(self, msg: Tried, state: TrProceedState) -> list[Effect]:
        self._expect(msg.request_id)
        self.state = state
        if state is TrProceedState.SECOND:
            self._first = msg
            return []
        if state is TrProceedState.IDLE:
            self._trial = None
            return [Send("prd2aft", Trials(msg.epoch, msg.request_id, (msg,)))]
        first, self._first = self._first, None
        assert first is not None
        self.agreed = equal(first, msg)
        return [Send("prd2aft", Trials(msg.epoch, msg.request_id, (first, msg)))]

    def _expect(self, request_id: int) -> Trial:
        """The trial under way; raises PeerError if it is not the one that is meant."""
        trial = self._trial
        assert trial is not None
        if request_id != trial.request_id:
            raise PeerError(f"trial of request {request_id}, expected {trial.request_id}")
        return trial

    def _rerun(self, request_id: int) -> Trial:
        """The trial once more; raises PeerError if it is not the one that is meant."""
        trial = self._expect(request_id)
        return Trial(trial.epoch, trial.request_id, trial.payload, trial.state, rerun=True)


class TrAfterState(BrickState):
    IDLE = auto()  # no trials held
    ASKED = auto()  # two trials held that differ, waiting for the third


AFTER_MOVES: Final = {
    (TrAfterState.IDLE, Trials): TrAfterState.ASKED,  # or answered at once, where they are equal
    (TrAfterState.IDLE, TakeOver): TrAfterState.IDLE,
    (TrAfterState.ASKED, Trials): TrAfterState.IDLE,
}
AFTER_OPEN: Final = {TrAfterState.IDLE: ("prd2aft",), TrAfterState.ASKED: ("prd2aft",)}
_WANTED: Final = {TrAfterState.IDLE: 2, TrAfterState.ASKED: 1}  # how many trials come at once


def equal(one: Tried, other: Tried) -> bool:
    """Whether two trials came to the same, in what is answered and in what is remembered."""
    return one.payload == other.payload and one.state == other.state


class TrAfter(Brick):
    """The vote."""

    def __init__(self) -> None:
        self.state = TrAfterState.IDLE
        self._held: tuple[Tried, ...] = ()

    def open_ports(self) -> tuple[str, ...]:
        """By state; see AFTER_OPEN."""
        return AFTER_OPEN[self.state]

    def quiescent(self) -> bool:
        """No trials held."""
        return self.state is TrAfterState.IDLE

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Handle one message; see AFTER_MOVES."""
        if (self.state, type(msg)) not in AFTER_MOVES:
            return no_move(self.state, port, msg)
        if isinstance(msg, TakeOver):
            return [Send("aft2pro", msg)]
        assert isinstance(msg, Trials)
        ids = {msg.request_id, *(t.request_id for t in (*self._held, *msg.tried))}
        if len(msg.tried) != _WANTED[self.state] or len(ids) > 1:
            raise PeerError(f"{len(msg.tried)} trials of requests {sorted(ids)} while {self.state.name}")
        return self._settle(msg) if self._held else self._compare(msg)

    def _compare(self, msg: Trials) -> list[Effect]:
        first, second = msg.tried
        if equal(first, second):
            return self._answer(second, 2)
        self.state, self._held = TrAfterState.ASKED, msg.tried
        return [Send("aft2prd", Again(msg.epoch, msg.request_id))]

    def _settle(self, msg: Trials) -> list[Effect]:
        (third,) = msg.tried
        if any(equal(third, held) for held in self._held):
            # The Server is as this trial, its last, has left it: in a state of the majority.
            self.state, self._held = TrAfterState.IDLE, ()
            return self._answer(third, 3)
        return [
            Note(_COMPARED, msg.request_id, UNDECIDED),
            Note(Event.DETECTED_STOP, msg.request_id),
            Halt(f"no majority for request {msg.request_id}: three trials, no two of them equal"),
        ]

    def _answer(self, tried: Tried, trials: int) -> list[Effect]:
        reply = Reply(tried.epoch, tried.request_id, tried.replica, tried.payload)
        return [Note(_COMPARED, tried.request_id, trials), Send("aft2pro", reply)]

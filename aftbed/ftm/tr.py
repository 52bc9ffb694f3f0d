"""TR, time redundancy: one request, executed twice from the same state.

Paper, III-B: Before captures the Server's state, Proceed computes more than once, After compares. What is
compared is the reply *and* the state after it: a fault that hits only the state would show with some later
request, when there is nothing left to compare it with.

| two trials | third trial           | then                                                             |
|------------|-----------------------|------------------------------------------------------------------|
| equal      | -                     | that reply                                                       |
| differ     | equal to one of them  | that reply: the fault was in the other                           |
| differ     | equal to none         | detected stop: no reply leaves, and under a duplex the other     |
|            |                       | replica executes                                                 |

The Server is left in the state of the majority: the trial that settles a vote is the last one that ran, and
it is one of the equal ones. So nothing has to be restored when the vote is over.

Limits: a fault that hits the captured state, before the first trial, is in all of them. So is one that lasts,
or that comes twice with the same effect. A trial carries the state, and two of them are one packet: a state
may be a third of a packet long.
"""

from enum import auto
from typing import ClassVar, Final

from aftbed.core.brick import (
    SAME_STATE,
    BrickAnswer,
    BrickState,
    Choice,
    Effect,
    Halt,
    Machine,
    Moves,
    Note,
    Send,
    hand_on,
)
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.messages import (
    Again,
    CaptureState,
    Reply,
    Request,
    StateCaptured,
    TakeOver,
    Trial,
    Trials,
    Tried,
)
from aftbed.ftm.declaration import BrickKind, Emits, Mechanism, Suitability

UNDECIDED: Final = 0  # detail of `vote.compared`: no majority; else how many trials it took

# Bound once: a look-up in an enumeration is slow on the hot path.
_BEFORE_EXIT: Final = Event.BEFORE_EXIT
_PROCEED_ENTER: Final = Event.PROCEED_ENTER
_COMPARED: Final = Event.VOTE_COMPARED


def equal(one: Tried, other: Tried) -> bool:
    """Whether two trials agree, in the reply and in the state after it."""
    return one.payload == other.payload and one.state == other.state


class TrBeforeState(BrickState):
    IDLE = auto()  # no request in progress
    CAPTURING = auto()  # request held, waiting for the Server's state


_B: Final = TrBeforeState


class TrBefore(Machine):
    """Captures, for one request at a time, the state that all its trials start from."""

    AT_REST = (_B.IDLE,)

    def __init__(self) -> None:
        super().__init__()
        self._request: Request | None = None

    def ask_for_state(self, msg: Request) -> list[Effect]:
        """Hold the request until the state before it is captured."""
        self._request = msg
        return [Send("bfr2srv", CaptureState(msg.epoch, msg.request_id))]

    def begin_trial(self, msg: StateCaptured) -> list[Effect]:
        request = self._request
        assert request is not None
        if msg.request_id != request.request_id:
            raise PeerError(f"state for request {msg.request_id}, expected {request.request_id}")
        if not isinstance(msg.state, bytes):
            raise PeerError(f"state for request {msg.request_id} in pages, expected whole")
        self._request = None
        trial = Trial(request.epoch, request.request_id, request.payload, msg.state, rerun=False)
        return [Note(_BEFORE_EXIT, request.request_id), Send("bfr2prd", trial)]

    MOVES: ClassVar[Moves] = {
        (_B.IDLE, "pro2bfr", Request): (ask_for_state, _B.CAPTURING),
        (_B.IDLE, "pro2bfr", TakeOver): (hand_on("bfr2prd"), SAME_STATE),
        (_B.CAPTURING, "srv2bfr", StateCaptured): (begin_trial, _B.IDLE),
    }


class TrProceedState(BrickState):
    IDLE = auto()  # no request in progress, or both trials agree: After asks for no third one
    FIRST = auto()  # the Server has the trial, twice
    SECOND = auto()  # one result is there
    VOTING = auto()  # After has two results that differ, and asks for a third one
    THIRD = auto()  # the Server has the trial, for the third time


_P: Final = TrProceedState


class TrProceed(Machine):
    """Runs a trial twice, and a third time if After asks for it.

    After decides. Proceed compares only to know whether a request may still come back to it: where two trials
    agree, one open port is enough, which saves the host a poll. The next trial is legal in VOTING too: an
    After written off line may settle a vote between two trials that differ.
    """

    AT_REST = (_P.IDLE,)

    def __init__(self) -> None:
        super().__init__()
        self._trial: Trial | None = None
        self._first: Tried | None = None

    def run_twice(self, msg: Trial) -> list[Effect]:
        """Both at once: the second starts from the same state, whatever comes of the first."""
        self._trial = msg
        return [Note(_PROCEED_ENTER, msg.request_id), Send("prd2srv", msg), Send("prd2srv", self._rerun(msg))]

    def hold_first(self, msg: Tried) -> list[Effect]:
        self._expect(msg)
        self._first = msg
        return []

    def agrees(self, msg: Tried) -> bool:
        """Whether the second result is the first one."""
        self._expect(msg)
        assert self._first is not None
        return equal(self._first, msg)

    def send_both(self, msg: Tried) -> list[Effect]:
        first, self._first = self._first, None
        assert first is not None
        return [Send("prd2aft", Trials(msg.epoch, msg.request_id, (first, msg)))]

    def run_again(self, msg: Again) -> list[Effect]:
        return [Send("prd2srv", self._rerun(self._expect(msg)))]

    def send_third(self, msg: Tried) -> list[Effect]:
        self._expect(msg)
        return [Send("prd2aft", Trials(msg.epoch, msg.request_id, (msg,)))]

    def _expect(self, msg: Tried | Again) -> Trial:
        """The trial under way; raises PeerError if `msg` is about another one."""
        trial = self._trial
        assert trial is not None
        if msg.request_id != trial.request_id:
            raise PeerError(f"trial of request {msg.request_id}, expected {trial.request_id}")
        return trial

    def _rerun(self, trial: Trial) -> Trial:
        return Trial(trial.epoch, trial.request_id, trial.payload, trial.state, rerun=True)

    MOVES: ClassVar[Moves] = {
        (_P.IDLE, "bfr2prd", Trial): (run_twice, _P.FIRST),
        (_P.IDLE, "bfr2prd", TakeOver): (hand_on("prd2aft"), SAME_STATE),
        (_P.FIRST, "srv2prd", Tried): (hold_first, _P.SECOND),
        (_P.SECOND, "srv2prd", Tried): Choice(
            agrees, {True: (send_both, _P.IDLE), False: (send_both, _P.VOTING)}
        ),
        (_P.VOTING, "bfr2prd", Trial): (run_twice, _P.FIRST),
        (_P.VOTING, "bfr2prd", TakeOver): (hand_on("prd2aft"), SAME_STATE),
        (_P.VOTING, "aft2prd", Again): (run_again, _P.THIRD),
        (_P.THIRD, "srv2prd", Tried): (send_third, _P.IDLE),
    }


class TrAfterState(BrickState):
    IDLE = auto()  # no trials held
    ASKED = auto()  # two trials held that differ, waiting for the third


_A: Final = TrAfterState


class Vote(BrickAnswer):
    MAJORITY = auto()  # the last trial has an equal one
    OPEN = auto()  # two trials differ
    NONE = auto()  # three trials, no two of them equal


_MAJORITY, _OPEN, _NONE = Vote.MAJORITY, Vote.OPEN, Vote.NONE


class TrAfter(Machine):
    """The vote."""

    AT_REST = (_A.IDLE,)

    def __init__(self) -> None:
        super().__init__()
        self._held: tuple[Tried, ...] = ()

    def vote(self, msg: Trials) -> Vote:
        """Compare. Raises PeerError unless two trials come first, then a third one, all of one request."""
        tried, held = msg.tried, self._held
        if len(tried) != (1 if held else 2):
            raise self._refusal(msg)
        compared = (*held, *tried)
        for one in compared:
            if one.request_id != msg.request_id:
                raise self._refusal(msg)
        last = tried[-1]
        for other in compared[:-1]:
            if equal(last, other):
                return _MAJORITY
        return _NONE if held else _OPEN

    def _refusal(self, msg: Trials) -> PeerError:
        ids = {msg.request_id, *(one.request_id for one in (*self._held, *msg.tried))}
        return PeerError(f"{len(msg.tried)} trials of requests {sorted(ids)} while {self.state.name}")

    def reply(self, msg: Trials) -> list[Effect]:
        """Two trials agree."""
        return self._reply(msg.tried[-1], 2)

    def reply_by_third(self, msg: Trials) -> list[Effect]:
        """The third trial is right, and the Server is as this trial, its last, has left it."""
        self._held = ()
        return self._reply(msg.tried[-1], 3)

    def ask_for_third(self, msg: Trials) -> list[Effect]:
        self._held = msg.tried
        return [Send("aft2prd", Again(msg.epoch, msg.request_id))]

    def stop(self, msg: Trials) -> list[Effect]:
        return [
            Note(_COMPARED, msg.request_id, UNDECIDED),
            Note(Event.DETECTED_STOP, msg.request_id),
            Halt(f"no majority for request {msg.request_id}: three trials, no two of them equal"),
        ]

    def _reply(self, tried: Tried, trials: int) -> list[Effect]:
        reply = Reply(tried.epoch, tried.request_id, tried.replica, tried.payload)
        return [Note(_COMPARED, tried.request_id, trials), Send("aft2pro", reply)]

    MOVES: ClassVar[Moves] = {
        (_A.IDLE, "prd2aft", Trials): Choice(
            vote, {Vote.MAJORITY: (reply, SAME_STATE), Vote.OPEN: (ask_for_third, _A.ASKED)}
        ),
        (_A.IDLE, "prd2aft", TakeOver): (hand_on("aft2pro"), SAME_STATE),
        (_A.ASKED, "prd2aft", Trials): Choice(
            vote, {Vote.MAJORITY: (reply_by_third, _A.IDLE), Vote.NONE: (stop, SAME_STATE)}
        ),
    }


TR: Final = Mechanism(
    name="tr",
    before=BrickKind(
        "tr.before",
        ("pro2bfr", "srv2bfr"),
        ("bfr2srv", "bfr2prd"),
        make=lambda setting: TrBefore(),
        events=(Emits(Event.BEFORE_EXIT), Emits(Event.STATE_CAPTURED, by_server=True)),
        visits=(None, Event.BEFORE_EXIT),
        asks_server=1,
    ),
    proceed=BrickKind(
        "tr.proceed",
        ("bfr2prd", "srv2prd", "aft2prd"),
        ("prd2srv", "prd2aft"),
        make=lambda setting: TrProceed(),
        events=(Emits(Event.PROCEED_ENTER),),
        visits=(Event.PROCEED_ENTER,),
        asks_server=2,
        sends_beside=True,
    ),
    after=BrickKind(
        "tr.after",
        ("prd2aft",),
        ("aft2prd", "aft2pro"),
        make=lambda setting: TrAfter(),
        events=(Emits(Event.VOTE_COMPARED), Emits(Event.DETECTED_STOP)),
        visits=(Event.VOTE_COMPARED,),
    ),
    links=(
        ("before", "bfr2srv", "server"),
        ("server", "srv2bfr", "before"),
        ("after", "aft2prd", "proceed"),
    ),
    innermost=True,
    suitability=Suitability(
        tolerates=("value", "implausible"),
        deterministic="executions of one request are compared",
        state_access="every execution starts from the same state",
        exact_state="executions from one state are compared bit by bit",
        cpus=1,
        cpu_load="high",
        bandwidth="none",
    ),
)

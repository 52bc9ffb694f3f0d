"""Executable assertion: no reply leaves that cannot be right.

The function's own check (`Application.acceptable`) sees a request beside its reply, and nothing else. So
Before hands the request to After past the computation. A reply that is not acceptable ends the replica: a
detected stop. Under a duplex the other replica then executes from the state before, or has executed already.

Limits: a wrong reply that is plausible passes. A wrong state passes until a reply shows it; TR compares both.
An empty reply says that the function refuses the request, and needs no check.
"""

from collections.abc import Callable
from enum import auto
from typing import ClassVar, Final

from aftbed.core.brick import SAME_STATE, BrickState, Effect, Halt, Machine, Moves, Note, Send, hand_on
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.messages import Reply, Request, TakeOver
from aftbed.ftm.chain import COMPUTE, PassState
from aftbed.ftm.declaration import BrickKind, Emits, Mechanism, Suitability

_EXIT: Final = Event.BEFORE_EXIT  # bound once: a look-up in an enumeration is slow on the hot path

Acceptable = Callable[[bytes, bytes], bool]  # request, reply


class AssertBefore(Machine):
    """Passes a request on both ways: to After and to Proceed."""

    AT_REST = (PassState.READY,)

    def pass_on_twice(self, msg: Request) -> list[Effect]:
        """After has the request before there can be a reply."""
        return [Send("bfr2aft", msg), Note(_EXIT, msg.request_id), Send("bfr2prd", msg)]

    MOVES: ClassVar[Moves] = {
        (PassState.READY, "pro2bfr", Request): (pass_on_twice, SAME_STATE),
        (PassState.READY, "pro2bfr", TakeOver): (hand_on("bfr2prd"), SAME_STATE),  # behind the requests
    }


class AssertAfterState(BrickState):
    IDLE = auto()  # no reply held
    HOLDING = auto()  # a reply held, its request is in the channel from Before


_S: Final = AssertAfterState


class AssertAfter(Machine):
    """`acceptable` is the function's own check."""

    AT_REST = (_S.IDLE,)

    def __init__(self, acceptable: Acceptable) -> None:
        super().__init__()
        self._acceptable = acceptable
        self._held: Reply | None = None

    def hold(self, msg: Reply) -> list[Effect]:
        """Keep the reply until its request is read: that was sent before."""
        self._held = msg
        return []

    def check(self, msg: Request) -> list[Effect]:
        """Let the reply leave if it can be right, else stop."""
        reply = self._held
        assert reply is not None
        if msg.request_id != reply.request_id:
            raise PeerError(f"request {msg.request_id} beside the reply to {reply.request_id}")
        self._held = None
        if not reply.payload or self._acceptable(msg.payload, reply.payload):
            return [Send("aft2pro", reply)]
        return [
            Note(Event.DETECTED_STOP, reply.request_id),
            Halt(f"reply to request {reply.request_id} is not acceptable"),
        ]

    MOVES: ClassVar[Moves] = {
        (_S.IDLE, "prd2aft", Reply): (hold, _S.HOLDING),
        (_S.IDLE, "prd2aft", TakeOver): (hand_on("aft2pro"), SAME_STATE),
        (_S.HOLDING, "bfr2aft", Request): (check, _S.IDLE),
    }


ASSERT: Final = Mechanism(
    name="assert",
    before=BrickKind(
        "assert.before",
        ("pro2bfr",),
        ("bfr2prd", "bfr2aft"),
        make=lambda setting: AssertBefore(),
        events=(Emits(Event.BEFORE_EXIT),),
        visits=(Event.BEFORE_EXIT,),
        sends_beside=True,
    ),
    proceed=COMPUTE,
    after=BrickKind(
        "assert.after",
        ("prd2aft", "bfr2aft"),
        ("aft2pro",),
        # It emits `detected.stop` too; a fault is aimed at that of TR's After, since one kind stands for it.
        make=lambda setting: AssertAfter(setting.application().acceptable),
        checks_replies=True,
    ),
    links=(("before", "bfr2aft", "after"),),
    suitability=Suitability(detects=("implausible",), cpus=1, cpu_load="low", bandwidth="none"),
    adaptations_explored=False,
)

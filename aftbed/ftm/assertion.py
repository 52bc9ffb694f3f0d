"""Before and After of an executable assertion: no reply leaves that cannot be right.

The function's own check (`Application.acceptable`) sees a request beside its reply, and nothing else; so
Before hands the request to After past the computation. What is not acceptable ends the replica: a detected
stop. Under a duplex the other replica executes then, from the state before, or has executed already.

Limits: a wrong reply that is plausible passes. A wrong state passes until a reply shows it; TR compares both.
An empty reply is the Server's word for a request that the function refuses, and needs no check.
"""

from collections.abc import Callable
from enum import auto
from typing import Final

from aftbed.core.brick import Brick, BrickState, Effect, Halt, Note, Send, no_move
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.messages import AnyMessage, Rebound, Reply, Request, TakeOver

_BEFORE_OPEN: Final = ("pro2bfr",)
_EXIT: Final = Event.BEFORE_EXIT  # bound once: a look-up in an enumeration is slow on the hot path

Acceptable = Callable[[bytes, bytes], bool]  # request, reply


class AssertBefore(Brick):
    """Stateless."""

    def open_ports(self) -> tuple[str, ...]:
        """Always ready for a request."""
        return _BEFORE_OPEN

    def quiescent(self) -> bool:
        """Never holds one."""
        return True

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Pass a request on, both ways. A TakeOver goes one way: behind the replies."""
        if isinstance(msg, Request):
            return [Send("bfr2aft", msg), Note(_EXIT, msg.request_id), Send("bfr2prd", msg)]
        if isinstance(msg, TakeOver):
            return [Send("bfr2prd", msg)]
        if isinstance(msg, Rebound):
            return []
        raise PeerError(f"{type(msg).__name__} on {port}")


class AssertAfterState(BrickState):
    IDLE = auto()  # no reply held
    HOLDING = auto()  # a reply held, its request is in the channel from Before


MOVES: Final = {
    (AssertAfterState.IDLE, Reply): AssertAfterState.HOLDING,
    (AssertAfterState.IDLE, TakeOver): AssertAfterState.IDLE,
    (AssertAfterState.HOLDING, Request): AssertAfterState.IDLE,
}
OPEN: Final = {AssertAfterState.IDLE: ("prd2aft",), AssertAfterState.HOLDING: ("bfr2aft",)}


class AssertAfter(Brick):
    """`acceptable` is the function's own check."""

    def __init__(self, acceptable: Acceptable) -> None:
        self.state = AssertAfterState.IDLE
        self._acceptable = acceptable
        self._held: Reply | None = None

    def open_ports(self) -> tuple[str, ...]:
        """A reply, then its request, which was sent before."""
        return OPEN[self.state]

    def quiescent(self) -> bool:
        """No reply held."""
        return self.state is AssertAfterState.IDLE

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Handle one message; see MOVES."""
        state = MOVES.get((self.state, type(msg)))
        if state is None:
            return no_move(self.state, port, msg)
        if isinstance(msg, Reply):
            self.state, self._held = state, msg
            return []
        if isinstance(msg, TakeOver):
            return [Send("aft2pro", msg)]
        assert isinstance(msg, Request) and self._held is not None
        if msg.request_id != self._held.request_id:
            raise PeerError(f"request {msg.request_id} beside the reply to {self._held.request_id}")
        reply, self.state, self._held = self._held, state, None
        if not reply.payload or self._acceptable(msg.payload, reply.payload):
            return [Send("aft2pro", reply)]
        return [
            Note(Event.DETECTED_STOP, reply.request_id),
            Halt(f"reply to request {reply.request_id} is not acceptable"),
        ]

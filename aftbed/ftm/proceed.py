"""Proceed brick: has the Server compute, and hands the result to After (paper, III-A)."""

from enum import auto
from typing import Final

from aftbed.core.brick import Brick, BrickState, Effect, Note, Send, no_move
from aftbed.core.event import Event
from aftbed.core.message import AnyMessage, Reply, Request, TakeOver


class State(BrickState):
    IDLE = auto()  # no request in progress
    COMPUTING = auto()  # the Server has it


MOVES: Final = {
    (State.IDLE, Request): State.COMPUTING,
    (State.IDLE, TakeOver): State.IDLE,
    (State.COMPUTING, Reply): State.IDLE,
}
_ENTER: Final = Event.PROCEED_ENTER  # bound once: a look-up in an enumeration is slow on the hot path
OPEN: Final = {State.IDLE: ("bfr2prd",), State.COMPUTING: ("srv2prd",)}


class Compute(Brick):
    """One computation per request."""

    def __init__(self) -> None:
        self.state = State.IDLE

    def open_ports(self) -> tuple[str, ...]:
        """A request, then its result."""
        return OPEN[self.state]

    def quiescent(self) -> bool:
        """Nothing being computed."""
        return self.state is State.IDLE

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Have it computed, or hand on the result; a TakeOver goes behind the results of all before it."""
        state = MOVES.get((self.state, type(msg)))
        if state is None:
            return no_move(self.state, port, msg)
        self.state = state
        if isinstance(msg, Request):
            return [Note(_ENTER, msg.request_id), Send("prd2srv", msg)]
        assert isinstance(msg, Reply | TakeOver)
        return [Send("prd2aft", msg)]

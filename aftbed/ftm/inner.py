"""Protocol of an inner mechanism: the entry and the exit of what stands in the place of an outer Proceed.

Paper, III-B: to compose, the inner mechanism's Protocol-Before-Proceed-After takes the place of the outer
one's Proceed. To its neighbours this Protocol is that Proceed: a request in, its reply out. So it keeps no
log, since the outermost Protocol has one, and no epoch, since a failover changes that.

It admits one request at a time, also where the outer Before hands on several (a follower's does): inside,
capture and execution belong together. A TakeOver comes behind all requests and has to come out behind all
their replies; so it is admitted like a request, and while it is inside, nothing else is.
"""

from enum import auto
from typing import Final

from aftbed.core.brick import NO_REQUEST, Brick, BrickState, Effect, Send, no_move
from aftbed.core.errors import PeerError
from aftbed.core.message import AnyMessage, Reply, Request, TakeOver


class State(BrickState):
    IDLE = auto()  # nothing inside
    BUSY = auto()  # one request inside
    HANDING_ON = auto()  # a TakeOver inside


MOVES: Final = {
    (State.IDLE, Request): State.BUSY,
    (State.IDLE, TakeOver): State.HANDING_ON,
    (State.BUSY, Reply): State.IDLE,
    (State.HANDING_ON, TakeOver): State.IDLE,
}
OPEN: Final = {State.IDLE: ("pxy2pro",), State.BUSY: ("aft2pro",), State.HANDING_ON: ("aft2pro",)}


class InnerProtocol(Brick):
    """`busy_id` is the request inside, `epoch` the TakeOver's."""

    def __init__(self) -> None:
        self.state = State.IDLE
        self.busy_id, self.epoch = NO_REQUEST, 0

    def open_ports(self) -> tuple[str, ...]:
        """One in, then the same out."""
        return OPEN[self.state]

    def quiescent(self) -> bool:
        """Nothing inside."""
        return self.state is State.IDLE

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Let one in, or let out what came of it."""
        state = MOVES.get((self.state, type(msg)))
        if state is None:
            return no_move(self.state, port, msg)
        if isinstance(msg, Request):
            self.state, self.busy_id = state, msg.request_id
            return [Send("pro2bfr", msg)]
        if isinstance(msg, Reply):
            if msg.request_id != self.busy_id:
                raise PeerError(f"reply to request {msg.request_id}, expected {self.busy_id}")
            self.state = state
            return [Send("pro2pxy", msg)]
        assert isinstance(msg, TakeOver)
        if state is State.HANDING_ON:
            self.state, self.epoch = state, msg.epoch
            return [Send("pro2bfr", msg)]
        if msg.epoch != self.epoch:
            raise PeerError(f"take over under epoch {msg.epoch}, expected {self.epoch}")
        self.state = state
        return [Send("pro2pxy", msg)]

"""Proxy: the client's only way in; it knows who leads, and asks the new leader what is unanswered.

Paper, III-A. One request at a time is under way; the others wait in the client's channel, which costs
nothing, since a Protocol admits one at a time too. One master (G6) is enforced here: a reply under
another epoch than the one to which the Proxy is bound is refused, whoever sent it.
"""

from enum import auto
from typing import Final

from aftbed.core.brick import Brick, BrickState, Effect, Note, Send
from aftbed.core.errors import PeerError
from aftbed.core.event import Event
from aftbed.core.message import AnyMessage, Rebound, Reply, Request


class State(BrickState):
    UNBOUND = auto()  # nobody leads: requests wait in their channel
    IDLE = auto()  # bound, nothing under way
    WAITING = auto()  # a request is under way


OPEN: Final[dict[State, tuple[str, ...]]] = {
    State.UNBOUND: (),
    State.IDLE: ("clt2pxy",),
    State.WAITING: ("pro2pxy",),
}

# Bound once: a look-up in an enumeration is slow on the hot path.
_IDLE: Final = State.IDLE
_WAITING: Final = State.WAITING
_ACCEPTED: Final = Event.REPLY_ACCEPTED


class Proxy(Brick):
    """`waiting` is the request under way; it survives a change of leader, under the new epoch."""

    def __init__(self) -> None:
        self.state = State.UNBOUND
        self.epoch = 0
        self.waiting: Request | None = None

    def open_ports(self) -> tuple[str, ...]:
        """By state; see OPEN."""
        return OPEN[self.state]

    def quiescent(self) -> bool:
        """Nothing under way."""
        return self.waiting is None

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Pass a request on, a reply back, or go over to a new leader."""
        if isinstance(msg, Request) and self.state is _IDLE:
            self.state, self.waiting = _WAITING, Request(self.epoch, msg.request_id, msg.payload)
            return [Send("pxy2pro", self.waiting)]
        if isinstance(msg, Reply) and self.state is _WAITING:
            return self._reply(msg)
        if isinstance(msg, Rebound):
            return self._rebound(msg)
        raise PeerError(f"{type(msg).__name__} on {port} while {self.state.name}")

    def _reply(self, reply: Reply) -> list[Effect]:
        assert self.waiting is not None
        if reply.epoch != self.epoch:
            return [Note(Event.REPLY_REFUSED, reply.request_id, reply.epoch)]
        if reply.request_id != self.waiting.request_id:
            return []  # asked twice, over a failover or by a resending client: answered once
        self.state, self.waiting = _IDLE, None
        return [
            Note(_ACCEPTED, reply.request_id, reply.epoch << 8 | reply.replica),
            Send("pxy2clt", reply),
        ]

    def _rebound(self, msg: Rebound) -> list[Effect]:
        if msg.port != "pxy2pro":
            return []
        if not msg.bound:
            self.state, self.epoch = State.UNBOUND, 0
            return []
        if msg.epoch < self.epoch:
            raise PeerError(f"bound under epoch {msg.epoch} after {self.epoch}")
        self.epoch = msg.epoch
        if self.waiting is None:
            self.state = State.IDLE
            return []
        self.state = State.WAITING
        self.waiting = Request(msg.epoch, self.waiting.request_id, self.waiting.payload)
        return [Send("pxy2pro", self.waiting)]

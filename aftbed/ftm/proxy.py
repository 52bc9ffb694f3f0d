"""Proxy: the client's only way in; it knows who leads, and asks the new leader what is unanswered.

Paper, III-A. One master (G6) is enforced here: a reply under another epoch than the one to which the
Proxy is bound is refused, whoever sent it.
"""

from typing import Final

from aftbed.core.brick import Brick, Effect, Note, Send
from aftbed.core.errors import PeerError
from aftbed.core.event import Event
from aftbed.core.message import AnyMessage, Rebound, Reply, Request

BACKLOG_MAX: Final = 64
_OPEN: Final = ("clt2pxy", "pro2pxy")
_FULL: Final = ("pro2pxy",)


class Proxy(Brick):
    """`epoch` is 0 until the Proxy is bound to a leader: requests wait in their channel until then."""

    def __init__(self) -> None:
        self.epoch = 0
        self.unanswered: dict[int, Request] = {}

    def open_ports(self) -> tuple[str, ...]:
        """No new request without a leader, or while the backlog is full."""
        return _OPEN if self.epoch and len(self.unanswered) < BACKLOG_MAX else _FULL

    def quiescent(self) -> bool:
        """All is answered."""
        return not self.unanswered

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Pass a request on, a reply back, or go over to a new leader."""
        if isinstance(msg, Request):
            request = Request(self.epoch, msg.request_id, msg.payload)
            self.unanswered[msg.request_id] = request
            return [Send("pxy2pro", request)]
        if isinstance(msg, Reply):
            return self._reply(msg)
        if isinstance(msg, Rebound):
            return self._rebound(msg)
        raise PeerError(f"{type(msg).__name__} on {port}")

    def _reply(self, reply: Reply) -> list[Effect]:
        if reply.epoch != self.epoch:
            return [Note(Event.REPLY_REFUSED, reply.request_id, reply.epoch)]
        if self.unanswered.pop(reply.request_id, None) is None:
            return []  # asked twice, over a failover or by a resending client: answered once
        return [
            Note(Event.REPLY_ACCEPTED, reply.request_id, reply.epoch << 8 | reply.replica),
            Send("pxy2clt", reply),
        ]

    def _rebound(self, msg: Rebound) -> list[Effect]:
        if msg.port != "pxy2pro":
            return []
        if not msg.bound:
            self.epoch = 0
            return []
        if msg.epoch < self.epoch:
            raise PeerError(f"bound under epoch {msg.epoch} after {self.epoch}")
        self.epoch = msg.epoch
        self.unanswered = {i: Request(msg.epoch, i, r.payload) for i, r in sorted(self.unanswered.items())}
        return [Send("pxy2pro", request) for request in self.unanswered.values()]

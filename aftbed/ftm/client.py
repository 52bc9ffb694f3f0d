"""Client: numbers the requests, and asks again what is unanswered when its Proxy is replaced.

Paper, III-A: the client sends requests to the Proxy and knows nothing of replicas. The source of the
requests (the gateway of the car, or a load) hands them in on `submit` and takes replies from `deliver`.
"""

from typing import Final

import msgspec

from aftbed.core.brick import Brick, Effect, Note, Send
from aftbed.core.errors import PeerError
from aftbed.core.event import Event
from aftbed.core.message import AnyMessage, Rebound, Reply, Request, Submit

BACKLOG_MAX: Final = 64  # unanswered requests; beyond it the port `submit` is closed
_WAITING: Final = ("submit", "pxy2clt")
_FULL: Final = ("pxy2clt",)


class Client(Brick):
    """`next_id` is the id of the next request; `unanswered` maps ids to requests, ascending."""

    def __init__(self) -> None:
        self.next_id = 1
        self.unanswered: dict[int, Request] = {}
        self._again: frozenset[int] = frozenset()  # asked twice, by a predecessor perhaps: may come twice

    def open_ports(self) -> tuple[str, ...]:
        """No new request while the backlog is full."""
        return _WAITING if len(self.unanswered) < BACKLOG_MAX else _FULL

    def quiescent(self) -> bool:
        """All is answered."""
        return not self.unanswered

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Take a request from the source, a reply from the Proxy, or word that the Proxy is a new one."""
        if isinstance(msg, Submit) and len(self.unanswered) < BACKLOG_MAX:
            request = Request(0, self.next_id, msg.payload)
            self.unanswered[self.next_id] = request
            self.next_id += 1
            return [Note(Event.REQUEST_SENT, request.request_id), Send("clt2pxy", request)]
        if isinstance(msg, Reply):
            if self.unanswered.pop(msg.request_id, None) is None:
                if msg.request_id in self._again:
                    self._again -= {msg.request_id}
                    return []
                raise PeerError(f"reply to request {msg.request_id}, which is not unanswered")
            return [Note(Event.REPLY_DELIVERED, msg.request_id, msg.replica), Send("deliver", msg)]
        if isinstance(msg, Rebound):
            # Ascending ids on a fresh channel: the order of ids is the order of execution (G3).
            self._again = frozenset(self.unanswered)
            return [Send("clt2pxy", request) for request in self.unanswered.values()]
        raise PeerError(f"{type(msg).__name__} on {port}")

    def capture(self) -> bytes:
        """The ids and the unanswered requests."""
        return msgspec.msgpack.encode((self.next_id, list(self.unanswered.values())))

    def restore(self, state: bytes) -> None:
        """Go on where another Client ended."""
        try:
            next_id, waiting = msgspec.msgpack.decode(state, type=tuple[int, list[Request]])
        except msgspec.DecodeError as error:
            raise PeerError(f"not a state of a Client: {error}") from error
        self.next_id, self.unanswered = next_id, {r.request_id: r for r in waiting}

"""Client: numbers the requests, and asks again what is unanswered when its Proxy is replaced.

Paper, III-A: the client sends requests to the Proxy and knows nothing of replicas. The source of the
requests (the gateway of the car, or a load) hands them in on `submit` and takes replies from `deliver`.

The runtime can have the Client stop at requests of given ids (`HoldAt`): it reports such a request instead of
sending it, closes `submit`, and sends it when the runtime says `Release`. So an adaptation begins at an exact
request.
"""

from enum import auto
from typing import Final

import msgspec

from aftbed.core.brick import CONTROL, Brick, BrickState, Effect, Note, Send
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.messages import AnyMessage, HoldAt, Rebound, Release, Reply, Request, RequestHeld, Submit

BACKLOG_MAX: Final = 64  # unanswered requests; beyond it the port `submit` is closed
_WAITING: Final = ("submit", "pxy2clt")
_FULL: Final = ("pxy2clt",)


class Client(Brick):
    """`next_id` is the id of the next request; `unanswered` maps ids to requests, ascending."""

    def __init__(self) -> None:
        self.next_id = 1
        self.unanswered: dict[int, Request] = {}
        self._hold_at: frozenset[int] = frozenset()
        self._held: Request | None = None
        self._again: frozenset[int] = frozenset()  # asked twice, by a predecessor perhaps: may come twice

    def open_ports(self) -> tuple[str, ...]:
        """No new request while one is held, or the backlog is full."""
        return _WAITING if self._held is None and len(self.unanswered) < BACKLOG_MAX else _FULL

    def quiescent(self) -> bool:
        """All is answered."""
        return not self.unanswered

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """A request from the source, a reply from the Proxy, a new Proxy, or an order of the runtime."""
        if isinstance(msg, Submit) and self._held is None and len(self.unanswered) < BACKLOG_MAX:
            request = Request(0, self.next_id, msg.payload)
            self.unanswered[self.next_id] = request
            self.next_id += 1
            sent = Note(Event.REQUEST_SENT, request.request_id)
            if request.request_id in self._hold_at:
                self._held = request
                return [sent, Send(CONTROL, RequestHeld(request.request_id))]
            return [sent, Send("clt2pxy", request)]
        if isinstance(msg, Reply):
            if self.unanswered.pop(msg.request_id, None) is None:
                if msg.request_id in self._again:
                    self._again -= {msg.request_id}
                    return []
                raise PeerError(f"reply to request {msg.request_id}, which is not unanswered")
            return [Note(Event.REPLY_DELIVERED, msg.request_id, msg.replica), Send("deliver", msg)]
        if isinstance(msg, Rebound):
            # Ascending ids on a fresh channel: the order of ids is the order of execution (G3).
            sent_before = [request for request in self.unanswered.values() if request is not self._held]
            self._again = frozenset(request.request_id for request in sent_before)
            return [Send("clt2pxy", request) for request in sent_before]
        if isinstance(msg, HoldAt):
            self._hold_at = frozenset(msg.requests)
            # A successor of the Client that had come to them has sent them again by now.
            passed = [number for number in msg.requests if number < self.next_id]
            return [Send(CONTROL, RequestHeld(number)) for number in passed]
        if isinstance(msg, Release):
            held = self._held
            if held is None or held.request_id != msg.request_id:
                return []
            self._held = None
            return [Send("clt2pxy", held)]
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


# -- Proxy: the client's only way in; it knows who leads, and asks the new leader what is unanswered.
#
# Paper, III-A. One request at a time is under way; the others wait in the client's channel, which costs
# nothing, since a Protocol admits one at a time too. One master (G6) is enforced here: a reply under
# another epoch than the one to which the Proxy is bound is refused, whoever sent it.


class ProxyState(BrickState):
    UNBOUND = auto()  # nobody leads: requests wait in their channel
    IDLE = auto()  # bound, nothing under way
    WAITING = auto()  # a request is under way


PROXY_OPEN: Final[dict[ProxyState, tuple[str, ...]]] = {
    ProxyState.UNBOUND: (),
    ProxyState.IDLE: ("clt2pxy",),
    ProxyState.WAITING: ("pro2pxy",),
}

# Bound once: a look-up in an enumeration is slow on the hot path.
_IDLE: Final = ProxyState.IDLE
_ASKING: Final = ProxyState.WAITING
_ACCEPTED: Final = Event.REPLY_ACCEPTED


class Proxy(Brick):
    """`waiting` is the request under way; it survives a change of leader, under the new epoch."""

    def __init__(self) -> None:
        self.state = ProxyState.UNBOUND
        self.epoch = 0
        self.waiting: Request | None = None

    def open_ports(self) -> tuple[str, ...]:
        """By state; see OPEN."""
        return PROXY_OPEN[self.state]

    def quiescent(self) -> bool:
        """Nothing under way."""
        return self.waiting is None

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Pass a request on, a reply back, or go over to a new leader."""
        if isinstance(msg, Request) and self.state is _IDLE:
            self.state, self.waiting = _ASKING, Request(self.epoch, msg.request_id, msg.payload)
            return [Send("pxy2pro", self.waiting)]
        if isinstance(msg, Reply) and self.state is _ASKING:
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
            self.state, self.epoch = ProxyState.UNBOUND, 0
            return []
        if msg.epoch < self.epoch:
            raise PeerError(f"bound under epoch {msg.epoch} after {self.epoch}")
        self.epoch = msg.epoch
        if self.waiting is None:
            self.state = ProxyState.IDLE
            return []
        self.state = ProxyState.WAITING
        self.waiting = Request(msg.epoch, self.waiting.request_id, self.waiting.payload)
        return [Send("pxy2pro", self.waiting)]

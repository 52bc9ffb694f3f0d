"""Protocol: at most once. It admits one request at a time and remembers the replies it gave.

Paper, III-A: the entry of a replica. A request is a duplicate from its admission, not only from its
stored reply: what is admitted closes the port, so a resent one waits in its channel and then finds
the reply in the log. On the backup's side the log is filled by checkpoints; TakeOver, which comes in
the same channel behind the last of them, makes it the leader.
"""

from enum import auto
from typing import Final

import msgspec

from aftbed.core.brick import CONTROL, NO_REQUEST, Brick, BrickState, Effect, Note, Send, no_move
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.messages import AnyMessage, Promoted, Rebound, Reply, Request, StoreReply, TakeOver

REPLIES_KEPT: Final = 256  # at least the client's backlog: what can be asked again can be answered again


class ProtocolState(BrickState):
    BACKUP = auto()  # the log is filled by checkpoints; requests wait in their channel
    IDLE = auto()  # leading, no request inside
    BUSY = auto()  # leading, one request admitted


PROTOCOL_MOVES: Final = {
    (ProtocolState.BACKUP, StoreReply): ProtocolState.BACKUP,
    (ProtocolState.BACKUP, TakeOver): ProtocolState.IDLE,
    (ProtocolState.IDLE, Request): ProtocolState.BUSY,
    (ProtocolState.BUSY, Reply): ProtocolState.IDLE,
}
PROTOCOL_OPEN: Final = {
    ProtocolState.BACKUP: ("aft2pro",),
    ProtocolState.IDLE: ("pxy2pro",),
    ProtocolState.BUSY: ("aft2pro",),
}

# Bound once: a look-up in an enumeration is slow on the hot path.
_IDLE: Final = ProtocolState.IDLE
_BUSY: Final = ProtocolState.BUSY
_RECEIVED: Final = Event.REQUEST_RECEIVED
_STORED: Final = Event.REPLY_STORED
_SENT: Final = Event.REPLY_SENT


class Protocol(Brick):
    """`log` maps the ids of the last requests to their replies; `last_id` is the newest of them."""

    def __init__(self, replica: int, epoch: int, leads: bool) -> None:
        self.state = ProtocolState.IDLE if leads else ProtocolState.BACKUP
        self.replica, self.epoch = replica, epoch
        self.last_id, self.busy_id = 0, 0
        self.log: dict[int, bytes] = {}

    def open_ports(self) -> tuple[str, ...]:
        """One request at a time."""
        return PROTOCOL_OPEN[self.state]

    def quiescent(self) -> bool:
        """No request admitted."""
        return self.state is not ProtocolState.BUSY

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Admit, answer out of the log, store, or take over."""
        state = PROTOCOL_MOVES.get((self.state, type(msg)))
        if state is None:
            return no_move(self.state, port, msg)
        if isinstance(msg, Request):
            return self._admit(msg)
        if isinstance(msg, Reply):
            return self._answer(msg)
        if isinstance(msg, StoreReply):
            self._store(msg.request_id, msg.payload)
            return []
        assert isinstance(msg, TakeOver)
        if msg.epoch <= self.epoch:
            raise PeerError(f"take over under epoch {msg.epoch} after {self.epoch}")
        self.state, self.epoch = state, msg.epoch
        return [Note(Event.REPLICA_PROMOTED, detail=msg.epoch), Send(CONTROL, Promoted(msg.epoch))]

    def _admit(self, msg: Request) -> list[Effect]:
        if msg.epoch != self.epoch:
            raise PeerError(f"request {msg.request_id} under epoch {msg.epoch}, expected {self.epoch}")
        if msg.request_id > self.last_id:
            self.state, self.busy_id = _BUSY, msg.request_id
            return [Note(_RECEIVED, msg.request_id), Send("pro2bfr", msg)]
        stored = self.log.get(msg.request_id)
        if stored is None:
            raise PeerError(f"request {msg.request_id} is older than the {REPLIES_KEPT} replies kept")
        return [
            Note(Event.DEDUPE_HIT, msg.request_id),
            Send("pro2pxy", Reply(self.epoch, msg.request_id, self.replica, stored)),
        ]

    def _answer(self, msg: Reply) -> list[Effect]:
        if msg.request_id != self.busy_id:
            raise PeerError(f"reply to request {msg.request_id}, expected {self.busy_id}")
        self._store(msg.request_id, msg.payload)
        self.state = _IDLE
        return [Note(_STORED, msg.request_id), Send("pro2pxy", msg), Note(_SENT, msg.request_id)]

    def _store(self, request_id: int, payload: bytes) -> None:
        assert request_id > self.last_id, f"reply {request_id} stored after {self.last_id}"
        self.last_id = request_id
        self.log[request_id] = payload
        if len(self.log) > REPLIES_KEPT:
            del self.log[next(iter(self.log))]

    def capture(self) -> bytes:
        """The reply log."""
        return msgspec.msgpack.encode((self.last_id, list(self.log.items())))

    def restore(self, state: bytes) -> None:
        """Take over a reply log."""
        try:
            last_id, items = msgspec.msgpack.decode(state, type=tuple[int, list[tuple[int, bytes]]])
        except msgspec.DecodeError as error:
            raise PeerError(f"not a reply log: {error}") from error
        ids = [request_id for request_id, _ in items]
        if len(ids) > REPLIES_KEPT or ids != sorted(set(ids)) or max(ids, default=0) != last_id:
            raise PeerError(f"a reply log of {len(items)} replies, or out of order")
        self.last_id, self.log = last_id, dict(items)


# -- Before brick of PBR: passes the request on (paper, III-A: PBR does nothing before the computation).


_OPEN: Final = ("pro2bfr",)
_EXIT: Final = Event.BEFORE_EXIT  # bound once: a look-up in an enumeration is slow on the hot path


class PassBefore(Brick):
    """Stateless."""

    def open_ports(self) -> tuple[str, ...]:
        """Always ready for a request."""
        return _OPEN

    def quiescent(self) -> bool:
        """Never holds one."""
        return True

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Pass on a request, or that all behind it is led from here."""
        if isinstance(msg, Request):
            return [Note(_EXIT, msg.request_id), Send("bfr2prd", msg)]
        if isinstance(msg, TakeOver):
            return [Send("bfr2prd", msg)]
        if isinstance(msg, Rebound):
            return []
        raise PeerError(f"{type(msg).__name__} on {port}")


# -- Proceed brick: has the Server compute, and hands the result to After (paper, III-A).


class ComputeState(BrickState):
    IDLE = auto()  # no request in progress
    COMPUTING = auto()  # the Server has it


COMPUTE_MOVES: Final = {
    (ComputeState.IDLE, Request): ComputeState.COMPUTING,
    (ComputeState.IDLE, TakeOver): ComputeState.IDLE,
    (ComputeState.COMPUTING, Reply): ComputeState.IDLE,
}
_ENTER: Final = Event.PROCEED_ENTER  # bound once: a look-up in an enumeration is slow on the hot path
COMPUTE_OPEN: Final = {ComputeState.IDLE: ("bfr2prd",), ComputeState.COMPUTING: ("srv2prd",)}


class Compute(Brick):
    """One computation per request."""

    def __init__(self) -> None:
        self.state = ComputeState.IDLE

    def open_ports(self) -> tuple[str, ...]:
        """A request, then its result."""
        return COMPUTE_OPEN[self.state]

    def quiescent(self) -> bool:
        """Nothing being computed."""
        return self.state is ComputeState.IDLE

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Have it computed, or hand on the result; a TakeOver goes behind the results of all before it."""
        state = COMPUTE_MOVES.get((self.state, type(msg)))
        if state is None:
            return no_move(self.state, port, msg)
        self.state = state
        if isinstance(msg, Request):
            return [Note(_ENTER, msg.request_id), Send("prd2srv", msg)]
        assert isinstance(msg, Reply | TakeOver)
        return [Send("prd2aft", msg)]


# -- Protocol of an inner mechanism: the entry and the exit of what stands in the place of an outer Proceed.
#
# Paper, III-B: to compose, the inner mechanism's Protocol-Before-Proceed-After takes the place of the outer
# one's Proceed. To its neighbours this Protocol is that Proceed: a request in, its reply out. So it keeps no
# log, since the outermost Protocol has one, and no epoch, since a failover changes that.
#
# It admits one request at a time, also where the outer Before hands on several (a follower's does): inside,
# capture and execution belong together. A TakeOver comes behind all requests and has to come out behind all
# their replies; so it is admitted like a request, and while it is inside, nothing else is.


class InnerState(BrickState):
    IDLE = auto()  # nothing inside
    BUSY = auto()  # one request inside
    HANDING_ON = auto()  # a TakeOver inside


INNER_MOVES: Final = {
    (InnerState.IDLE, Request): InnerState.BUSY,
    (InnerState.IDLE, TakeOver): InnerState.HANDING_ON,
    (InnerState.BUSY, Reply): InnerState.IDLE,
    (InnerState.HANDING_ON, TakeOver): InnerState.IDLE,
}
INNER_OPEN: Final = {
    InnerState.IDLE: ("pxy2pro",),
    InnerState.BUSY: ("aft2pro",),
    InnerState.HANDING_ON: ("aft2pro",),
}


class InnerProtocol(Brick):
    """`busy_id` is the request inside, `epoch` the TakeOver's."""

    def __init__(self) -> None:
        self.state = InnerState.IDLE
        self.busy_id, self.epoch = NO_REQUEST, 0

    def open_ports(self) -> tuple[str, ...]:
        """One in, then the same out."""
        return INNER_OPEN[self.state]

    def quiescent(self) -> bool:
        """Nothing inside."""
        return self.state is InnerState.IDLE

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Let one in, or let out what came of it."""
        state = INNER_MOVES.get((self.state, type(msg)))
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
        if state is InnerState.HANDING_ON:
            self.state, self.epoch = state, msg.epoch
            return [Send("pro2bfr", msg)]
        if msg.epoch != self.epoch:
            raise PeerError(f"take over under epoch {msg.epoch}, expected {self.epoch}")
        self.state = state
        return [Send("pro2pxy", msg)]

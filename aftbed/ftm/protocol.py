"""Protocol: at most once. It admits one request at a time and remembers the replies it gave.

Paper, III-A: the entry of a replica. A request is a duplicate from its admission, not only from its
stored reply: what is admitted closes the port, so a resent one waits in its channel and then finds
the reply in the log. On the backup's side the log is filled by checkpoints; TakeOver, which comes in
the same channel behind the last of them, makes it the leader.
"""

from enum import auto
from typing import Final

import msgspec

from aftbed.core.brick import CONTROL, Brick, BrickState, Effect, Note, Send, no_move
from aftbed.core.errors import PeerError
from aftbed.core.event import Event
from aftbed.core.message import AnyMessage, Promoted, Reply, Request, StoreReply, TakeOver

REPLIES_KEPT: Final = 256  # at least the client's backlog: what can be asked again can be answered again


class State(BrickState):
    BACKUP = auto()  # the log is filled by checkpoints; requests wait in their channel
    IDLE = auto()  # leading, no request inside
    BUSY = auto()  # leading, one request admitted


MOVES: Final = {
    (State.BACKUP, StoreReply): State.BACKUP,
    (State.BACKUP, TakeOver): State.IDLE,
    (State.IDLE, Request): State.BUSY,
    (State.BUSY, Reply): State.IDLE,
}
OPEN: Final = {State.BACKUP: ("aft2pro",), State.IDLE: ("pxy2pro",), State.BUSY: ("aft2pro",)}

# Bound once: a look-up in an enumeration is slow on the hot path.
_IDLE: Final = State.IDLE
_BUSY: Final = State.BUSY
_RECEIVED: Final = Event.REQUEST_RECEIVED
_STORED: Final = Event.REPLY_STORED
_SENT: Final = Event.REPLY_SENT


class Protocol(Brick):
    """`log` maps the ids of the last requests to their replies; `last_id` is the newest of them."""

    def __init__(self, replica: int, epoch: int, leads: bool) -> None:
        self.state = State.IDLE if leads else State.BACKUP
        self.replica, self.epoch = replica, epoch
        self.last_id, self.busy_id = 0, 0
        self.log: dict[int, bytes] = {}

    def open_ports(self) -> tuple[str, ...]:
        """One request at a time."""
        return OPEN[self.state]

    def quiescent(self) -> bool:
        """No request admitted."""
        return self.state is not State.BUSY

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Admit, answer out of the log, store, or take over."""
        state = MOVES.get((self.state, type(msg)))
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

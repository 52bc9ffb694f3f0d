"""What every mechanism has: the Protocol of a replica, a Before that passes on, a Proceed that computes once,
and the Protocol of a mechanism inside another one.

Paper, III-A: a request meets Protocol, Before, Proceed, Server and After, and its reply leaves by the
Protocol. A mechanism brings its own Before, Proceed and After where it does something there.
"""

from enum import auto
from typing import Any, ClassVar, Final

import msgspec

from aftbed.core.brick import (
    CONTROL,
    NO_REQUEST,
    SAME_STATE,
    BrickAnswer,
    BrickState,
    Choice,
    Effect,
    Handler,
    Machine,
    Moves,
    Note,
    Send,
    hand_on,
)
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.messages import (
    ChannelEnded,
    Promoted,
    Promotion,
    Rebound,
    Reply,
    Request,
    StoreReply,
    TakeOver,
)
from aftbed.ftm.declaration import BrickKind, Emits

REPLIES_KEPT: Final = 256  # at least the client's backlog: what can be asked again can be answered again

# Bound once: a look-up in an enumeration is slow on the hot path.
_RECEIVED: Final = Event.REQUEST_RECEIVED
_STORED: Final = Event.REPLY_STORED
_SENT: Final = Event.REPLY_SENT
_BEFORE_EXIT: Final = Event.BEFORE_EXIT
_PROCEED_ENTER: Final = Event.PROCEED_ENTER


class ProtocolState(BrickState):
    BACKUP = auto()  # the log is filled by the leader; requests wait in their channel
    IDLE = auto()  # leading, no request inside
    BUSY = auto()  # leading, one request admitted


class RequestAge(BrickAnswer):
    NEW = auto()  # above all ids in the log
    OLD = auto()  # at most the newest id in the log


_NEW, _OLD = RequestAge.NEW, RequestAge.OLD


class Protocol(Machine):
    """At most once: admits one request at a time and remembers the replies that it gave.

    The entry of a replica. A request is a duplicate from its admission on, not only from its stored reply: an
    admitted request closes the port, so a repeated one waits in its channel and then finds its reply in the
    log. A backup's log is filled by its After. TakeOver comes in the same channel behind the last of them and
    makes this replica the leader.

    `log` maps the ids of the last requests to their replies; `last_id` is the newest of them.
    """

    AT_REST = (ProtocolState.BACKUP, ProtocolState.IDLE)

    def __init__(self, replica: int, epoch: int, leads: bool) -> None:
        super().__init__(ProtocolState.IDLE if leads else ProtocolState.BACKUP)
        self.replica, self.epoch = replica, epoch
        self.last_id, self.busy_id = 0, 0
        self.log: dict[int, bytes] = {}

    def age(self, msg: Request) -> RequestAge:
        """Raises PeerError if the request was sent under another epoch."""
        if msg.epoch != self.epoch:
            raise PeerError(f"request {msg.request_id} under epoch {msg.epoch}, expected {self.epoch}")
        return _NEW if msg.request_id > self.last_id else _OLD

    def admit(self, msg: Request) -> list[Effect]:
        """Let the request in; the port of requests closes."""
        self.busy_id = msg.request_id
        return [Note(_RECEIVED, msg.request_id), Send("pro2bfr", msg)]

    def answer_again(self, msg: Request) -> list[Effect]:
        """Answer out of the log: nothing is executed."""
        stored = self.log.get(msg.request_id)
        if stored is None:
            raise PeerError(f"request {msg.request_id} is older than the {REPLIES_KEPT} replies kept")
        return [
            Note(Event.DEDUPE_HIT, msg.request_id),
            Send("pro2pxy", Reply(self.epoch, msg.request_id, self.replica, stored)),
        ]

    def answer(self, msg: Reply) -> list[Effect]:
        """Store the reply, then send it."""
        if msg.request_id != self.busy_id:
            raise PeerError(f"reply to request {msg.request_id}, expected {self.busy_id}")
        self._store(msg.request_id, msg.payload)
        return [Note(_STORED, msg.request_id), Send("pro2pxy", msg), Note(_SENT, msg.request_id)]

    def store(self, msg: StoreReply) -> list[Effect]:
        """A backup's After has a reply that the leader gave, or will give."""
        self._store(msg.request_id, msg.payload)
        return []

    def take_over(self, msg: TakeOver) -> list[Effect]:
        """Lead from here on: all that the old leader may have answered is in the log."""
        if msg.epoch <= self.epoch:
            raise PeerError(f"take over under epoch {msg.epoch} after {self.epoch}")
        self.epoch = msg.epoch
        return [Note(Event.REPLICA_PROMOTED, detail=msg.epoch), Send(CONTROL, Promoted(msg.epoch))]

    def _store(self, request_id: int, payload: bytes) -> None:
        assert request_id > self.last_id, f"reply {request_id} stored after {self.last_id}"
        self.last_id = request_id
        self.log[request_id] = payload
        if len(self.log) > REPLIES_KEPT:
            del self.log[next(iter(self.log))]

    def capture(self) -> bytes:
        return msgspec.msgpack.encode((self.last_id, list(self.log.items())))

    def restore(self, state: bytes) -> None:
        try:
            last_id, items = msgspec.msgpack.decode(state, type=tuple[int, list[tuple[int, bytes]]])
        except msgspec.DecodeError as error:
            raise PeerError(f"not a reply log: {error}") from error
        ids = [request_id for request_id, _ in items]
        if len(ids) > REPLIES_KEPT or ids != sorted(set(ids)) or max(ids, default=0) != last_id:
            raise PeerError(f"a reply log of {len(items)} replies, or out of order")
        self.last_id, self.log = last_id, dict(items)

    MOVES: ClassVar[Moves] = {
        (ProtocolState.BACKUP, "aft2pro", StoreReply): (store, SAME_STATE),
        (ProtocolState.BACKUP, "aft2pro", TakeOver): (take_over, ProtocolState.IDLE),
        (ProtocolState.IDLE, "pxy2pro", Request): Choice(
            age,
            {
                RequestAge.NEW: (admit, ProtocolState.BUSY),
                RequestAge.OLD: (answer_again, SAME_STATE),
            },
        ),
        (ProtocolState.BUSY, "aft2pro", Reply): (answer, ProtocolState.IDLE),
    }


class PassState(BrickState):
    READY = auto()  # never holds a request


class PassBefore(Machine):
    """Before of a mechanism that does nothing ahead of the computation: passes requests on."""

    AT_REST = (PassState.READY,)

    def pass_on(self, msg: Request) -> list[Effect]:
        return [Note(_BEFORE_EXIT, msg.request_id), Send("bfr2prd", msg)]

    MOVES: ClassVar[Moves] = {
        (PassState.READY, "pro2bfr", Request): (pass_on, SAME_STATE),
        (PassState.READY, "pro2bfr", TakeOver): (hand_on("bfr2prd"), SAME_STATE),
    }


class ComputeState(BrickState):
    IDLE = auto()  # no request in progress
    COMPUTING = auto()  # the Server has it


class Compute(Machine):
    """Proceed that has the Server compute once, and hands the result to After (paper, III-A)."""

    AT_REST = (ComputeState.IDLE,)

    def compute(self, msg: Request) -> list[Effect]:
        return [Note(_PROCEED_ENTER, msg.request_id), Send("prd2srv", msg)]

    MOVES: ClassVar[Moves] = {
        (ComputeState.IDLE, "bfr2prd", Request): (compute, ComputeState.COMPUTING),
        (ComputeState.IDLE, "bfr2prd", TakeOver): (hand_on("prd2aft"), SAME_STATE),
        (ComputeState.COMPUTING, "srv2prd", Reply): (hand_on("prd2aft"), ComputeState.IDLE),
    }


class InnerState(BrickState):
    IDLE = auto()  # nothing inside
    BUSY = auto()  # one request inside
    HANDING_ON = auto()  # a TakeOver inside


class InnerProtocol(Machine):
    """Protocol of an inner mechanism: entry and exit of what stands in the place of an outer Proceed.

    Paper, III-B: to compose, the inner mechanism's Protocol-Before-Proceed-After takes the place of the outer
    one's Proceed. To its neighbours this Protocol is that Proceed: a request in, its reply out. So it keeps
    no log, since the outermost Protocol has one, and no epoch, since a failover changes that.

    It admits one request at a time, also where the outer Before hands on several (a follower's does): inside,
    capture and execution belong together. A TakeOver comes behind all requests and has to leave behind all
    their replies. So it is admitted like a request, and while it is inside, nothing else is.

    `busy_id` is the request inside, `epoch` that of the TakeOver inside.
    """

    AT_REST = (InnerState.IDLE,)

    def __init__(self) -> None:
        super().__init__()
        self.busy_id, self.epoch = NO_REQUEST, 0

    def admit(self, msg: Request) -> list[Effect]:
        """Let the request in; the port closes."""
        self.busy_id = msg.request_id
        return [Send("pro2bfr", msg)]

    def release(self, msg: Reply) -> list[Effect]:
        if msg.request_id != self.busy_id:
            raise PeerError(f"reply to request {msg.request_id}, expected {self.busy_id}")
        return [Send("pro2pxy", msg)]

    def admit_take_over(self, msg: TakeOver) -> list[Effect]:
        """Let the TakeOver in; the port closes."""
        self.epoch = msg.epoch
        return [Send("pro2bfr", msg)]

    def release_take_over(self, msg: TakeOver) -> list[Effect]:
        """It leaves behind all replies."""
        if msg.epoch != self.epoch:
            raise PeerError(f"take over under epoch {msg.epoch}, expected {self.epoch}")
        return [Send("pro2pxy", msg)]

    MOVES: ClassVar[Moves] = {
        (InnerState.IDLE, "pxy2pro", Request): (admit, InnerState.BUSY),
        (InnerState.IDLE, "pxy2pro", TakeOver): (admit_take_over, InnerState.HANDING_ON),
        (InnerState.BUSY, "aft2pro", Reply): (release, InnerState.IDLE),
        (InnerState.HANDING_ON, "aft2pro", TakeOver): (release_take_over, InnerState.IDLE),
    }


# -- handlers of the bricks through which a leader sends to its backup ----------------------------
#
# Such a brick has an `epoch`, knows whether it is `duplex` (there is a backup), and, once promoted, the
# `promote_epoch` to lead under. A promoted backup leads when the channel from its leader is drained.


def learn_duplex(port: str) -> Handler:
    """There is a backup while `port` is bound."""

    def learn_duplex(brick: Any, msg: Rebound) -> list[Effect]:
        if msg.port == port:
            brick.duplex = msg.bound
        return []

    return learn_duplex


def promote(brick: Any, msg: Promotion) -> list[Effect]:
    """Remember the epoch to lead under; the channel is still to be drained."""
    if msg.epoch <= brick.epoch:
        raise PeerError(f"promoted to epoch {msg.epoch} while {brick.state.name} in epoch {brick.epoch}")
    brick.promote_epoch = msg.epoch
    return []


def lead(port: str) -> Handler:
    """The channel is drained, and this replica is promoted: TakeOver goes behind all that came from there."""

    def lead(brick: Any, msg: ChannelEnded | Promotion) -> list[Effect]:
        brick.epoch, brick.promote_epoch, brick.duplex = brick.promote_epoch, 0, False
        return [Send(port, TakeOver(brick.epoch))]

    return lead


def promote_at_once(port: str) -> Handler:
    """The channel is drained already."""

    def promote_at_once(brick: Any, msg: Promotion) -> list[Effect]:
        return promote(brick, msg) + lead(port)(brick, msg)

    return promote_at_once


PROTOCOL: Final = BrickKind(
    "protocol",
    ("pxy2pro", "aft2pro"),
    ("pro2bfr", "pro2pxy"),
    make=lambda setting: Protocol(setting.replica, setting.epoch, setting.leads),
    events=(
        Emits(Event.REQUEST_RECEIVED),
        Emits(Event.REPLY_STORED),
        Emits(Event.REPLY_SENT),
        Emits(Event.DEDUPE_HIT),
    ),
    visits=(Event.REQUEST_RECEIVED, Event.REPLY_STORED),
)
INNER_PROTOCOL: Final = BrickKind(
    "inner.protocol",
    ("pxy2pro", "aft2pro"),
    ("pro2bfr", "pro2pxy"),
    make=lambda setting: InnerProtocol(),
)
PASS_BEFORE: Final = BrickKind(
    "pass.before",
    ("pro2bfr",),
    ("bfr2prd",),
    make=lambda setting: PassBefore(),
    events=(Emits(Event.BEFORE_EXIT),),
    visits=(Event.BEFORE_EXIT,),
)
COMPUTE: Final = BrickKind(
    "compute.proceed",
    ("bfr2prd", "srv2prd"),
    ("prd2srv", "prd2aft"),
    make=lambda setting: Compute(),
    events=(Emits(Event.PROCEED_ENTER),),
    visits=(Event.PROCEED_ENTER,),
    asks_server=1,
)

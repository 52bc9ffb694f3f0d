"""Client and Proxy: the two bricks in front of the replicas (paper, III-A)."""

from enum import auto
from typing import ClassVar, Final

import msgspec

from aftbed.core.brick import (
    ANY_STATE,
    CONTROL,
    SAME_STATE,
    BrickAnswer,
    BrickState,
    Choice,
    Effect,
    Machine,
    Moves,
    Note,
    Send,
    ignore,
)
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.messages import HoldAt, Rebound, Release, Reply, Request, RequestHeld, Submit
from aftbed.ftm.declaration import BrickKind, Emits

BACKLOG_MAX: Final = 64  # unanswered requests; beyond it the port `submit` is closed

# Bound once: a look-up in an enumeration is slow on the hot path.
_SENT: Final = Event.REQUEST_SENT
_DELIVERED: Final = Event.REPLY_DELIVERED
_ACCEPTED: Final = Event.REPLY_ACCEPTED


class ClientState(BrickState):
    READY = auto()  # takes the next request
    FULL = auto()  # the backlog is full: takes none before a reply
    HOLDING = auto()  # a request waits for its Release: takes none before that


class NextRequest(BrickAnswer):
    GOES = auto()
    FILLS_BACKLOG = auto()
    IS_HELD = auto()


class ReleaseOf(BrickAnswer):
    HELD = auto()  # of the request that is held
    HELD_AND_LAST = auto()  # the same, and the backlog is full
    OTHER = auto()


_C: Final = ClientState
_GOES: Final = NextRequest.GOES


class Client(Machine):
    """Numbers the requests, and sends the unanswered ones again when its Proxy is replaced.

    It knows nothing of replicas. The source of the requests (the gateway of the car, or a load) hands them in
    on `submit` and takes replies from `deliver`. The runtime can have it stop at requests of given ids
    (`HoldAt`): it reports such a request instead of sending it, closes `submit`, and sends it on `Release`.
    So an adaptation begins at an exact request.

    `next_id` is the id of the next request; `unanswered` maps ids to requests, ascending.
    """

    AT_REST = (_C.READY,)

    def __init__(self) -> None:
        super().__init__()
        self.next_id = 1
        self.unanswered: dict[int, Request] = {}
        self._hold_at: frozenset[int] = frozenset()
        self._held: Request | None = None
        # Sent twice, perhaps by a predecessor: two replies may come.
        self._again: frozenset[int] = frozenset()

    def quiescent(self) -> bool:
        return not self.unanswered

    def which_next(self, msg: Submit) -> NextRequest:
        if self.next_id in self._hold_at:
            return NextRequest.IS_HELD
        return NextRequest.FILLS_BACKLOG if len(self.unanswered) + 1 >= BACKLOG_MAX else _GOES

    def send(self, msg: Submit) -> list[Effect]:
        request = self._numbered(msg)
        return [Note(_SENT, request.request_id), Send("clt2pxy", request)]

    def hold(self, msg: Submit) -> list[Effect]:
        """The same, but the runtime decides when it goes."""
        request = self._held = self._numbered(msg)
        held = RequestHeld(request.request_id)
        return [Note(_SENT, request.request_id), Send(CONTROL, held)]

    def _numbered(self, msg: Submit) -> Request:
        request = self.unanswered[self.next_id] = Request(0, self.next_id, msg.payload)
        self.next_id += 1
        return request

    def is_first_reply(self, msg: Reply) -> bool:
        """False for the second reply to a request that was sent twice. Raises PeerError for any other."""
        if msg.request_id in self.unanswered:
            return True
        if msg.request_id in self._again:
            return False
        raise PeerError(f"reply to request {msg.request_id}, which is not unanswered")

    def deliver(self, msg: Reply) -> list[Effect]:
        del self.unanswered[msg.request_id]
        return [Note(_DELIVERED, msg.request_id, msg.replica), Send("deliver", msg)]

    def drop(self, msg: Reply) -> list[Effect]:
        """The source has it already."""
        self._again -= {msg.request_id}
        return []

    def send_again(self, msg: Rebound) -> list[Effect]:
        """The Proxy is a new one. Ascending ids: the order of ids is the order of execution (G3)."""
        if msg.port != "clt2pxy":
            return []
        sent_before = [request for request in self.unanswered.values() if request is not self._held]
        self._again = frozenset(request.request_id for request in sent_before)
        return [Send("clt2pxy", request) for request in sent_before]

    def hold_at(self, msg: HoldAt) -> list[Effect]:
        """A predecessor may have come to some of them: this Client has sent those again by now."""
        self._hold_at = frozenset(msg.requests)
        passed = [number for number in msg.requests if number < self.next_id]
        return [Send(CONTROL, RequestHeld(number)) for number in passed]

    def which_release(self, msg: Release) -> ReleaseOf:
        assert self._held is not None
        if msg.request_id != self._held.request_id:
            return ReleaseOf.OTHER
        return ReleaseOf.HELD_AND_LAST if len(self.unanswered) >= BACKLOG_MAX else ReleaseOf.HELD

    def send_held(self, msg: Release) -> list[Effect]:
        held, self._held = self._held, None
        assert held is not None
        return [Send("clt2pxy", held)]

    def capture(self) -> bytes:
        return msgspec.msgpack.encode((self.next_id, list(self.unanswered.values())))

    def restore(self, state: bytes) -> None:
        try:
            next_id, waiting = msgspec.msgpack.decode(state, type=tuple[int, list[Request]])
        except msgspec.DecodeError as error:
            raise PeerError(f"not a state of a Client: {error}") from error
        self.next_id, self.unanswered = next_id, {r.request_id: r for r in waiting}
        self.state = _C.FULL if len(waiting) >= BACKLOG_MAX else _C.READY

    MOVES: ClassVar[Moves] = {
        (_C.READY, "submit", Submit): Choice(
            which_next,
            {
                NextRequest.GOES: (send, SAME_STATE),
                NextRequest.FILLS_BACKLOG: (send, _C.FULL),
                NextRequest.IS_HELD: (hold, _C.HOLDING),
            },
        ),
        (_C.READY, "pxy2clt", Reply): Choice(
            is_first_reply, {True: (deliver, SAME_STATE), False: (drop, SAME_STATE)}
        ),
        (_C.FULL, "pxy2clt", Reply): Choice(
            is_first_reply, {True: (deliver, _C.READY), False: (drop, SAME_STATE)}
        ),
        (_C.HOLDING, "pxy2clt", Reply): Choice(
            is_first_reply, {True: (deliver, SAME_STATE), False: (drop, SAME_STATE)}
        ),
        (_C.HOLDING, CONTROL, Release): Choice(
            which_release,
            {
                ReleaseOf.HELD: (send_held, _C.READY),
                ReleaseOf.HELD_AND_LAST: (send_held, _C.FULL),
                ReleaseOf.OTHER: (ignore, SAME_STATE),
            },
        ),
        (ANY_STATE, CONTROL, Release): (ignore, SAME_STATE),  # it was sent already
        (ANY_STATE, CONTROL, HoldAt): (hold_at, SAME_STATE),
        (ANY_STATE, CONTROL, Rebound): (send_again, SAME_STATE),
    }


class ProxyState(BrickState):
    UNBOUND = auto()  # no replica leads: requests wait in their channel
    UNBOUND_WAITING = auto()  # no replica leads; the request under way goes to the next leader
    IDLE = auto()  # bound, nothing under way
    WAITING = auto()  # a request is under way


class ReplyIs(BrickAnswer):
    WANTED = auto()  # to the request under way, under the epoch of the leader
    OF_OTHER_EPOCH = auto()
    REPEATED = auto()  # to a request that was asked twice and answered before


class LeaderIs(BrickAnswer):
    BOUND = auto()
    UNBOUND = auto()
    UNCHANGED = auto()  # it is another port that was bound


_S: Final = ProxyState
_WANTED: Final = ReplyIs.WANTED


class Proxy(Machine):
    """The client's only way in: it knows which replica leads, and asks a new leader what is unanswered.

    Paper, III-A. One request at a time is under way; the others wait in the client's channel, which costs
    nothing, since a Protocol admits one at a time too. One master (G6) is enforced here: a reply under an
    epoch other than that to which the Proxy is bound is refused.

    `waiting` is the request under way; it survives a change of leader, under the new epoch.
    """

    AT_REST = (_S.UNBOUND, _S.IDLE)

    def __init__(self) -> None:
        super().__init__()
        self.epoch = 0
        self.waiting: Request | None = None

    def pass_on(self, msg: Request) -> list[Effect]:
        self.waiting = request = Request(self.epoch, msg.request_id, msg.payload)
        return [Send("pxy2pro", request)]

    def which_reply(self, msg: Reply) -> ReplyIs:
        waiting = self.waiting
        assert waiting is not None
        if msg.epoch != self.epoch:
            return ReplyIs.OF_OTHER_EPOCH
        return _WANTED if msg.request_id == waiting.request_id else ReplyIs.REPEATED

    def accept(self, msg: Reply) -> list[Effect]:
        """The one answer that the client gets."""
        self.waiting = None
        return [
            Note(_ACCEPTED, msg.request_id, msg.epoch << 8 | msg.replica),
            Send("pxy2clt", msg),
        ]

    def refuse(self, msg: Reply) -> list[Effect]:
        """Of a replica that does not lead, or no longer."""
        return [Note(Event.REPLY_REFUSED, msg.request_id, msg.epoch)]

    def drop(self, msg: Reply) -> list[Effect]:
        """Asked twice, over a failover or by a client that asks again: answered once."""
        return []

    def which_binding(self, msg: Rebound) -> LeaderIs:
        """Whether `pxy2pro` leads to a replica now. Raises PeerError if that leads under an older epoch."""
        if msg.port != "pxy2pro":
            return LeaderIs.UNCHANGED
        if not msg.bound:
            return LeaderIs.UNBOUND
        if msg.epoch < self.epoch:
            raise PeerError(f"bound under epoch {msg.epoch} after {self.epoch}")
        return LeaderIs.BOUND

    def bind(self, msg: Rebound) -> list[Effect]:
        self.epoch = msg.epoch
        return []

    def bind_then_ask_again(self, msg: Rebound) -> list[Effect]:
        """The request under way goes to this leader."""
        assert self.waiting is not None
        self.epoch = msg.epoch
        return self.pass_on(self.waiting)

    def unbind(self, msg: Rebound) -> list[Effect]:
        """No replica leads: a later one may have any epoch."""
        self.epoch = 0
        return []

    _REBOUND_AT_REST: ClassVar[Choice] = Choice(
        which_binding,
        {
            LeaderIs.BOUND: (bind, _S.IDLE),
            LeaderIs.UNBOUND: (unbind, _S.UNBOUND),
            LeaderIs.UNCHANGED: (ignore, SAME_STATE),
        },
    )
    _REBOUND_UNDER_WAY: ClassVar[Choice] = Choice(
        which_binding,
        {
            LeaderIs.BOUND: (bind_then_ask_again, _S.WAITING),
            LeaderIs.UNBOUND: (unbind, _S.UNBOUND_WAITING),
            LeaderIs.UNCHANGED: (ignore, SAME_STATE),
        },
    )
    MOVES: ClassVar[Moves] = {
        (_S.UNBOUND, CONTROL, Rebound): _REBOUND_AT_REST,
        (_S.UNBOUND_WAITING, CONTROL, Rebound): _REBOUND_UNDER_WAY,
        (_S.IDLE, "clt2pxy", Request): (pass_on, _S.WAITING),
        (_S.IDLE, CONTROL, Rebound): _REBOUND_AT_REST,
        (_S.WAITING, "pro2pxy", Reply): Choice(
            which_reply,
            {
                ReplyIs.WANTED: (accept, _S.IDLE),
                ReplyIs.OF_OTHER_EPOCH: (refuse, SAME_STATE),
                ReplyIs.REPEATED: (drop, SAME_STATE),
            },
        ),
        (_S.WAITING, CONTROL, Rebound): _REBOUND_UNDER_WAY,
    }


CLIENT: Final = BrickKind(
    "client",
    ("pxy2clt",),
    ("clt2pxy",),
    make=lambda setting: Client(),
    events=(Emits(Event.REQUEST_SENT), Emits(Event.REPLY_DELIVERED)),
    visits=(Event.REQUEST_SENT, Event.REPLY_DELIVERED),
)
PROXY: Final = BrickKind(
    "proxy",
    ("clt2pxy", "pro2pxy"),
    ("pxy2pro", "pxy2clt"),
    make=lambda setting: Proxy(),
    events=(Emits(Event.REPLY_ACCEPTED),),
    visits=(None, Event.REPLY_ACCEPTED),
)

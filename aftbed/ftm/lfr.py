"""Before and After of LFR: leader and follower both execute; only the leader answers.

Paper, III-A: the leader's Before forwards the request to the follower, and its After notifies the
follower of the reply, before the client has it. No state travels, so the function must be deterministic: the
notification carries a digest of the leader's reply, and a follower whose own differs says so. It goes on
with its own, since nobody can tell here which one is right.

| | leader | follower |
|-|--------|----------|
| Before | forwards, then passes on | takes what is forwarded, each in its turn |
| After | notifies, then replies | holds its own reply until it hears that the client has one |

What was forwarded is executed by whoever lives, and what was not forwarded was not executed: so a leader
that dies anywhere leaves no effect that its follower lacks. Promoted, a follower works off what was
forwarded, to the end of the channel. TakeOver goes behind that, through the whole chain; so by the time its
Protocol leads, the reply to every request that its leader may have answered is in the log.

Limit: while a follower is being replaced (by state transfer), the leader serves alone.
"""

from enum import auto
from hashlib import blake2b
from typing import Final

from aftbed.core.brick import Brick, BrickState, Effect, Note, Send
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.messages import (
    AnyMessage,
    ChannelEnded,
    Notification,
    Promote,
    Rebound,
    Reply,
    Request,
    StoreReply,
    TakeOver,
)

DIGEST_BYTES: Final = 16


def digest(payload: bytes) -> bytes:
    """What a follower compares its own reply with: BLAKE2b of `payload`, `DIGEST_BYTES` long."""
    return blake2b(payload, digest_size=DIGEST_BYTES).digest()


class LfrBeforeState(BrickState):
    LEADING = auto()  # requests come from the Protocol
    FOLLOWING = auto()  # requests come from the leader's Before


class LfrAfterState(BrickState):
    LEADING = auto()  # no reply is ever held
    FOLLOWING = auto()  # no reply held
    HOLDING = auto()  # an own reply held, until the leader's is known


BEFORE_MOVES: Final = {
    (LfrBeforeState.LEADING, Request): LfrBeforeState.LEADING,
    (LfrBeforeState.FOLLOWING, Request): LfrBeforeState.FOLLOWING,
    (LfrBeforeState.FOLLOWING, ChannelEnded): LfrBeforeState.FOLLOWING,
}
BEFORE_OPEN: Final = {LfrBeforeState.LEADING: ("pro2bfr",), LfrBeforeState.FOLLOWING: ("bfr2bfr",)}
AFTER_MOVES: Final = {
    (LfrAfterState.LEADING, Reply): LfrAfterState.LEADING,
    (LfrAfterState.FOLLOWING, Reply): LfrAfterState.HOLDING,  # or stored at once, where the leader is gone
    (LfrAfterState.FOLLOWING, TakeOver): LfrAfterState.LEADING,
    (LfrAfterState.HOLDING, Notification): LfrAfterState.FOLLOWING,
    (LfrAfterState.HOLDING, ChannelEnded): LfrAfterState.FOLLOWING,
}
AFTER_OPEN: Final = {
    LfrAfterState.LEADING: ("prd2aft",),
    LfrAfterState.FOLLOWING: ("prd2aft",),
    LfrAfterState.HOLDING: ("aft2aft",),
}

# Bound once: a look-up in an enumeration is slow on the hot path.
_BEFORE_LEADS: Final = LfrBeforeState.LEADING
_AFTER_LEADS: Final = LfrAfterState.LEADING
_FOLLOWING: Final = LfrAfterState.FOLLOWING
_HOLDING: Final = LfrAfterState.HOLDING
_FORWARDED: Final = Event.FOLLOWER_FORWARDED
_NOTIFIED: Final = Event.FOLLOWER_NOTIFIED
_EXIT: Final = Event.BEFORE_EXIT


class LfrBefore(Brick):
    """`duplex`: there is a follower to forward to."""

    def __init__(self, epoch: int, leads: bool) -> None:
        self.state = LfrBeforeState.LEADING if leads else LfrBeforeState.FOLLOWING
        self.epoch, self.duplex = epoch, False
        self.promote_epoch = 0  # not 0: lead under it as soon as the channel has ended
        self.ended = False

    def open_ports(self) -> tuple[str, ...]:
        """By state; see BEFORE_OPEN."""
        return BEFORE_OPEN[self.state]

    def quiescent(self) -> bool:
        """It never holds a request."""
        return True

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Handle one message; see BEFORE_MOVES and, for what the runtime says, `_told`."""
        if (self.state, type(msg)) not in BEFORE_MOVES:
            if isinstance(msg, Rebound | Promote):
                return self._told(msg)
            raise PeerError(f"{type(msg).__name__} on {port} while {self.state.name}")
        if isinstance(msg, Request):
            return self._forward(msg) if self.state is _BEFORE_LEADS else self._follow(msg)
        assert isinstance(msg, ChannelEnded)
        self.ended = True
        return self._take_over()

    def _forward(self, msg: Request) -> list[Effect]:
        passed_on: list[Effect] = [Note(_EXIT, msg.request_id), Send("bfr2prd", msg)]
        if not self.duplex:
            return passed_on
        # A crash between the two leaves a follower that executes what its leader did not. Swapped, the
        # leader could have executed and answered what nobody else ever heard of.
        return [Send("bfr2bfr", msg), Note(_FORWARDED, msg.request_id), *passed_on]

    def _follow(self, msg: Request) -> list[Effect]:
        if msg.epoch != self.epoch:
            raise PeerError(f"request {msg.request_id} under epoch {msg.epoch}, expected {self.epoch}")
        return [Note(_EXIT, msg.request_id), Send("bfr2prd", msg)]

    def _told(self, msg: Rebound | Promote) -> list[Effect]:
        if isinstance(msg, Rebound):
            if msg.port == "bfr2bfr":
                self.duplex = msg.bound
            return []
        if msg.epoch <= self.epoch or self.state is _BEFORE_LEADS:
            raise PeerError(f"promoted to epoch {msg.epoch} while {self.state.name} in epoch {self.epoch}")
        self.promote_epoch = msg.epoch
        return self._take_over()

    def _take_over(self) -> list[Effect]:
        if not self.promote_epoch or not self.ended:
            return []
        self.state, self.epoch = _BEFORE_LEADS, self.promote_epoch
        self.promote_epoch, self.duplex = 0, False
        return [Send("bfr2prd", TakeOver(self.epoch))]


class LfrAfter(Brick):
    """`duplex`: there is a follower to notify. `ended`: there is no leader to hear of any more."""

    def __init__(self, epoch: int, leads: bool) -> None:
        self.state = LfrAfterState.LEADING if leads else LfrAfterState.FOLLOWING
        self.epoch, self.duplex = epoch, False
        self.ended = False
        self._held: Reply | None = None

    def open_ports(self) -> tuple[str, ...]:
        """By state; see AFTER_OPEN. A notification waits in its channel until its reply is there."""
        return AFTER_OPEN[self.state]

    def quiescent(self) -> bool:
        """No reply held."""
        return self.state is not _HOLDING

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Handle one message; see AFTER_MOVES."""
        state = AFTER_MOVES.get((self.state, type(msg)))
        if state is None:
            if isinstance(msg, Rebound):
                return self._rebound(msg)
            raise PeerError(f"{type(msg).__name__} on {port} while {self.state.name}")
        if isinstance(msg, Reply):
            return self._notify(msg) if state is _AFTER_LEADS else self._hold(msg)
        if isinstance(msg, Notification):
            return self._compare(msg)
        if isinstance(msg, TakeOver):
            return self._take_over(msg)
        assert isinstance(msg, ChannelEnded)
        self.ended = True
        return self._store()

    def _notify(self, msg: Reply) -> list[Effect]:
        if not self.duplex:
            return [Send("aft2pro", msg)]
        # A crash between the two leaves a follower that has executed and heard all of it.
        return [
            Send("aft2aft", Notification(msg.epoch, msg.request_id, digest(msg.payload))),
            Note(_NOTIFIED, msg.request_id),
            Send("aft2pro", msg),
        ]

    def _hold(self, msg: Reply) -> list[Effect]:
        self.state, self._held = _HOLDING, msg
        return self._store() if self.ended else []

    def _compare(self, msg: Notification) -> list[Effect]:
        held = self._held
        assert held is not None
        if (msg.epoch, msg.request_id) != (self.epoch, held.request_id):
            raise PeerError(
                f"notified of request {msg.request_id} under epoch {msg.epoch},"
                f" expected {held.request_id} under {self.epoch}"
            )
        if msg.digest == digest(held.payload):
            return self._store()
        return [Note(Event.FOLLOWER_DIVERGED, held.request_id), *self._store()]

    def _store(self) -> list[Effect]:
        held, self.state, self._held = self._held, _FOLLOWING, None
        assert held is not None
        return [Send("aft2pro", StoreReply(held.epoch, held.request_id, held.payload))]

    def _take_over(self, msg: TakeOver) -> list[Effect]:
        if msg.epoch <= self.epoch:
            raise PeerError(f"take over under epoch {msg.epoch} after {self.epoch}")
        self.state, self.epoch = _AFTER_LEADS, msg.epoch
        self.duplex = False
        return [Send("aft2pro", msg)]

    def _rebound(self, msg: Rebound) -> list[Effect]:
        if msg.port == "aft2aft":
            self.duplex = msg.bound
        return []

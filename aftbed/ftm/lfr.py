"""LFR, leader-follower replication: both replicas execute, only the leader answers.

Paper, III-A: the leader's Before forwards the request to the follower, and its After notifies the follower of
the reply before the client has it. No state travels, so the function must be deterministic: the notification
carries a digest of the leader's reply, and a follower whose own reply differs records it. It goes on with its
own, since nothing shows which of the two is right.

| | leader | follower |
|-|--------|----------|
| Before | forwards, then passes on | takes what is forwarded, one request after the other |
| After | notifies, then replies | holds its own reply until it is notified of the leader's |

What was forwarded is executed by the replica that survives, and what was not forwarded was not executed. So a
leader that dies leaves no effect that its follower lacks. When a follower is promoted, it works off what was
forwarded, to the end of the channel. TakeOver goes behind that, through the whole chain. By the time the
follower's Protocol leads, the reply to every request that its leader may have answered is in the log.

Limit: while a follower is being replaced (by state transfer), the leader serves alone.
"""

from enum import auto
from typing import ClassVar, Final

from aftbed.core.brick import (
    ANY_STATE,
    CONTROL,
    SAME_STATE,
    BrickState,
    Effect,
    Machine,
    Moves,
    Note,
    Send,
    ignore,
)
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.messages import (
    ChannelEnded,
    Notification,
    Promotion,
    Rebound,
    Reply,
    Request,
    StoreReply,
    TakeOver,
)
from aftbed.ftm.chain import COMPUTE, lead, learn_duplex, promote, promote_at_once
from aftbed.ftm.declaration import BrickKind, Emits, Mechanism, Suitability

try:
    from _blake2 import blake2b  # that of hashlib, which loads OpenSSL beside it into each node
except ImportError:  # another Python than CPython
    from hashlib import blake2b

DIGEST_BYTES: Final = 16

# Bound once: a look-up in an enumeration is slow on the hot path.
_FORWARDED: Final = Event.FOLLOWER_FORWARDED
_NOTIFIED: Final = Event.FOLLOWER_NOTIFIED
_EXIT: Final = Event.BEFORE_EXIT


def digest(payload: bytes) -> bytes:
    """What a follower compares its own reply with: BLAKE2b of `payload`, `DIGEST_BYTES` long."""
    return blake2b(payload, digest_size=DIGEST_BYTES).digest()


class LfrBeforeState(BrickState):
    LEADING = auto()  # requests come from the Protocol
    FOLLOWING = auto()  # requests come from the leader's Before
    ENDED = auto()  # following, channel drained to its end: leads as soon as it is promoted
    PROMOTED = auto()  # following, leads as soon as its channel is drained


_B: Final = LfrBeforeState


class LfrBefore(Machine):
    """Never holds a request. `duplex`: there is a follower to forward to."""

    AT_REST = tuple(LfrBeforeState)

    def __init__(self, epoch: int, leads: bool) -> None:
        super().__init__(_B.LEADING if leads else _B.FOLLOWING)
        self.epoch, self.duplex = epoch, False
        self.promote_epoch = 0  # the epoch to lead under, once promoted

    def forward(self, msg: Request) -> list[Effect]:
        """The follower's copy first, then the leader's own chain."""
        passed_on: list[Effect] = [Note(_EXIT, msg.request_id), Send("bfr2prd", msg)]
        if not self.duplex:
            return passed_on
        # A crash between the two sends leaves a follower that executes what its leader did not. Swapped, the
        # leader could have executed and answered a request that the follower never got.
        return [Send("bfr2bfr", msg), Note(_FORWARDED, msg.request_id), *passed_on]

    def follow(self, msg: Request) -> list[Effect]:
        """Pass on what the leader has forwarded."""
        if msg.epoch != self.epoch:
            raise PeerError(f"request {msg.request_id} under epoch {msg.epoch}, expected {self.epoch}")
        return [Note(_EXIT, msg.request_id), Send("bfr2prd", msg)]

    MOVES: ClassVar[Moves] = {
        (_B.LEADING, "pro2bfr", Request): (forward, SAME_STATE),
        (_B.FOLLOWING, "bfr2bfr", Request): (follow, SAME_STATE),
        (_B.FOLLOWING, "bfr2bfr", ChannelEnded): (ignore, _B.ENDED),
        (_B.FOLLOWING, CONTROL, Promotion): (promote, _B.PROMOTED),
        (_B.PROMOTED, "bfr2bfr", Request): (follow, SAME_STATE),
        (_B.PROMOTED, "bfr2bfr", ChannelEnded): (lead("bfr2prd"), _B.LEADING),
        (_B.PROMOTED, CONTROL, Promotion): (promote, SAME_STATE),
        (_B.ENDED, CONTROL, Promotion): (promote_at_once("bfr2prd"), _B.LEADING),
        (_B.ENDED, "bfr2bfr", Request): (follow, _B.FOLLOWING),  # another channel was bound since
        (_B.ENDED, "bfr2bfr", ChannelEnded): (ignore, SAME_STATE),
        (ANY_STATE, CONTROL, Rebound): (learn_duplex("bfr2bfr"), SAME_STATE),
    }


class LfrAfterState(BrickState):
    LEADING = auto()  # holds no reply, ever
    FOLLOWING = auto()  # no reply held
    HOLDING = auto()  # own reply held, until the leader's is known
    ALONE = auto()  # the leader is gone: an own reply is stored at once


_A: Final = LfrAfterState


class LfrAfter(Machine):
    """`duplex`: there is a follower to notify. A notification waits in its channel for the own reply."""

    AT_REST = (_A.LEADING, _A.FOLLOWING, _A.ALONE)

    def __init__(self, epoch: int, leads: bool) -> None:
        super().__init__(_A.LEADING if leads else _A.FOLLOWING)
        self.epoch, self.duplex = epoch, False
        self._held: Reply | None = None

    def notify_then_reply(self, msg: Reply) -> list[Effect]:
        """The follower knows of the reply before the client has it."""
        if not self.duplex:
            return [Send("aft2pro", msg)]
        # A crash between the two sends leaves a follower that has the reply to everything executed.
        return [
            Send("aft2aft", Notification(msg.epoch, msg.request_id, digest(msg.payload))),
            Note(_NOTIFIED, msg.request_id),
            Send("aft2pro", msg),
        ]

    def hold(self, msg: Reply) -> list[Effect]:
        self._held = msg
        return []

    def compare_then_store(self, msg: Notification) -> list[Effect]:
        """Record a difference; the own reply is stored in any case."""
        held = self._held
        assert held is not None
        if (msg.epoch, msg.request_id) != (self.epoch, held.request_id):
            raise PeerError(
                f"notified of request {msg.request_id} under epoch {msg.epoch},"
                f" expected {held.request_id} under {self.epoch}"
            )
        self._held = None
        if msg.digest == digest(held.payload):
            return self.store(held)
        return [Note(Event.FOLLOWER_DIVERGED, held.request_id), *self.store(held)]

    def store_held(self, msg: ChannelEnded) -> list[Effect]:
        """No notification will come: the leader is gone."""
        held, self._held = self._held, None
        assert held is not None
        return self.store(held)

    def store(self, msg: Reply) -> list[Effect]:
        """Hand the own reply to the Protocol's log."""
        return [Send("aft2pro", StoreReply(msg.epoch, msg.request_id, msg.payload))]

    def take_over(self, msg: TakeOver) -> list[Effect]:
        """Lead from here on: all replies before this are in the log."""
        if msg.epoch <= self.epoch:
            raise PeerError(f"take over under epoch {msg.epoch} after {self.epoch}")
        self.epoch, self.duplex = msg.epoch, False
        return [Send("aft2pro", msg)]

    MOVES: ClassVar[Moves] = {
        (_A.LEADING, "prd2aft", Reply): (notify_then_reply, SAME_STATE),
        (_A.FOLLOWING, "prd2aft", Reply): (hold, _A.HOLDING),
        (_A.FOLLOWING, "prd2aft", TakeOver): (take_over, _A.LEADING),
        (_A.HOLDING, "aft2aft", Notification): (compare_then_store, _A.FOLLOWING),
        (_A.HOLDING, "aft2aft", ChannelEnded): (store_held, _A.ALONE),
        (_A.ALONE, "prd2aft", Reply): (store, SAME_STATE),
        (_A.ALONE, "prd2aft", TakeOver): (take_over, _A.LEADING),
        (ANY_STATE, CONTROL, Rebound): (learn_duplex("aft2aft"), SAME_STATE),
    }


LFR: Final = Mechanism(
    name="lfr",
    before=BrickKind(
        "lfr.before",
        ("pro2bfr", "bfr2bfr"),
        ("bfr2prd", "bfr2bfr"),
        ("bfr2bfr",),
        make=lambda setting: LfrBefore(setting.epoch, setting.leads),
        events=(Emits(Event.BEFORE_EXIT), Emits(Event.FOLLOWER_FORWARDED)),
        visits=(Event.BEFORE_EXIT,),
        sends_beside=True,
        backup_executes=True,
    ),
    proceed=COMPUTE,
    after=BrickKind(
        "lfr.after",
        ("prd2aft", "aft2aft"),
        ("aft2pro", "aft2aft"),
        ("aft2aft",),
        make=lambda setting: LfrAfter(setting.epoch, setting.leads),
        events=(Emits(Event.FOLLOWER_NOTIFIED), Emits(Event.FOLLOWER_DIVERGED, of_backup=True)),
        visits=(Event.FOLLOWER_NOTIFIED,),
        sends_beside=True,
    ),
    replication=(("before", "bfr2bfr"), ("after", "aft2aft")),
    suitability=Suitability(
        tolerates=("crash",),
        deterministic="two replicas execute every request",
        cpus=2,
        cpu_load="high",
        bandwidth="low",
    ),
)

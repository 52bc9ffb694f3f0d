"""PBR, primary-backup replication: the backup owns the reply before the client does.

Paper, III-A: After takes the result from Proceed, captures the Server's state, and sends a checkpoint to the
After of the backup replica, which applies it. Of a large state, what changed since the checkpoint before is
captured and sent (`pages`). Without a backup (it died, the new one is not ready) the
primary serves alone, and the state that it captures goes nowhere.

A backup applies one checkpoint at a time: the next one waits in the channel, which outlives the primary. When
the backup is promoted, it drains that channel to its end, and only then lets its Protocol lead.
"""

from enum import auto
from typing import ClassVar, Final

from aftbed.core.brick import (
    ANY_STATE,
    CONTROL,
    NO_REQUEST,
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
    CaptureState,
    ChannelEnded,
    Checkpoint,
    Promotion,
    Rebound,
    Reply,
    RestoreState,
    StateCaptured,
    StateRestored,
    StoreReply,
)
from aftbed.ftm.chain import COMPUTE, PASS_BEFORE, lead, promote, promote_at_once
from aftbed.ftm.declaration import BrickKind, Emits, Mechanism, Suitability


class PbrAfterState(BrickState):
    IDLE = auto()  # leading, no request in progress
    CAPTURING = auto()  # leading, reply held, waiting for the Server's state
    STANDBY = auto()  # backup, waiting for a checkpoint
    APPLYING = auto()  # backup, checkpoint held, waiting for the Server to restore it
    ENDED = auto()  # backup whose channel is drained to its end: leads as soon as it is promoted
    PROMOTED = auto()  # backup that leads as soon as its channel is drained
    PROMOTED_APPLYING = auto()  # the same, with a checkpoint held


_S: Final = PbrAfterState
# Bound once: a look-up in an enumeration is slow on the hot path.
_SENT: Final = Event.CHECKPOINT_SENT
_APPLIED: Final = Event.CHECKPOINT_APPLIED


class PbrAfter(Machine):
    """`duplex`: there is a backup to send checkpoints to; `base`: the last one that was sent to it, or 0."""

    AT_REST = (_S.IDLE, _S.STANDBY, _S.ENDED, _S.PROMOTED)

    def __init__(self, epoch: int, leads: bool) -> None:
        super().__init__(_S.IDLE if leads else _S.STANDBY)
        self.epoch, self.duplex, self.base = epoch, False, NO_REQUEST
        self.promote_epoch = 0  # the epoch to lead under, once promoted
        self._reply: Reply | None = None
        self._checkpoint: Checkpoint | None = None

    # -- the primary --------------------------------------------------------------------------

    def hold_reply(self, msg: Reply) -> list[Effect]:
        """Ask the Server for the state that goes with the reply."""
        self._reply = msg
        return [Send("aft2srv", CaptureState(msg.epoch, msg.request_id, self.base))]

    def checkpoint_then_reply(self, msg: StateCaptured) -> list[Effect]:
        """The backup's copy first, then the client's."""
        reply = self._reply
        assert reply is not None
        if msg.request_id != reply.request_id:
            raise PeerError(f"state of request {msg.request_id}, expected {reply.request_id}")
        self._reply = None
        if not self.duplex:
            return [Send("aft2pro", reply)]
        self.base = reply.request_id
        # A crash between the two sends leaves a backup that can repeat the reply. Swapped, the client could
        # hold a reply that the backup never knew.
        return [
            Send("aft2aft", Checkpoint(reply.epoch, reply.request_id, reply.payload, msg.state)),
            Note(_SENT, reply.request_id),
            Send("aft2pro", reply),
        ]

    def learn_backup(self, msg: Rebound) -> list[Effect]:
        """There is a backup while `aft2aft` is bound. One that has just been bound has no checkpoint."""
        if msg.port == "aft2aft":
            self.duplex, self.base = msg.bound, NO_REQUEST
        return []

    # -- the backup ---------------------------------------------------------------------------

    def apply(self, msg: Checkpoint) -> list[Effect]:
        """Have the Server restore the state of the checkpoint."""
        if msg.epoch != self.epoch:
            raise PeerError(f"checkpoint {msg.request_id} under epoch {msg.epoch}, expected {self.epoch}")
        self._checkpoint = msg
        return [Send("aft2srv", RestoreState(msg.epoch, msg.request_id, msg.state))]

    def store_reply(self, msg: StateRestored) -> list[Effect]:
        """The state is applied: the Protocol may know the reply that goes with it."""
        held = self._checkpoint
        assert held is not None
        if msg.request_id != held.request_id:
            raise PeerError(f"restored {msg.request_id}, expected {held.request_id}")
        self._checkpoint = None
        return [
            Note(_APPLIED, held.request_id),
            Send("aft2pro", StoreReply(held.epoch, held.request_id, held.reply)),
        ]

    MOVES: ClassVar[Moves] = {
        (_S.IDLE, "prd2aft", Reply): (hold_reply, _S.CAPTURING),
        (_S.CAPTURING, "srv2aft", StateCaptured): (checkpoint_then_reply, _S.IDLE),
        (_S.STANDBY, "aft2aft", Checkpoint): (apply, _S.APPLYING),
        (_S.STANDBY, "aft2aft", ChannelEnded): (ignore, _S.ENDED),
        (_S.STANDBY, CONTROL, Promotion): (promote, _S.PROMOTED),
        (_S.APPLYING, "srv2aft", StateRestored): (store_reply, _S.STANDBY),
        (_S.APPLYING, CONTROL, Promotion): (promote, _S.PROMOTED_APPLYING),
        (_S.PROMOTED, "aft2aft", Checkpoint): (apply, _S.PROMOTED_APPLYING),
        (_S.PROMOTED, "aft2aft", ChannelEnded): (lead("aft2pro"), _S.IDLE),
        (_S.PROMOTED, CONTROL, Promotion): (promote, SAME_STATE),
        (_S.PROMOTED_APPLYING, "srv2aft", StateRestored): (store_reply, _S.PROMOTED),
        (_S.PROMOTED_APPLYING, CONTROL, Promotion): (promote, SAME_STATE),
        (_S.ENDED, CONTROL, Promotion): (promote_at_once("aft2pro"), _S.IDLE),
        (_S.ENDED, "aft2aft", Checkpoint): (apply, _S.APPLYING),  # another channel was bound since
        (_S.ENDED, "aft2aft", ChannelEnded): (ignore, SAME_STATE),
        (ANY_STATE, CONTROL, Rebound): (learn_backup, SAME_STATE),
    }


PBR: Final = Mechanism(
    name="pbr",
    before=PASS_BEFORE,
    proceed=COMPUTE,
    after=BrickKind(
        "pbr.after",
        ("prd2aft", "srv2aft", "aft2aft"),
        ("aft2srv", "aft2pro", "aft2aft"),
        ("aft2aft",),
        make=lambda setting: PbrAfter(setting.epoch, setting.leads),
        events=(
            Emits(Event.STATE_CAPTURED, by_server=True),
            Emits(Event.CHECKPOINT_SENT),
            Emits(Event.CHECKPOINT_APPLIED, of_backup=True),
            Emits(Event.STATE_RESTORED, of_backup=True, by_server=True),
        ),
        visits=(None, Event.CHECKPOINT_SENT),
        asks_server=1,
        sends_beside=True,
    ),
    links=(("after", "aft2srv", "server"), ("server", "srv2aft", "after")),
    replication=(("after", "aft2aft"),),
    suitability=Suitability(
        tolerates=("crash",),
        state_access="each checkpoint carries the whole state to the backup",
        cpus=2,
        cpu_load="low",
        bandwidth="high",
    ),
)

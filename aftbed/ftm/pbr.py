"""After brick of PBR: the backup owns the reply before the client does.

Paper, III-A: After takes the result from Proceed, captures the Server's state, and sends a checkpoint
to the After of the backup replica; there it is applied. Without a backup (it died, the new one is not
ready) the primary serves alone, and the state that it captures goes nowhere.

A backup applies one checkpoint at a time: the next waits in the channel, which outlives the primary.
Told to take over, it drains that channel to its end, and only then lets its Protocol lead.
"""

from enum import auto
from typing import Final

from aftbed.core.brick import Brick, BrickState, Effect, Note, Send
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.messages import (
    AnyMessage,
    CaptureState,
    ChannelEnded,
    Checkpoint,
    Promote,
    Rebound,
    Reply,
    RestoreState,
    StateCaptured,
    StateRestored,
    StoreReply,
    TakeOver,
)


class PbrAfterState(BrickState):
    IDLE = auto()  # leading, no request in progress
    CAPTURING = auto()  # leading, reply held, waiting for the Server's state
    STANDBY = auto()  # backup, waiting for a checkpoint
    APPLYING = auto()  # backup, checkpoint held, waiting for the Server to restore it


MOVES: Final = {
    (PbrAfterState.IDLE, Reply): PbrAfterState.CAPTURING,
    (PbrAfterState.CAPTURING, StateCaptured): PbrAfterState.IDLE,
    (PbrAfterState.STANDBY, Checkpoint): PbrAfterState.APPLYING,
    (PbrAfterState.STANDBY, ChannelEnded): PbrAfterState.STANDBY,
    (PbrAfterState.APPLYING, StateRestored): PbrAfterState.STANDBY,
}
OPEN: Final = {
    PbrAfterState.IDLE: ("prd2aft",),
    PbrAfterState.CAPTURING: ("srv2aft",),
    PbrAfterState.STANDBY: ("aft2aft",),
    PbrAfterState.APPLYING: ("srv2aft",),
}

# Bound once: a look-up in an enumeration is slow on the hot path.
_IDLE: Final = PbrAfterState.IDLE
_CAPTURING: Final = PbrAfterState.CAPTURING
_SENT: Final = Event.CHECKPOINT_SENT


class PbrAfter(Brick):
    """`duplex`: there is a backup to send checkpoints to."""

    def __init__(self, epoch: int, leads: bool) -> None:
        self.state = PbrAfterState.IDLE if leads else PbrAfterState.STANDBY
        self.epoch, self.duplex = epoch, False
        self.promote_epoch = 0  # not 0: lead under it as soon as the channel has ended
        self.ended = False
        self._reply: Reply | None = None
        self._checkpoint: Checkpoint | None = None

    def open_ports(self) -> tuple[str, ...]:
        """By state; see OPEN."""
        return OPEN[self.state]

    def quiescent(self) -> bool:
        """No reply held, no checkpoint half applied."""
        return self.state in (PbrAfterState.IDLE, PbrAfterState.STANDBY)

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Handle one message; see MOVES and, for what the runtime says, `_told`."""
        if (self.state, type(msg)) not in MOVES:
            if isinstance(msg, (Rebound, Promote)):
                return self._told(msg)
            raise PeerError(f"{type(msg).__name__} on {port} while {self.state.name}")
        if isinstance(msg, Reply):
            return self._capture(msg)
        if isinstance(msg, StateCaptured):
            return self._checkpoint_and_reply(msg)
        if isinstance(msg, Checkpoint):
            return self._apply(msg)
        if isinstance(msg, StateRestored):
            return self._applied(msg)
        assert isinstance(msg, ChannelEnded)
        self.ended = True
        return self._take_over()

    def _capture(self, msg: Reply) -> list[Effect]:
        self.state, self._reply = _CAPTURING, msg
        return [Send("aft2srv", CaptureState(msg.epoch, msg.request_id))]

    def _checkpoint_and_reply(self, msg: StateCaptured) -> list[Effect]:
        assert self._reply is not None
        if msg.request_id != self._reply.request_id:
            raise PeerError(f"state of request {msg.request_id}, expected {self._reply.request_id}")
        reply, self.state, self._reply = self._reply, _IDLE, None
        if not self.duplex:
            return [Send("aft2pro", reply)]
        # A crash between these two leaves a backup that can repeat the reply. Swapped, the client
        # could hold a reply that the backup never knew.
        return [
            Send("aft2aft", Checkpoint(reply.epoch, reply.request_id, reply.payload, msg.state)),
            Note(_SENT, reply.request_id),
            Send("aft2pro", reply),
        ]

    def _apply(self, msg: Checkpoint) -> list[Effect]:
        if msg.epoch != self.epoch:
            raise PeerError(f"checkpoint {msg.request_id} under epoch {msg.epoch}, expected {self.epoch}")
        self.state, self._checkpoint = PbrAfterState.APPLYING, msg
        return [Send("aft2srv", RestoreState(msg.epoch, msg.request_id, msg.state))]

    def _applied(self, msg: StateRestored) -> list[Effect]:
        held = self._checkpoint
        assert held is not None
        if msg.request_id != held.request_id:
            raise PeerError(f"restored {msg.request_id}, expected {held.request_id}")
        self.state, self._checkpoint = PbrAfterState.STANDBY, None
        return [
            Note(Event.CHECKPOINT_APPLIED, held.request_id),
            Send("aft2pro", StoreReply(held.epoch, held.request_id, held.reply)),
        ]

    def _told(self, msg: Rebound | Promote) -> list[Effect]:
        if isinstance(msg, Rebound):
            if msg.port == "aft2aft":
                self.duplex = msg.bound
            return []
        if msg.epoch <= self.epoch or self.state in (PbrAfterState.IDLE, PbrAfterState.CAPTURING):
            raise PeerError(f"promoted to epoch {msg.epoch} while {self.state.name} in epoch {self.epoch}")
        self.promote_epoch = msg.epoch
        return self._take_over()

    def _take_over(self) -> list[Effect]:
        if not self.promote_epoch or not self.ended or self.state is not PbrAfterState.STANDBY:
            return []
        self.state, self.epoch = PbrAfterState.IDLE, self.promote_epoch
        self.promote_epoch, self.duplex = 0, False
        return [Send("aft2pro", TakeOver(self.epoch))]

"""Server: the protected function behind four messages: execute, try, capture, restore (paper, III-A).

State access is the A of FT/A/R that PBR and TR need. The function is a stranger: bytes in, bytes out. So is
the mechanism: a Server learns what will be asked of it from where its outputs lead, which it is told. So a
switch to another mechanism never exchanges it.

| `srv2aft` leads | `srv2bfr` leads | as under    | open for                                             |
|-----------------|-----------------|-------------|------------------------------------------------------|
| nowhere         | nowhere         | lfr, assert | requests                                             |
| to an After     | nowhere         | pbr         | a request, then the question for the state after it  |
| nowhere         | to a Before     | tr          | trials, and the question for the state before them   |
| to an After     | to a Before     | pbr+tr      | all of these                                         |

Nearly always one port is open, in which a host can block; to wait for two costs it a poll. After a rerun
nothing here tells which one is next: a vote takes two trials, or three.
"""

from enum import auto
from typing import Final

from aftbed.core.application import Application
from aftbed.core.brick import Brick, BrickState, Effect, Halt, Note, Send
from aftbed.core.errors import PeerError
from aftbed.core.events import RERUN, Event
from aftbed.core.messages import (
    AnyMessage,
    CaptureState,
    Rebound,
    Reply,
    Request,
    RestoreState,
    StateCaptured,
    StateRestored,
    Trial,
    Tried,
)


class ServerState(BrickState):
    STANDBY = auto()  # a backup's or a leader's: the first request decides
    READY = auto()  # for a request
    TRYING = auto()  # under tr: Before has the state, trials follow, up to a rerun
    EXECUTED = auto()  # After will ask for the state after it


MOVES: Final = {  # where After does not ask for the state, what leads to EXECUTED leads to READY
    ("prd2srv", ServerState.STANDBY, Request): ServerState.EXECUTED,
    ("prd2srv", ServerState.STANDBY, Trial): ServerState.EXECUTED,
    ("prd2srv", ServerState.READY, Request): ServerState.EXECUTED,
    ("prd2srv", ServerState.READY, Trial): ServerState.EXECUTED,
    ("prd2srv", ServerState.EXECUTED, Trial): ServerState.EXECUTED,  # a rerun, before After asks
    ("aft2srv", ServerState.STANDBY, RestoreState): ServerState.STANDBY,
    ("aft2srv", ServerState.EXECUTED, CaptureState): ServerState.READY,
    ("bfr2srv", ServerState.STANDBY, CaptureState): ServerState.TRYING,
    ("bfr2srv", ServerState.READY, CaptureState): ServerState.TRYING,
    ("prd2srv", ServerState.TRYING, Trial): ServerState.TRYING,  # a rerun leads to EXECUTED
}
OPEN: Final[
    dict[tuple[bool, bool], dict[ServerState, tuple[str, ...]]]
] = {  # by what leads: srv2aft, srv2bfr
    (False, False): dict.fromkeys(ServerState, ("prd2srv",)),
    (True, False): {
        ServerState.STANDBY: ("aft2srv", "prd2srv"),
        ServerState.READY: ("prd2srv",),
        ServerState.TRYING: ("prd2srv",),
        ServerState.EXECUTED: ("aft2srv",),
    },
    (False, True): {
        ServerState.STANDBY: ("bfr2srv", "prd2srv"),
        ServerState.READY: ("bfr2srv", "prd2srv"),  # the next request, or a third trial
        ServerState.TRYING: ("prd2srv",),
        ServerState.EXECUTED: ("bfr2srv", "prd2srv"),
    },
    (True, True): {
        ServerState.STANDBY: ("aft2srv", "bfr2srv", "prd2srv"),
        ServerState.READY: ("bfr2srv",),
        ServerState.TRYING: ("prd2srv",),
        ServerState.EXECUTED: ("aft2srv", "prd2srv"),  # the question of After, or a third trial
    },
}
_ANSWERED_ON: Final = {"aft2srv": "srv2aft", "bfr2srv": "srv2bfr"}

# Bound once: a look-up in an enumeration is slow on the hot path.
_READY: Final = ServerState.READY
_EXECUTED: Final = ServerState.EXECUTED
_TRYING: Final = ServerState.TRYING
_ENTER: Final = Event.SERVER_ENTER
_EXIT: Final = Event.SERVER_EXIT
_CAPTURED: Final = Event.STATE_CAPTURED


class Server(Brick):
    """`replica` (1 or 2) marks whose replies these are; `captured`: After asks for the state each time."""

    def __init__(self, application: Application, replica: int) -> None:
        self.application, self.replica = application, replica
        self.state = ServerState.STANDBY
        self.captured = self.tried = False
        self._open = OPEN[self.captured, self.tried]

    def open_ports(self) -> tuple[str, ...]:
        """By where the outputs lead and by state; see OPEN."""
        return self._open[self.state]

    def quiescent(self) -> bool:
        """Nothing executed whose state is still to be captured, no trial to come."""
        return self.state is not _EXECUTED and self.state is not _TRYING

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Execute, try, capture or restore."""
        state = MOVES.get((port, self.state, type(msg)))
        if state is None:
            if isinstance(msg, Rebound):
                return self._rebound(msg)
            raise PeerError(f"{type(msg).__name__} on {port} while {self.state.name}")
        if isinstance(msg, Request):
            payload = self._execute(msg.payload)
            self.state = _EXECUTED if self.captured else _READY
            return [
                Note(_ENTER, msg.request_id),
                Note(_EXIT, msg.request_id),
                Send("srv2prd", Reply(msg.epoch, msg.request_id, self.replica, payload)),
            ]
        if isinstance(msg, CaptureState):
            self.state = state
            captured = StateCaptured(msg.epoch, msg.request_id, self.application.capture())
            return [Note(_CAPTURED, msg.request_id), Send(_ANSWERED_ON[port], captured)]
        if isinstance(msg, Trial):
            return self._try(msg)
        assert isinstance(msg, RestoreState)
        try:
            self.application.restore(msg.state)
        except PeerError as error:  # a backup that cannot follow is none: it is dropped, and another one made
            reason = f"the state after request {msg.request_id} is refused: {error}"
            return [Note(Event.DETECTED_STOP, msg.request_id), Halt(reason)]
        return [
            Note(Event.STATE_RESTORED, msg.request_id),
            Send("srv2aft", StateRestored(msg.epoch, msg.request_id)),
        ]

    def _try(self, msg: Trial) -> list[Effect]:
        """Execute, from the state of before if this is not the first time."""
        if msg.rerun:
            self.application.restore(msg.state)
        elif self.state is _EXECUTED:
            raise PeerError(f"Trial of request {msg.request_id}, and the state of the last is not captured")
        payload, detail = self._execute(msg.payload), RERUN if msg.rerun else 0
        self.state = (_EXECUTED if self.captured else _READY) if msg.rerun else _TRYING
        tried = Tried(msg.epoch, msg.request_id, self.replica, payload, self.application.capture())
        return [
            Note(_ENTER, msg.request_id, detail),
            Note(_EXIT, msg.request_id, detail),
            Send("srv2prd", tried),
        ]

    def _execute(self, request: bytes) -> bytes:
        """The reply; an empty one to a request that the function refuses (its state is as it was)."""
        try:
            return self.application.execute(request)
        except PeerError:
            return b""

    def _rebound(self, msg: Rebound) -> list[Effect]:
        """Learn what will be asked. Who hears of an After anew may be a backup from now on, or a leader."""
        if msg.port == "srv2aft":
            self.captured, self.state = msg.bound, ServerState.STANDBY
        elif msg.port == "srv2bfr":
            self.tried = msg.bound
        self._open = OPEN[self.captured, self.tried]
        return []

    def capture(self) -> bytes:
        """The function's state."""
        return self.application.capture()

    def restore(self, state: bytes) -> None:
        """Take over a function's state."""
        self.application.restore(state)

    def migrate(self, state: bytes) -> None:
        """Take over the state of another function, which has been this one's until now."""
        migrate = getattr(self.application, "migrate", self.application.restore)
        migrate(state)

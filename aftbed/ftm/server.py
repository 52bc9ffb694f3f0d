"""Server: the protected function behind three messages: execute, capture, restore (paper, III-A).

State access is the A of FT/A/R that PBR needs. The function is a stranger: bytes in, bytes out. Under
a mechanism that captures the state after each request, a leader's Server is open for one thing at a time.
"""

from enum import auto
from typing import Final

from aftbed.core.application import Application
from aftbed.core.brick import Brick, BrickState, Effect, Note, Send
from aftbed.core.errors import PeerError
from aftbed.core.event import Event
from aftbed.core.message import (
    AnyMessage,
    CaptureState,
    Rebound,
    Reply,
    Request,
    RestoreState,
    StateCaptured,
    StateRestored,
)


class State(BrickState):
    STANDBY = auto()  # of a backup: states to restore, until the first request makes it a leader's
    READY = auto()  # for a request
    EXECUTED = auto()  # the state after it will be asked for


OPEN: Final[dict[State, tuple[str, ...]]] = {
    State.STANDBY: ("aft2srv", "prd2srv"),
    State.READY: ("prd2srv",),
    State.EXECUTED: ("aft2srv",),
}
_MESSAGES: Final = {
    State.STANDBY: (Request, RestoreState),
    State.READY: (Request,),
    State.EXECUTED: (CaptureState,),
}

# Bound once: a look-up in an enumeration is slow on the hot path.
_READY: Final = State.READY
_EXECUTED: Final = State.EXECUTED
_ENTER: Final = Event.SERVER_ENTER
_EXIT: Final = Event.SERVER_EXIT
_CAPTURED: Final = Event.STATE_CAPTURED


class Server(Brick):
    """`replica` (1 or 2) marks whose replies these are; `captured`: After asks for the state each time."""

    def __init__(self, application: Application, replica: int, *, leads: bool, captured: bool) -> None:
        self.application, self.replica, self.captured = application, replica, captured
        self.state = State.READY if leads else State.STANDBY

    def open_ports(self) -> tuple[str, ...]:
        """By state; see OPEN."""
        return OPEN[self.state]

    def quiescent(self) -> bool:
        """Nothing executed whose state is still to be captured."""
        return self.state is not State.EXECUTED

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Execute, capture or restore."""
        if not isinstance(msg, _MESSAGES[self.state]):
            if isinstance(msg, Rebound):
                return []
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
            self.state = _READY
            return [
                Note(_CAPTURED, msg.request_id),
                Send("srv2aft", StateCaptured(msg.epoch, msg.request_id, self.application.capture())),
            ]
        assert isinstance(msg, RestoreState)
        self.application.restore(msg.state)
        return [
            Note(Event.STATE_RESTORED, msg.request_id),
            Send("srv2aft", StateRestored(msg.epoch, msg.request_id)),
        ]

    def _execute(self, request: bytes) -> bytes:
        """The reply; an empty one to a request that the function refuses (its state is as it was)."""
        try:
            return self.application.execute(request)
        except PeerError:
            return b""

    def capture(self) -> bytes:
        """The function's state."""
        return self.application.capture()

    def restore(self, state: bytes) -> None:
        """Take over a function's state."""
        self.application.restore(state)

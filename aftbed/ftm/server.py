"""Server: the protected function behind three messages: execute, capture, restore (paper, III-A).

State access is the A of FT/A/R that PBR needs. The function is a stranger: bytes in, bytes out.
"""

from typing import Final

from aftbed.core.application import Application
from aftbed.core.brick import Brick, Effect, Note, Send
from aftbed.core.errors import PeerError
from aftbed.core.event import Event
from aftbed.core.message import (
    AnyMessage,
    CaptureState,
    Reply,
    Request,
    RestoreState,
    StateCaptured,
    StateRestored,
)

_OPEN: Final = ("prd2srv", "aft2srv")


class Server(Brick):
    """`replica` (1 or 2) marks whose replies these are."""

    def __init__(self, application: Application, replica: int) -> None:
        self.application, self.replica = application, replica

    def open_ports(self) -> tuple[str, ...]:
        """Requests and state access, at any time: each is one step."""
        return _OPEN

    def quiescent(self) -> bool:
        """Between two steps nothing is inside."""
        return True

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Execute, capture or restore."""
        if isinstance(msg, Request):
            payload = self.application.execute(msg.payload)
            return [
                Note(Event.SERVER_ENTER, msg.request_id),
                Note(Event.SERVER_EXIT, msg.request_id),
                Send("srv2prd", Reply(msg.epoch, msg.request_id, self.replica, payload)),
            ]
        if isinstance(msg, CaptureState):
            return [
                Note(Event.STATE_CAPTURED, msg.request_id),
                Send("srv2aft", StateCaptured(msg.epoch, msg.request_id, self.application.capture())),
            ]
        if isinstance(msg, RestoreState):
            self.application.restore(msg.state)
            return [
                Note(Event.STATE_RESTORED, msg.request_id),
                Send("srv2aft", StateRestored(msg.epoch, msg.request_id)),
            ]
        raise PeerError(f"{type(msg).__name__} on {port}")

    def capture(self) -> bytes:
        """The function's state."""
        return self.application.capture()

    def restore(self, state: bytes) -> None:
        """Take over a function's state."""
        self.application.restore(state)

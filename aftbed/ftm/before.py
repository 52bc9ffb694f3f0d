"""Before brick of PBR: passes the request on (paper, III-A: PBR does nothing before the computation)."""

from typing import Final

from aftbed.core.brick import Brick, Effect, Note, Send
from aftbed.core.errors import PeerError
from aftbed.core.event import Event
from aftbed.core.message import AnyMessage, Rebound, Request, TakeOver

_OPEN: Final = ("pro2bfr",)
_EXIT: Final = Event.BEFORE_EXIT  # bound once: a look-up in an enumeration is slow on the hot path


class PassBefore(Brick):
    """Stateless."""

    def open_ports(self) -> tuple[str, ...]:
        """Always ready for a request."""
        return _OPEN

    def quiescent(self) -> bool:
        """Never holds one."""
        return True

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Pass on a request, or that all behind it is led from here."""
        if isinstance(msg, Request):
            return [Note(_EXIT, msg.request_id), Send("bfr2prd", msg)]
        if isinstance(msg, TakeOver):
            return [Send("bfr2prd", msg)]
        if isinstance(msg, Rebound):
            return []
        raise PeerError(f"{type(msg).__name__} on {port}")

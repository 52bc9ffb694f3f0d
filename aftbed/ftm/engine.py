"""Adaptation Engine: exchanges bricks while the service runs (paper, III-B). Idle so far.

It has its place in the graph, its process and its death already; scripts come with the adaptations.
"""

from aftbed.core.brick import Brick, Effect
from aftbed.core.errors import PeerError
from aftbed.core.message import AnyMessage, Rebound


class AdaptationEngine(Brick):
    """Takes no mail yet."""

    def open_ports(self) -> tuple[str, ...]:
        """None."""
        return ()

    def quiescent(self) -> bool:
        """Nothing under way."""
        return True

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        """Refuse all mail but word of its channels."""
        if isinstance(msg, Rebound):
            return []
        raise PeerError(f"{type(msg).__name__} on {port}: the engine takes no mail")

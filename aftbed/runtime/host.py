"""What a fault agent needs of the node that it sits in."""

from typing import Protocol

from aftbed.core.brick import Brick
from aftbed.core.events import Event


class AgentHost(Protocol):
    """The node, as its fault agent sees it."""

    def brick(self, name: str) -> Brick:
        """The brick of that name. Raises KeyError."""
        ...

    def record(self, event: Event, request_id: int, detail: int) -> None:
        """Write a record, now."""
        ...

    def report_fired(self, fault: int) -> None:
        """Tell the executive that `fault` is due, or has struck."""
        ...

    def wait_until_applied(self, fault: int) -> None:
        """Perform no further effect until the executive has acknowledged `fault`."""
        ...

    def kill(self) -> None:
        """End this node with SIGKILL, here and now."""
        ...

    def stop_detected(self, brick: str, reason: str) -> None:
        """A detected stop: end this node here and now."""
        ...

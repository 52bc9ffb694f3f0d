"""What a runtime makes of a node, as orders and faults find it."""

from typing import Protocol

from aftbed.core.brick import Brick
from aftbed.core.events import Event
from aftbed.runtime import control
from aftbed.runtime.diversion import Diversion

Fds = list[int]


class Hosted(Protocol):
    """A brick in its node."""

    name: str
    brick: Brick


class Host(Protocol):
    """A node, as an order finds it."""

    armed: dict[Event, control.Arm]
    slowed: dict[int, control.SlowDown]  # by fault
    diverted: dict[tuple[str, str], Diversion]  # by brick and port: what disturbs it

    def hosted(self, brick: str) -> Hosted:
        """The brick of that name. Raises KeyError."""
        ...

    def bind_input(self, brick: str, port: str, end: int | None) -> None:
        """Read `port` from that end of a channel, or from nowhere."""
        ...

    def bind_output(self, brick: str, port: str, end: int | None, epoch: int) -> None:
        """Write `port` to that end, or to nowhere, and tell the brick."""
        ...

    def suspend(self, token: int, *, drain: bool) -> None:
        """Answer `token` as soon as no request is inside (`drain`: nor waits)."""
        ...

    def resume(self) -> None:
        """Undo `suspend`."""
        ...

    def memory(self, end: int) -> memoryview:
        """The memory of the cell with that end, which is let go of."""
        ...

    def tell(self, brick: str, message: control.Told) -> None:
        """Have `brick` step with `message`."""
        ...

    def watch(self, order: control.WatchNodes, fds: Fds) -> None:
        """Have the Watchdog watch these."""
        ...

    def stats(self) -> bytes:
        """What its device counts."""
        ...

    def quiet(self) -> None:
        """Its device hands in nothing more."""
        ...

    def record(self, event: Event, request_id: int, detail: int) -> None:
        """Write a record, now."""
        ...

    def say(self, report: control.FromNode) -> None:
        """To the executive."""
        ...

    def die_here(self) -> None:
        """Be killed, here and now."""
        ...

    def wait_until_hit(self, fault: int) -> None:
        """Go no further until the executive has answered for `fault`."""
        ...

    def stop_detected(self, brick: str, reason: str) -> None:
        """A detected stop: end here and now."""
        ...

    def slow(self) -> None:
        """Go by `slowed`, which has changed, from the next step on."""
        ...

    def divert(self, brick: str, port: str) -> None:
        """Go by `diverted`, which has changed for this port: what is sent there goes through it, or not."""
        ...

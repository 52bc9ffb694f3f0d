"""What the devices of a simulated node work with: the deaths and pulses of other nodes, a car in virtual
time.
"""

from collections.abc import Callable, Iterable
from typing import Protocol

from aftbed.core.messages import Reply
from aftbed.runtime import control
from aftbed.vehicle.drive_virtual import VirtualCar

Notice = Callable[[int, Callable[[], None]], None]


class PulseSource(Protocol):
    """A node, as a Watchdog senses it."""

    def pulse_ns(self, now_ns: int) -> int:
        """When it was last seen running."""
        ...


class SimSenses:
    """The `Senses` of a Watchdog. `find`: the node behind a number that came with an order; `notice`: of its
    death.
    """

    def __init__(self, find: Callable[[int], PulseSource], notice: Notice) -> None:
        self._find, self._notice = find, notice
        self._nodes: dict[str, PulseSource] = {}

    def watch(self, order: control.WatchNodes, fds: list[int], died: Callable[[str], None]) -> None:
        """Watch these nodes and no others; a node that is dead already is noticed at once."""
        watched = self._nodes = {
            node: self._find(number) for node, number in zip(order.nodes, fds, strict=True)
        }

        def noticed(node: str) -> None:
            if watched is self._nodes:
                died(node)

        for node, number in zip(order.nodes, fds, strict=True):
            self._notice(number, lambda node=node: noticed(node))  # type: ignore[misc]

    def forget(self) -> None:
        """Watch no node."""
        self._nodes = {}

    def fds(self) -> tuple[int, ...]:
        """None: deaths are noticed."""
        return ()

    def died(self, fd: int) -> list[str]:
        """Never called."""
        raise AssertionError(f"no descriptor {fd}")

    def pulse_ns(self, node: str, now_ns: int) -> int:
        """When `node` was last seen running."""
        return self._nodes[node].pulse_ns(now_ns)


class VirtualCarLink:
    """The `CarLink` in virtual time; the drive began at `began_ns`."""

    def __init__(self, car: VirtualCar, began_ns: int) -> None:
        self._car, self._began_ns = car, began_ns

    def fds(self) -> tuple[int, ...]:
        """None."""
        return ()

    def read(self) -> Iterable[bytes]:
        """Never called."""
        raise AssertionError("no descriptor")

    def advance(self, now_ns: int) -> Iterable[bytes]:
        """Drive as far as the time is: the requests that are made on the way."""
        return self._car.advance(now_ns - self._began_ns)

    def deliver(self, reply: Reply, now_ns: int) -> None:
        """To the brakes."""
        self._car.deliver(reply.payload, now_ns - self._began_ns, replica=reply.replica, epoch=reply.epoch)

    def deadline_ns(self) -> int | None:
        """The next frame of the radar."""
        due = self._car.due_ns()
        return None if due is None else due + self._began_ns

    @property
    def over(self) -> bool:
        """The drive is over."""
        return self._car.due_ns() is None

    def counts(self) -> dict[str, object]:
        """None."""
        return {}

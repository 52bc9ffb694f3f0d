"""What orders and faults do to a node that is a process: see `orders.Host`."""

import os
import signal
import sys
import time
from typing import TYPE_CHECKING, Final

from aftbed.core.brick import CONTROL
from aftbed.core.event import Event
from aftbed.runtime import control
from aftbed.runtime.diversion import Diversion
from aftbed.runtime.unix import cells
from aftbed.runtime.unix.devices import Sensor
from aftbed.runtime.unix.hindrance import Hindrance
from aftbed.runtime.unix.wiring import Hosted

if TYPE_CHECKING:
    from aftbed.runtime.unix.node import Node

EXIT_DETECTED: Final = 71  # a detected stop
FAULT_NS_MAX: Final = 5_000_000_000


class Obedience:
    """Of one node."""

    def __init__(self, node: "Node") -> None:
        self._node = node
        self.armed = node.armed
        self.slowed: dict[int, int] = {}
        self.diverted: dict[tuple[str, str], Diversion] = {}
        self._hindrance = Hindrance(node, self)

    def hosted(self, brick: str) -> Hosted:
        """The brick of that name."""
        return self._node.wiring.hosted[brick]

    def bind_input(self, brick: str, port: str, end: int | None) -> None:
        """Read `port` from that descriptor from now on."""
        self._node.wiring.bind_input(brick, port, end)

    def bind_output(self, brick: str, port: str, end: int | None, epoch: int) -> None:
        """Write `port` to that descriptor from now on, and tell the brick."""
        self._hindrance.lift(brick, port)
        self._node.bind_output(brick, port, end, epoch)
        self._hindrance.lay(brick, port)

    def suspend(self, token: int, *, drain: bool) -> None:
        """Answer `token` as soon as no request is inside (`drain`: nor waits)."""
        self._node.suspend_token, self._node.draining = token, drain

    def resume(self) -> None:
        """Undo `suspend`."""
        self._node.suspended, self._node.suspend_token = False, 0

    def memory(self, end: int) -> memoryview:
        """The memory of the cell behind that descriptor."""
        return cells.mapped(end)

    def tell(self, brick: str, message: control.Told) -> None:
        """Have `brick` step with `message`."""
        self._node.step(self._node.wiring.hosted[brick], CONTROL, message)

    def watch(self, order: control.WatchNodes, fds: list[int]) -> None:
        """Have the Watchdog watch these."""
        assert isinstance(self._node.device, Sensor)
        self._node.device.watch(order.nodes, order.journals, order.pids, fds)
        self._node.wiring.forget_plans()

    def stats(self) -> bytes:
        """What its device counts."""
        return self._node.device.stats() if self._node.device is not None else b""

    def quiet(self) -> None:
        """Its device hands in nothing more."""
        assert self._node.device is not None
        self._node.device.quiet()

    def record(self, event: Event, request_id: int, detail: int) -> None:
        """Write a record, now."""
        self._node.journal.write(time.monotonic_ns(), event, request_id, detail)

    def say(self, report: control.FromNode) -> None:
        """To the supervisor."""
        self._node.line.send(report)

    def die_here(self) -> None:
        """Be killed, here and now."""
        os.kill(os.getpid(), signal.SIGKILL)

    def wait_until_hit(self, fault: int) -> None:
        """Go no further until the supervisor has answered for `fault`."""
        limit_ns = time.monotonic_ns() + FAULT_NS_MAX
        while time.monotonic_ns() < limit_ns:
            if self._node.serve_control(wait=True, until=fault):
                return
        raise AssertionError(f"fault {fault} was not applied within {FAULT_NS_MAX / 1e9} s")

    def slow(self) -> None:
        """Go by `slowed` from the next step on."""
        self._hindrance.slow()

    def divert(self, brick: str, port: str) -> None:
        """Go by `diverted`, which has changed for this port."""
        self._hindrance.divert(brick, port)

    def stop_detected(self, brick: str, reason: str) -> None:
        """A detected stop: end here and now."""
        print(f"{brick} (pid {os.getpid()}): detected stop: {reason}", file=sys.stderr, flush=True)
        os._exit(EXIT_DETECTED)

"""What orders and faults do to a node that is a process (see `orders.Host`), and how orders come to it.

Control is served before data, and also where the node cannot go on: while it is suspended, while a channel
has no room, while a fault has to be seen applied.
"""

import os
import signal
import sys
import time
from typing import TYPE_CHECKING, Final

from aftbed.core.brick import CONTROL
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.journal import FLAG_OFFSET
from aftbed.runtime import control
from aftbed.runtime.diversion import Diversion
from aftbed.runtime.orders import carry_out
from aftbed.runtime.unix import cells
from aftbed.runtime.unix.devices import Sensor
from aftbed.runtime.unix.hindrance import Hindrance
from aftbed.runtime.unix.wiring import Hosted, Output

if TYPE_CHECKING:
    from aftbed.runtime.unix.node import Node

EXIT_DETECTED: Final = 71  # a detected stop
FAULT_NS_MAX: Final = 5_000_000_000


class Obedience:
    """Of one node."""

    def __init__(self, node: "Node") -> None:
        self._node = node
        self.armed = node.armed
        self.slowed: dict[int, control.SlowDown] = {}
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
            if self.serve_control(wait=True, until=fault):
                return
        raise AssertionError(f"fault {fault} was not applied within {FAULT_NS_MAX / 1e9} s")

    def slow(self) -> None:
        """Go by `slowed` from the next step on."""
        self._hindrance.slow()

    def divert(self, brick: str, port: str) -> None:
        """Go by `diverted`, which has changed for this port."""
        self._hindrance.divert(brick, port)

    def beneath(self, hosted: Hosted, port: str) -> Output:
        """Where the port leads, whatever disturbs it."""
        return self._hindrance.beneath(hosted, port)

    def stop_detected(self, brick: str, reason: str) -> None:
        """A detected stop: end here and now."""
        print(f"{brick} (pid {os.getpid()}): detected stop: {reason}", file=sys.stderr, flush=True)
        os._exit(EXIT_DETECTED)

    # -- how they come ------------------------------------------------------------------------

    def serve_control(self, wait: bool = False, until: int = 0) -> bool:
        """Carry out the orders that wait; with `wait`, for a pulse at most. True if there was any.

        With `until`: True if the Ack of that fault was among them.
        """
        self._node.journal.mapping[FLAG_OFFSET] = 0
        served = False
        while True:
            try:
                got = self._receive(wait and not served)
            except BlockingIOError:
                return served
            if got is None:
                os._exit(0)  # the supervisor is gone, and this run with it
            order, fds = got
            if isinstance(order, control.Ack):
                served = served or order.token == until
                continue
            try:
                data = carry_out(self, order, fds)
            except PeerError as error:
                self.ack(order.token, error=str(error))
            else:
                if data is not None:
                    self.ack(order.token, data)
            served = served or not until

    def _receive(self, wait: bool) -> tuple[control.ToNode, list[int]] | None:
        line = self._node.line
        if wait:
            return line.recv()
        line.sock.setblocking(False)
        try:
            return line.recv()
        finally:
            line.sock.setblocking(True)

    def ack(self, token: int, data: bytes = b"", error: str = "") -> None:
        """Answer an order."""
        if token != control.UNANSWERED:
            self._node.line.send(control.Ack(token, data, error))

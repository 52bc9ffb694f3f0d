"""The wiring of a node: its bricks, their inlets, where their outputs lead, and what to wait for."""

import os
import select
from collections import deque
from collections.abc import Callable

from aftbed.core.brick import Brick
from aftbed.core.messages import Message
from aftbed.runtime import control

Mail = deque[tuple["Hosted", str, Message]]
Output = int | Callable[[Message], None]  # a descriptor, or a function


class Inlet:
    """The reading end of a channel."""

    __slots__ = ("fd", "hosted", "port")

    def __init__(self, hosted: "Hosted", port: str, descriptor: int) -> None:
        self.hosted, self.port = hosted, port
        self.fd = descriptor


class Hosted:
    """A brick, its inlets, and where its outputs lead: a descriptor or a function."""

    __slots__ = ("brick", "index", "inlets", "name", "outs")

    def __init__(self, name: str, brick: Brick, index: int) -> None:
        self.name, self.brick, self.index = name, brick, index
        self.inlets: dict[str, Inlet] = {}
        self.outs: dict[str, Output] = {}


class Plan:
    """What to wait for while the same ports are open: a single inlet, or a poll."""

    __slots__ = ("by_fd", "poll", "single")

    def __init__(self, inlets: list[Inlet], others: tuple[int, ...], may_block: bool) -> None:
        self.single = inlets[0] if may_block and len(inlets) == 1 else None
        self.by_fd = {inlet.fd: inlet for inlet in inlets}
        self.poll = select.poll()
        for fd in (*self.by_fd, *others):
            self.poll.register(fd, select.POLLIN)


def _nowhere(message: Message) -> None:
    """An unbound output."""


class Wiring:
    """`mail` is what goes from brick to brick within the node."""

    def __init__(self) -> None:
        self.hosted: dict[str, Hosted] = {}
        self.mail: Mail = deque()
        self.timed = False  # some brick has deadlines
        self.hot_inlets: dict[tuple[str, ...], Inlet] = {}  # of a node with one brick, by its open ports
        self._fronts: list[Hosted] = []  # bricks that may have inlets
        self._plans: dict[tuple[tuple[str, ...], ...], Plan] = {}

    def add(self, name: str, brick: Brick) -> Hosted:
        """Host `brick`."""
        hosted = self.hosted[name] = Hosted(name, brick, len(self.hosted))
        self._fronts = list(self.hosted.values())
        self.timed = any(type(h.brick).deadline_ns is not Brick.deadline_ns for h in self._fronts)
        return hosted

    def link_inside(self, local: control.Local) -> None:
        """A channel between two bricks of this node."""
        source, sink = self.hosted[local.brick], self.hosted[local.sink]
        source.outs[local.port] = lambda message: self.mail.append((sink, local.sink_port, message))

    def bind_input(self, brick: str, port: str, descriptor: int | None) -> None:
        """Read `port` from `descriptor` from now on."""
        hosted = self.hosted[brick]
        old = hosted.inlets.pop(port, None)
        if old is not None:
            os.close(old.fd)
        if descriptor is not None:
            hosted.inlets[port] = Inlet(hosted, port, descriptor)
        self._fronts = [h for h in self.hosted.values() if h.inlets]
        self.forget_plans()

    def bind_output(self, brick: str, port: str, descriptor: int | None) -> Hosted:
        """Write `port` to `descriptor` from now on."""
        hosted = self.hosted[brick]
        old = hosted.outs.get(port)
        hosted.outs[port] = _nowhere if descriptor is None else descriptor
        if isinstance(old, int):
            os.close(old)
        return hosted

    def inside(self) -> tuple[Hosted, str, Message] | None:
        """The next mail between bricks of this node whose port is open, or None: the rest waits."""
        first = self.mail[0]
        if first[1] in first[0].brick.open_ports():  # nearly always
            return self.mail.popleft()
        for index, (hosted, port, message) in enumerate(self.mail):
            if port in hosted.brick.open_ports():
                del self.mail[index]
                return hosted, port, message
        return None

    def forget_plans(self) -> None:
        """What there is to wait for has changed."""
        self._plans.clear()
        self.hot_inlets.clear()

    def quiescent(self) -> bool:
        """No request is inside."""
        return not self.mail and all(h.brick.quiescent() for h in self.hosted.values())

    def plan(self, others: tuple[int, ...], *, may_block: bool) -> Plan:
        """What to wait for now; `others` are descriptors beside the inlets.

        `may_block`: these are the same every time, and nothing is due at a time.
        """
        key = tuple([hosted.brick.open_ports() for hosted in self._fronts])
        plan = self._plans.get(key)
        if plan is not None:
            return plan
        inlets = [
            hosted.inlets[port]
            for hosted, ports in zip(self._fronts, key, strict=True)
            for port in ports
            if port in hosted.inlets
        ]
        plan = Plan(inlets, others, may_block)
        if may_block:
            self._plans[key] = plan
            if plan.single is not None and len(key) == 1:
                self.hot_inlets[key[0]] = plan.single
        return plan

"""What hinders a process in its work: steps that take longer, messages that are not sent as they should.

A node that nothing hinders executes nothing of this. While something does, its methods `turn`, `step` and
`patience_ms` are taken from here; it leaves the fast way, as for any fault that waits in it, and does not
block in a read, since something may be due. What waits here is the host and not a brick, so the pulse goes
on: a slow node is not a hung one.
"""

import contextlib
import os
import time
from typing import TYPE_CHECKING

from aftbed.core import wire
from aftbed.core.brick import CONTROL, Brick
from aftbed.core.event import Event
from aftbed.core.message import AnyMessage, Message
from aftbed.runtime.blows import OFF_THE_FAST_WAY, Slowness
from aftbed.runtime.unix.wiring import Hosted, Output

if TYPE_CHECKING:
    from aftbed.runtime.host import Host
    from aftbed.runtime.unix.node import Node


class Hindrance:
    """Of one node."""

    def __init__(self, node: "Node", host: "Host") -> None:
        self._node, self._host = node, host
        self._laid: dict[tuple[str, str], Output] = {}  # where these ports lead, behind what is laid on them
        self._slowness = Slowness(host)

    # -- steps --------------------------------------------------------------------------------

    def slow(self) -> None:
        """Take as much longer as `slowed` says."""
        if self._host.slowed:
            vars(self._node)["step"] = self._step
        else:
            vars(self._node).pop("step", None)
        self._leave_or_take_the_fast_way()

    def _step(
        self, hosted: Hosted, port: str, message: AnyMessage | Message, raw: bytes | None = None
    ) -> None:
        if port != CONTROL:
            time.sleep(self._slowness.feel() / 1e9)
        type(self._node).step(self._node, hosted, port, message, raw)

    def _leave_or_take_the_fast_way(self) -> None:
        if self._host.slowed or self._laid:
            self._node.armed[Event.FAULT_APPLIED] = OFF_THE_FAST_WAY
        else:
            self._node.armed.pop(Event.FAULT_APPLIED, None)

    # -- channels -----------------------------------------------------------------------------

    def divert(self, brick: str, port: str) -> None:
        """Go by `diverted`, which has changed for this port."""
        diversion = self._host.diverted.get((brick, port))
        if diversion is None or diversion.over:
            self.lift(brick, port)
        elif (brick, port) not in self._laid:
            self.lay(brick, port)

    def lay(self, brick: str, port: str) -> None:
        """Have what is sent there go through its diversion, if there is one."""
        if (brick, port) in self._host.diverted:
            hosted = self._node.wiring.hosted[brick]
            self._laid[brick, port] = hosted.outs[port]
            hosted.outs[port] = lambda message: self._put(hosted, port, message)
            self._look()

    def lift(self, brick: str, port: str) -> None:
        """Have it go there directly. What is held back goes where it should have gone."""
        out = self._laid.pop((brick, port), None)
        if out is None:
            return
        diversion, hosted = self._host.diverted[brick, port], self._node.wiring.hosted[brick]
        hosted.outs[port] = out
        for message in diversion.flush(time.monotonic_ns()):
            with contextlib.suppress(OSError):  # nobody reads it: the brick will ask for what it wants
                _write(out, message)
        if diversion.over:
            del self._host.diverted[brick, port]
        self._look()

    def _put(self, hosted: Hosted, port: str, message: Message) -> None:
        self._send(hosted, port, self._host.diverted[hosted.name, port].take(message, time.monotonic_ns()))

    def _send(self, hosted: Hosted, port: str, messages: list[Message]) -> None:
        """Behind the diversion. Where there is no room the port is as it was, until there is."""
        out = self._laid[hosted.name, port]
        for message in messages:
            if (
                self._laid.get((hosted.name, port)) is not out
            ):  # bound elsewhere meanwhile: the brick has heard of it, and has asked again
                return
            try:
                _write(out, message)
            except OSError:
                laid, hosted.outs[port] = hosted.outs[port], out
                self._node.write_hard(hosted, port, wire.encode(message))
                if hosted.outs[port] is out:
                    hosted.outs[port] = laid
        diversion = self._host.diverted.get((hosted.name, port))
        if diversion is not None and diversion.over:
            self.lift(hosted.name, port)

    def _look(self) -> None:
        """Whether there is anything to look after."""
        node = self._node
        self._leave_or_take_the_fast_way()
        own = vars(node)
        if self._laid:
            own["turn"], own["patience_ms"] = self._turn, self._patience_ms
        else:
            own.pop("turn", None)
            own.pop("patience_ms", None)
        timed = any(type(h.brick).deadline_ns is not Brick.deadline_ns for h in node.wiring.hosted.values())
        node.wiring.timed = bool(self._laid) or timed  # polls with a deadline, where it would block
        node.wiring.forget_plans()

    def _turn(self) -> None:
        type(self._node).turn(self._node)
        now_ns = time.monotonic_ns()
        for brick, port in list(self._laid):
            hosted, diversion = self._node.wiring.hosted[brick], self._host.diverted[brick, port]
            due_ns = diversion.due_ns()
            if due_ns is not None and due_ns <= now_ns:
                self._send(hosted, port, diversion.release(now_ns))

    def _patience_ms(self) -> float:
        dues = [self._host.diverted[key].due_ns() for key in self._laid]
        limit = type(self._node).patience_ms(self._node)
        wanted = min((due for due in dues if due is not None), default=None)
        if wanted is None:
            return limit
        return min(limit, max(0.0, (wanted - time.monotonic_ns()) / 1e6 + 0.999))


def _write(out: Output, message: Message) -> None:
    """Raises OSError as write(2) does."""
    if isinstance(out, int):
        os.write(out, wire.encode(message))
    else:
        out(message)

"""What hinders a node in virtual time: steps that take longer, messages that are not sent as they should.

See `runtime.unix.hindrance`. Here a slow step's effects come later, and nothing else is handled before them;
a disturbed channel is full, fenced and left as any other.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from aftbed.core.brick import CONTROL
from aftbed.core.event import Event
from aftbed.core.message import AnyMessage, Message
from aftbed.runtime.blows import OFF_THE_FAST_WAY, Slowness
from aftbed.runtime.sim.channels import QUEUE_MAX, Channel
from aftbed.runtime.sim.clock import Clock

if TYPE_CHECKING:
    from aftbed.runtime.sim.effects import Hosted
    from aftbed.runtime.sim.node import Node

BY_ITSELF: Final = -1  # what holds a node up that is slow: no fault has this number
FROZEN_NS: Final = 5_000_000  # when to look again whether a node that is stopped goes on

Output = Channel | Callable[[Message], None]


class _Diverted(Channel):
    """An end of `channel` through which one node writes; who else writes there is not disturbed."""

    def __init__(self, channel: Channel, take: Callable[[Message], None]) -> None:
        self._channel, self._take = channel, take

    def put(self, message: Message) -> bool:
        """False where there is no room, as ever; then nothing has happened."""
        channel = self._channel
        if channel.ended or channel.refused or len(channel.mail) >= QUEUE_MAX:
            return False
        self._take(message)
        return True

    def leave(self, node: "Node") -> None:
        """As from the channel."""
        self._channel.leave(node)


class Hindrance:
    """Of one node."""

    def __init__(self, node: "Node", clock: Clock) -> None:
        self._node, self._clock = node, clock
        self._laid: dict[tuple[str, str], tuple[Output, Callable[[Message], object]]] = {}
        self._slowness = Slowness(node)

    # -- steps --------------------------------------------------------------------------------

    def slow(self) -> None:
        """Take as much longer as `slowed` says."""
        if self._node.slowed:
            vars(self._node)["step"] = self._step
            self._node.armed[Event.FAULT_APPLIED] = OFF_THE_FAST_WAY  # effects may have to wait
        else:
            vars(self._node).pop("step", None)
            self._node.armed.pop(Event.FAULT_APPLIED, None)

    def _step(self, hosted: "Hosted", port: str, message: AnyMessage | Message) -> None:
        node = self._node
        if port != CONTROL:
            node.performer.held_by = BY_ITSELF
            self._clock.at(self._clock.ns + self._slowness.feel(), self._go_on)
        type(node).step(node, hosted, port, message)

    def _go_on(self) -> None:
        if self._node.performer.held_by == BY_ITSELF:
            self._node.performer.held_by = 0
        self._node.run()

    # -- channels -----------------------------------------------------------------------------

    def divert(self, brick: str, port: str) -> None:
        """Go by `diverted`, which has changed for this port."""
        diversion = self._node.diverted.get((brick, port))
        if diversion is None or diversion.over:
            self.lift(brick, port)
        elif (brick, port) not in self._laid:
            self.lay(brick, port)

    def lay(self, brick: str, port: str) -> None:
        """Have what is sent there go through its diversion, if there is one."""
        key = (brick, port)
        if key not in self._node.diverted:
            return
        hosted = self._node.bricks[brick]
        out = hosted.outs[port]
        if isinstance(out, Channel):
            self._laid[key] = (out, out.put)
            hosted.outs[port] = _Diverted(out, lambda message: self._take(key, message))
        else:
            self._laid[key] = (out, out)
            hosted.outs[port] = lambda message: self._take(key, message)

    def lift(self, brick: str, port: str) -> None:
        """Have it go there directly. What is held back goes where it should have gone."""
        key = (brick, port)
        laid = self._laid.pop(key, None)
        if laid is None:
            return
        out, send = laid
        self._node.bricks[brick].outs[port] = out
        diversion = self._node.diverted[key]
        for message in diversion.flush(self._clock.ns):
            send(message)
        if diversion.over:
            del self._node.diverted[key]

    def _take(self, key: tuple[str, str], message: Message) -> None:
        self._send(key, self._node.diverted[key].take(message, self._clock.ns))

    def _send(self, key: tuple[str, str], messages: list[Message]) -> None:
        _, send = self._laid[key]
        for message in messages:
            send(message)
        diversion = self._node.diverted[key]
        due_ns = diversion.due_ns()
        if due_ns is not None:
            self._clock.at(due_ns, lambda: self._release(key))
        elif diversion.over:
            self.lift(*key)

    def _release(self, key: tuple[str, str]) -> None:
        if not self._node.alive or key not in self._laid:
            return
        if self._node.frozen_ns:
            self._clock.at(self._clock.ns + FROZEN_NS, lambda: self._release(key))
            return
        self._send(key, self._node.diverted[key].release(self._clock.ns))
        self._node.run()  # it may have been sent within the node

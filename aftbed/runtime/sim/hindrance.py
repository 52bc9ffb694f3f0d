"""What hinders a node in virtual time: steps that take longer, messages that are not sent as they should.

See `runtime.unix.hindrance`. Here a slow step's effects come later, and nothing else is handled before them;
a disturbed channel is full, fenced and left as any other. What a step takes of a CPU is the time of a hop, in
which there is little else: with a share of it, a step takes so many times that.
"""

from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from aftbed.core.brick import CONTROL
from aftbed.core.events import Event
from aftbed.core.messages import AnyMessage, Message
from aftbed.runtime.blows import OFF_THE_FAST_WAY, Slowness
from aftbed.runtime.diversion import Sender, follow
from aftbed.runtime.sim.channels import QUEUE_MAX, Channel
from aftbed.runtime.sim.clock import Clock
from aftbed.runtime.sim.hops import HOP_QUANTILES_NS

if TYPE_CHECKING:
    from aftbed.runtime.sim.effects import Hosted
    from aftbed.runtime.sim.node import Node

BY_ITSELF: Final = -1  # what holds a node up that is slow: no fault has this number
FROZEN_NS: Final = 5_000_000  # when to look again whether a node that is stopped goes on

STEP_NS: Final = HOP_QUANTILES_NS[len(HOP_QUANTILES_NS) // 2]
FULL_NS: Final = 100_000  # when to look again whether a full channel has room

Output = Channel | Callable[[Message], None]


class _Diverted(Channel):
    """An end of `channel` through which one node writes; who else writes there is not disturbed.

    `left` is what has come out of the diversion, and waits for room.
    """

    def __init__(self, channel: Channel, take: Callable[[Message], None]) -> None:
        self._channel, self._take = channel, take
        self.left: deque[Message] = deque()

    @property
    def beneath(self) -> Channel:
        """The channel itself."""
        return self._channel

    def put(self, message: Message) -> bool:
        """False where there is no room, as ever; then nothing has happened."""
        channel = self._channel
        if channel.ended or channel.refused or self.left or len(channel.mail) >= QUEUE_MAX:
            return False
        self._take(message)
        return True

    def send(self, message: Message) -> None:
        """Put it into the channel, behind what waits for room there."""
        if self.left or not self._channel.put(message):
            self.left.append(message)

    def go_on(self) -> bool:
        """Send what waits, as far as there is room; whether that is all."""
        while self.left and self._channel.put(self.left[0]):
            self.left.popleft()
        return not self.left

    def leave(self, node: "Node") -> None:
        """As from the channel."""
        self._channel.leave(node)


class Hindrance:
    """Of one node."""

    def __init__(self, node: "Node", clock: Clock) -> None:
        self._node, self._clock = node, clock
        self._laid: dict[Sender, tuple[Output, Callable[[Message], object]]] = {}
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
            longer_ns = self._slowness.longer_ns() + self._slowness.stretched_ns(STEP_NS)
            self._clock.at(self._clock.ns + longer_ns, self._go_on)
        type(node).step(node, hosted, port, message)

    def _go_on(self) -> None:
        if self._node.performer.held_by == BY_ITSELF:
            self._node.performer.held_by = 0
        self._node.run()

    # -- channels -----------------------------------------------------------------------------

    def divert(self, brick: str, port: str) -> None:
        """Go by `diverted`, which has changed for this port."""
        if not self._left((brick, port)):  # it is lifted when that is through
            follow(self._node.diverted, (brick, port), self._laid, self)

    def lay(self, brick: str, port: str) -> None:
        """Have what is sent there go through its diversion, if there is one, and if it leads anywhere yet."""
        key = (brick, port)
        hosted = self._node.bricks[brick]
        if key not in self._node.diverted or port not in hosted.outs:
            return
        out = hosted.outs[port]
        if isinstance(out, Channel):
            end = _Diverted(out, lambda message: self._take(key, message))
            self._laid[key] = (out, end.send)
            hosted.outs[port] = end
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

    def _take(self, key: Sender, message: Message) -> None:
        self._send(key, self._node.diverted[key].take(message, self._clock.ns))

    def _send(self, key: Sender, messages: list[Message]) -> None:
        _, send = self._laid[key]
        for message in messages:
            send(message)
        due_ns = self._node.diverted[key].due_ns()
        if due_ns is not None:
            self._clock.at(due_ns, lambda: self._release(key))
        self._settle(key)

    def _settle(self, key: Sender) -> None:
        """Look again when there may be room; lift what is over."""
        if self._left(key):
            self._clock.at(self._clock.ns + FULL_NS, lambda: self._go_on_sending(key))
        elif self._node.diverted[key].over:
            self.lift(*key)

    def _left(self, key: Sender) -> "_Diverted | None":
        """The end of a channel at which something waits for room."""
        brick, port = key
        out = self._node.bricks[brick].outs.get(port) if key in self._laid else None
        return out if isinstance(out, _Diverted) and out.left else None

    def _go_on_sending(self, key: Sender) -> None:
        end = self._left(key)
        if not self._node.alive or end is None:
            return
        if not self._node.frozen_ns and end.go_on():
            self._settle(key)
            self._node.run()
        else:
            self._settle(key)

    def _release(self, key: Sender) -> None:
        if not self._node.alive or key not in self._laid:
            return
        if self._node.frozen_ns:
            self._clock.at(self._clock.ns + FROZEN_NS, lambda: self._release(key))
            return
        self._send(key, self._node.diverted[key].release(self._clock.ns))
        self._node.run()  # it may have been sent within the node

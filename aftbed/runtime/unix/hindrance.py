"""What hinders a process in its work: steps that take longer, messages that are not sent as they should.

A node that nothing hinders executes nothing of this. While something does, its methods `turn`, `step`,
`perform` and `patience_ms` are taken from here; it leaves the fast way, as for any fault that waits in it,
and does not block in a read, since something may be due. What waits here is the host and not a brick, so the
pulse goes on: a slow node is not a hung one.

*A share of a CPU.* Between a step and its effects the node waits for as long as what it has used of a CPU
since the last time would have taken longer: of 25 %, three times that. What is slept too long, as any sleep
is, is waited less the next time. So the share is exact, and nobody outside of the node has to undo it.

*Full channels.* A diversion may be laid, or lifted, while its sender waits for room: control is served then.
What waits is the sender's message, and its channel is the same, `beneath` the diversion: that is what counts.
"""

import contextlib
import time
from typing import TYPE_CHECKING, Final

from aftbed.core import messages
from aftbed.core.brick import CONTROL, Brick, Effect
from aftbed.core.events import Event
from aftbed.core.fault import SLOW_MS_MAX
from aftbed.core.messages import AnyMessage, Message
from aftbed.runtime.blows import OFF_THE_FAST_WAY, Slowness
from aftbed.runtime.diversion import follow
from aftbed.runtime.unix import packets
from aftbed.runtime.unix.wiring import Hosted, Output

if TYPE_CHECKING:
    from aftbed.runtime.host import Host
    from aftbed.runtime.unix.node import Node

PAUSE_NS_MAX: Final = round(SLOW_MS_MAX * 1e6)  # the rest is waited behind the next step
CREDIT_NS_MAX: Final = 1_000_000  # of a sleep that was too long: more is somebody else's doing


class Hindrance:
    """Of one node."""

    def __init__(self, node: "Node", host: "Host") -> None:
        self._node, self._host = node, host
        self._laid: dict[tuple[str, str], Output] = {}  # where these ports lead, behind what is laid on them
        self._slowness = Slowness(host)
        self._used_ns = self._owed_ns = 0

    # -- steps --------------------------------------------------------------------------------

    def slow(self) -> None:
        """Take as much longer as `slowed` says."""
        own = vars(self._node)
        if self._host.slowed:
            if "step" not in own:
                self._used_ns, self._owed_ns = time.thread_time_ns(), 0
            own["step"], own["perform"] = self._step, self._perform
        else:
            own.pop("step", None)
            own.pop("perform", None)
        self._leave_or_take_the_fast_way()

    def _step(
        self, hosted: Hosted, port: str, message: AnyMessage | Message, raw: bytes | None = None
    ) -> None:
        if port != CONTROL:
            time.sleep(self._slowness.longer_ns() / 1e9)
        type(self._node).step(self._node, hosted, port, message, raw)

    def _perform(
        self, hosted: Hosted, effects: list[Effect], now_ns: int, message: object, raw: bytes | None
    ) -> None:
        before_ns, self._used_ns = self._used_ns, time.thread_time_ns()
        self._owed_ns += self._slowness.stretched_ns(self._used_ns - before_ns)
        if self._owed_ns > 0:
            began_ns = time.monotonic_ns()
            time.sleep(min(self._owed_ns, PAUSE_NS_MAX) / 1e9)
            self._owed_ns = max(self._owed_ns - (time.monotonic_ns() - began_ns), -CREDIT_NS_MAX)
        type(self._node).perform(self._node, hosted, effects, now_ns, message, raw)

    def _leave_or_take_the_fast_way(self) -> None:
        if self._host.slowed or self._laid:
            self._node.armed[Event.FAULT_APPLIED] = OFF_THE_FAST_WAY
        else:
            self._node.armed.pop(Event.FAULT_APPLIED, None)

    # -- channels -----------------------------------------------------------------------------

    def divert(self, brick: str, port: str) -> None:
        """Go by `diverted`, which has changed for this port."""
        follow(self._host.diverted, (brick, port), self._laid, self)

    def beneath(self, hosted: Hosted, port: str) -> Output:
        """Where the port leads, whatever is laid on it."""
        return self._laid.get((hosted.name, port), hosted.outs[port])

    def lay(self, brick: str, port: str) -> None:
        """Have what is sent there go through its diversion, if there is one, and if it leads anywhere yet."""
        hosted = self._node.wiring.hosted[brick]
        if (brick, port) in self._host.diverted and port in hosted.outs:
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

    def _send(self, hosted: Hosted, port: str, mail: list[Message]) -> None:
        """Behind the diversion, which may be lifted while there is no room."""
        out = self._laid[hosted.name, port]
        for message in mail:
            if self.beneath(hosted, port) is not out:
                return  # bound elsewhere meanwhile: the brick has heard of it, and has asked again
            try:
                _write(out, message)
            except OSError:
                self._node.write_hard(hosted, port, messages.encode_unchecked(message))
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
        packets.put(out, messages.encode_unchecked(message))
    else:
        out(message)

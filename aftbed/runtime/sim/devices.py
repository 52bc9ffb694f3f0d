"""What joins bricks to the world of a simulated run: the senses of a Watchdog, a car behind the Client."""

from collections import deque
from collections.abc import Callable
from typing import Protocol

import msgspec

from aftbed.core.journal import EntryKind
from aftbed.core.messages import NodeDied, Pulses, Reply, Submit
from aftbed.ftm.client import BACKLOG_MAX, Client
from aftbed.ftm.failover import PERIOD_NS
from aftbed.runtime.source import Dialogue
from aftbed.vehicle.drive_virtual import VirtualCar

Notice = Callable[[int, Callable[[], None]], None]


class Device(Protocol):
    """`port` is the brick's port that it feeds."""

    port: str

    def take(self, now_ns: int) -> Submit | NodeDied | Pulses | None:
        """The next message for the brick, or None."""
        ...

    def wait(self, now_ns: int) -> None:
        """Nobody takes anything now, and time goes on."""
        ...

    def accept(self, reply: Reply, now_ns: int) -> None:
        """What the brick sent to `deliver`."""
        ...

    def quiet(self) -> None:
        """Hand in nothing more."""
        ...

    def deadline_ns(self) -> int | None:
        """When `take` is worth calling again at the latest."""
        ...

    def stats(self) -> bytes:
        """Counts, as MessagePack."""
        ...


class Watched(Protocol):
    """A node, as a Watchdog senses it."""

    def pulse_ns(self, now_ns: int) -> int:
        """When it was last seen running."""
        ...


class Sensor:
    """Deaths and pulses. `find`: the node behind a number that came with an order; `notice`: of its death."""

    port = "sense"

    def __init__(self, find: Callable[[int], Watched], notice: Notice) -> None:
        self._find, self._notice = find, notice
        self._nodes: dict[str, Watched] = {}
        self._died: deque[str] = deque()
        self._alarmed = False
        self._next_ns = 0

    def watch(self, nodes: tuple[str, ...], numbers: list[int]) -> None:
        """Watch these nodes and no others; one that is dead already is noticed at once."""
        self._nodes = {node: self._find(number) for node, number in zip(nodes, numbers, strict=True)}
        self._died.clear()
        self._alarmed = False
        for node, number in zip(nodes, numbers, strict=True):
            self._notice(number, lambda node=node, all_=self._nodes: self._dies(node, all_))  # type: ignore[misc]

    def _dies(self, node: str, watched: dict[str, Watched]) -> None:
        """A replica whose first node has died is lost: the deaths that follow are not looked at."""
        if watched is self._nodes and not self._alarmed:
            self._died.append(node)
            self._alarmed = True

    def take(self, now_ns: int) -> NodeDied | Pulses | None:
        """Deaths first."""
        if self._died:
            return NodeDied(self._died.popleft())
        if now_ns < self._next_ns or not self._nodes or self._alarmed:
            return None
        self._next_ns = now_ns + PERIOD_NS
        return Pulses({name: node.pulse_ns(now_ns) for name, node in self._nodes.items()})

    def wait(self, now_ns: int) -> None:
        """Whoever dies is kept in mind."""

    def accept(self, reply: Reply, now_ns: int) -> None:
        """Nothing is delivered to a sensor."""
        raise AssertionError("a reply delivered to a Watchdog's sensor")

    def quiet(self) -> None:
        """Watch nobody any more."""
        self._nodes = {}

    def deadline_ns(self) -> int | None:
        """The next look at the pulses."""
        return self._next_ns if self._nodes and not self._alarmed else None

    def stats(self) -> bytes:
        """None to give."""
        return msgspec.msgpack.encode({})


class Car:
    """A car on the bus; `began_ns` is the virtual time at which its drive began."""

    port = "submit"

    def __init__(self, client: Client, dialogue: Dialogue, car: VirtualCar, began_ns: int) -> None:
        self._client, self._dialogue, self._car, self._began_ns = client, dialogue, car, began_ns
        self._payloads: deque[bytes] = deque(maxlen=BACKLOG_MAX)  # the oldest track is worth least
        self._quiet = False

    def take(self, now_ns: int) -> Submit | None:
        """The next request; the car drives as far as the time is."""
        self._payloads.extend(self._car.advance(now_ns - self._began_ns))
        if not self._payloads or self._quiet:
            return None
        payload = self._payloads.popleft()
        self._dialogue.write(now_ns, self._client.next_id, 0, EntryKind.SENT, payload)
        return Submit(payload)

    def wait(self, now_ns: int) -> None:
        """The car drives on; what it asks for is kept, as far as there is room."""
        self._payloads.extend(self._car.advance(now_ns - self._began_ns))

    def accept(self, reply: Reply, now_ns: int) -> None:
        """To the brakes; written behind, so that a reply that nobody got is asked again."""
        self._car.deliver(reply.payload, now_ns - self._began_ns, replica=reply.replica, epoch=reply.epoch)
        self._dialogue.write(now_ns, reply.request_id, reply.epoch, EntryKind.ANSWERED, reply.payload)

    def quiet(self) -> None:
        """No more requests."""
        self._quiet = True
        self._payloads.clear()

    def deadline_ns(self) -> int | None:
        """The next frame of the radar."""
        due = self._car.due_ns()
        return None if due is None else due + self._began_ns

    @property
    def over(self) -> bool:
        """The drive is over."""
        return self._car.due_ns() is None

    @property
    def done(self) -> bool:
        """The drive is over, and all is answered."""
        return self.over and not self._payloads and not self._client.unanswered

    def stats(self) -> bytes:
        """How far the requests are."""
        waiting = len(self._client.unanswered) + len(self._payloads)
        return msgspec.msgpack.encode({"sent": self._client.next_id - 1, "unanswered": waiting})

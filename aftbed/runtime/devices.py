"""Devices: what joins a brick's port to the world outside of the graph, for every runtime.

A brick is pure, so its node has to hold what a Watchdog senses with and where the Client's requests come
from: a `Load`, a list of requests in a closed loop or at a fixed rate; a `CarDevice`, a car on its bus; a
`Sensor`.

The dialogue of a source of requests is written ahead of each request and behind each reply. So the successor
of a dead Client knows what was asked, and asks again for every reply that may not have arrived.
"""

from collections import deque
from collections.abc import Callable, Iterable
from typing import Final, Protocol

import msgspec

from aftbed.core.journal import Entry, EntryKind
from aftbed.core.messages import NodeDied, Reply, Request, SeenAlive, Submit
from aftbed.ftm.client import BACKLOG_MAX, Client
from aftbed.runtime import control

_SENT, _ANSWERED = EntryKind.SENT, EntryKind.ANSWERED
CATCH_UP: Final = 10  # periods: a load that was held up makes good for no more
LOOK_NS: Final = 10_000_000  # between two looks of a Watchdog at its replica: a fifth of its deadline
LOOK_IDLE_NS: Final = 40_000_000  # while the replica has nothing to do


class Device(Protocol):
    """What a node needs of its device. A class that names it as its base gets the defaults of a device
    without descriptors. `port` is the brick's port that it feeds.
    """

    port: str
    polled: bool = True  # it has descriptors to poll, or deadlines

    def fds(self) -> tuple[int, ...]:
        """Descriptors that make `ready` worth calling when they are readable."""
        return ()

    def ready(self, fd: int, now_ns: int) -> None:
        """Handle `fd`, which is readable."""
        raise AssertionError(f"no descriptor {fd}")

    def take(self, now_ns: int) -> Submit | NodeDied | SeenAlive | None:
        """The next message for the brick, or None."""
        ...

    def wait(self, now_ns: int) -> None:
        """Let time pass while the brick's port is closed."""
        return

    def accept(self, reply: Reply, now_ns: int) -> None:
        """Take the reply that the brick sent to `deliver`."""
        raise AssertionError(f"{type(self).__name__} takes no replies")

    def quiet(self) -> None:
        """Send no more requests."""
        ...

    def deadline_ns(self) -> int | None:
        """When `take` is worth calling again at the latest."""
        return None

    def stats(self) -> bytes:
        """Counts, as MessagePack."""
        return msgspec.msgpack.encode({})


class Dialogue(Protocol):
    """Requests and replies with their bytes, as the client saw them."""

    def write(self, now_ns: int, request_id: int, epoch: int, kind: EntryKind, payload: bytes) -> None:
        """Append an entry."""
        ...

    def keep(self, now_ns: int, capture: Callable[[], bytes]) -> None:
        """Keep the state of the Client now and then, where a successor would have too much to read."""
        return


def resume_client(client: Client, history: Iterable[Entry], state: bytes = b"") -> None:
    """Give a new Client the state that follows from its predecessors' dialogues: since `state`, if given."""
    if state:
        client.restore(state)
    waiting, next_id, answered = dict(client.unanswered), client.next_id, set()
    for entry in history:
        if entry.kind is _SENT:
            waiting[entry.request_id] = Request(0, entry.request_id, entry.payload)
            next_id = max(next_id, entry.request_id + 1)
        else:
            answered.add(entry.request_id)
    left = [request for number, request in waiting.items() if number not in answered]
    client.restore(msgspec.msgpack.encode((next_id, left)))


class Load(Device):
    """Requests out of a list. `rate_hz` 0 is a closed loop: the next request follows the reply. Stops after
    `count`; `on_end` is called with the reply behind which all are answered.
    """

    port = "submit"

    def __init__(
        self,
        client: Client,
        dialogue: Dialogue,
        requests: list[bytes],
        count: int,
        rate_hz: float,
        on_end: Callable[[], None] = lambda: None,
    ) -> None:
        self._client, self._dialogue, self._requests, self._count = client, dialogue, requests, count
        self._on_end = on_end
        self._period_ns = round(1e9 / rate_hz) if rate_hz else 0
        self._next_ns = 0
        self.polled = self._period_ns > 0

    def take(self, now_ns: int) -> Submit | None:
        """The next request, if it is due. Written ahead: a successor knows it even if this node dies now."""
        request_id = self._client.next_id
        if request_id > self._count or (
            now_ns < self._next_ns if self._period_ns else self._client.unanswered
        ):
            return None
        payload = self._requests[(request_id - 1) % len(self._requests)]
        if self._period_ns:
            earliest_ns = now_ns - CATCH_UP * self._period_ns
            self._next_ns = max(self._next_ns or now_ns, earliest_ns) + self._period_ns
        self._dialogue.keep(now_ns, self._client.capture)
        self._dialogue.write(now_ns, request_id, 0, _SENT, payload)
        return Submit(payload)

    def accept(self, reply: Reply, now_ns: int) -> None:
        self._dialogue.write(now_ns, reply.request_id, reply.epoch, _ANSWERED, reply.payload)
        if self._client.next_id > self._count and self.done:
            self._on_end()

    def quiet(self) -> None:
        self._count = self._client.next_id - 1

    def deadline_ns(self) -> int | None:
        if not self._period_ns or self._client.next_id > self._count:
            return None
        return self._next_ns

    @property
    def done(self) -> bool:
        """All is asked and answered."""
        return self._client.next_id > self._count and not self._client.unanswered

    def stats(self) -> bytes:
        sent, waiting = self._client.next_id - 1, len(self._client.unanswered)
        return msgspec.msgpack.encode(
            {"sent": sent, "answered": sent - waiting, "unanswered": waiting, "done": self.done}
        )


class CarLink(Protocol):
    """How a runtime reaches a car: by frames on a bus, or by calls in virtual time. Its defaults: nothing."""

    def fds(self) -> tuple[int, ...]:
        """Descriptors that are readable when `read` is worth calling."""
        return ()

    def read(self) -> Iterable[bytes]:
        """The requests that have come."""
        raise AssertionError("no descriptor")

    def advance(self, now_ns: int) -> Iterable[bytes]:
        """The requests that are made as time goes on to `now_ns`."""
        return ()

    def deliver(self, reply: Reply, now_ns: int) -> None:
        """Send `reply` to the brakes."""
        ...

    def deadline_ns(self) -> int | None:
        """When `advance` is worth calling again at the latest."""
        return None

    def counts(self) -> dict[str, object]:
        """The counters of the link."""
        return {}


class CarDevice(Device):
    """The device of a Client between a car's radar and its brakes. Of `BACKLOG_MAX` waiting requests the
    oldest, which has the oldest track, is dropped.
    """

    port = "submit"

    def __init__(self, client: Client, dialogue: Dialogue, link: CarLink) -> None:
        self._client, self._dialogue, self.link = client, dialogue, link
        self._payloads: deque[bytes] = deque()
        self._overrun = 0
        self._quiet = False
        self._sent_ns: dict[int, int] = {}  # of those that are not answered, by request
        self._cycle_us = self._slowest_us = 0.0  # of the last request; of those since `stats` was asked for

    def fds(self) -> tuple[int, ...]:
        return self.link.fds()

    def ready(self, fd: int, now_ns: int) -> None:
        self._keep(self.link.read())

    def _keep(self, payloads: Iterable[bytes]) -> None:
        for payload in payloads:
            if len(self._payloads) >= BACKLOG_MAX:
                self._payloads.popleft()
                self._overrun += 1
            self._payloads.append(payload)

    def take(self, now_ns: int) -> Submit | None:
        """The next request. Written ahead: a successor knows it even if this node dies now."""
        self.wait(now_ns)
        if not self._payloads or self._quiet:
            return None
        payload = self._payloads.popleft()
        self._dialogue.keep(now_ns, self._client.capture)
        self._dialogue.write(now_ns, self._client.next_id, 0, _SENT, payload)
        if len(self._sent_ns) >= BACKLOG_MAX:  # the oldest has been given up
            del self._sent_ns[next(iter(self._sent_ns))]
        self._sent_ns[self._client.next_id] = now_ns
        return Submit(payload)

    def wait(self, now_ns: int) -> None:
        self._keep(self.link.advance(now_ns))

    def accept(self, reply: Reply, now_ns: int) -> None:
        """Send the reply to the brakes, then write it: a reply lost in between is requested again."""
        sent_ns = self._sent_ns.pop(reply.request_id, None)
        if sent_ns is not None:  # not by the predecessor of this node
            self._cycle_us = round((now_ns - sent_ns) / 1e3, 1)
            self._slowest_us = max(self._slowest_us, self._cycle_us)
        self.link.deliver(reply, now_ns)
        self._dialogue.write(now_ns, reply.request_id, reply.epoch, _ANSWERED, reply.payload)

    def quiet(self) -> None:
        self._quiet = True
        self._payloads.clear()

    def deadline_ns(self) -> int | None:
        return self.link.deadline_ns()

    @property
    def done(self) -> bool:
        """Every request that was made is answered."""
        return not self._payloads and not self._client.unanswered

    def stats(self) -> bytes:
        sent, waiting = self._client.next_id - 1, len(self._client.unanswered)
        counts: dict[str, object] = {
            "sent": sent,
            "answered": sent - waiting,
            "unanswered": waiting + len(self._payloads),  # with those that wait to be sent
            "overrun": self._overrun,
            "cycle_us": self._cycle_us,
            "slowest_us": self._slowest_us,
        }
        self._slowest_us = 0.0
        return msgspec.msgpack.encode(counts | self.link.counts())


class Senses(Protocol):
    """How a runtime sees deaths of nodes, and whether they are alive."""

    def watch(self, order: control.WatchNodes, fds: list[int], died: Callable[[str], None]) -> None:
        """Watch these nodes and no others; `died` may be called for each."""
        ...

    def forget(self) -> None: ...

    def fds(self) -> tuple[int, ...]:
        """Descriptors that are readable when a node has died; none where `died` of `watch` is called."""
        return ()

    def died(self, fd: int) -> list[str]:
        """The nodes behind `fd`, which is readable, that have died."""
        raise AssertionError(f"no descriptor {fd}")

    def look(self, now_ns: int) -> tuple[dict[str, int], bool]:
        """When each node was last seen alive: now, if the machine does not let it run; and whether any of
        them did something since the last look, or is not alive.
        """
        ...


class Sensor(Device):
    """The device of a Watchdog: deaths of the nodes of its replica, and when each was last seen alive.

    A replica whose first node has died is lost: the deaths that follow are ignored. A replica that has
    nothing to do is looked at less often, unless one of its nodes is not seen alive.
    """

    port = "sense"

    def __init__(self, senses: Senses) -> None:
        self._senses = senses
        self._nodes: tuple[str, ...] = ()
        self._died: deque[str] = deque()
        self._alarmed = False
        self._next_ns = 0

    def watch(self, order: control.WatchNodes, fds: list[int]) -> None:
        self.quiet()
        self._nodes = order.nodes
        self._senses.watch(order, fds, self._see_death)

    def _see_death(self, node: str) -> None:
        if not self._alarmed:
            self._died.append(node)
            self._alarmed = True

    def fds(self) -> tuple[int, ...]:
        """None after the first death."""
        return () if self._alarmed else self._senses.fds()

    def ready(self, fd: int, now_ns: int) -> None:
        self._died += self._senses.died(fd)
        self._alarmed = bool(self._died)

    def take(self, now_ns: int) -> NodeDied | SeenAlive | None:
        """Deaths first."""
        if self._died:
            return NodeDied(self._died.popleft())
        if now_ns < self._next_ns or not self._nodes or self._alarmed:
            return None
        planned_ns = self._next_ns or now_ns
        seen_ns, busy = self._senses.look(now_ns)
        self._next_ns = max(planned_ns, now_ns - LOOK_NS) + (LOOK_NS if busy else LOOK_IDLE_NS)
        return SeenAlive(now_ns, seen_ns, now_ns - planned_ns)

    def quiet(self) -> None:
        self._senses.forget()
        self._nodes, self._alarmed, self._next_ns = (), False, 0
        self._died.clear()

    def deadline_ns(self) -> int | None:
        return self._next_ns if self._nodes and not self._alarmed else None

"""The devices of nodes that are processes: what a Watchdog senses with, and where the Client's requests come
from.
"""

import os
import select
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final

from aftbed.core.messages import Reply, Submit
from aftbed.ftm.client import Client
from aftbed.functions.source import is_foreign
from aftbed.runtime import control
from aftbed.runtime.devices import CarDevice, CarLink, Device, Dialogue, Load, Senses, resume_client
from aftbed.runtime.unix.death_notice import LifelineWatcher
from aftbed.runtime.unix.journal_files import DialogueFile, dialogue_path, last_words
from aftbed.runtime.unix.liveness import Liveness
from aftbed.runtime.unix.options import GATEWAY, LoadRun, ReplayRun, SourceOptions, Turns
from aftbed.runtime.unix.request_store import stored_requests
from aftbed.vehicle.aeb.function import sample_requests
from aftbed.vehicle.aeb.messages import encode_fixed, encode_request

if TYPE_CHECKING:
    from aftbed.vehicle.gateway import BusGateway

LOAD_REQUESTS: Final = 512


class ProcessSenses(Senses):
    """The `Senses` of a Watchdog: lifelines and pidfds for deaths, looks at what is alive for hangs."""

    def __init__(self) -> None:
        self._nodes: tuple[str, ...] = ()
        self._pidfds: dict[int, str] = {}
        self._liveness: dict[str, Liveness] = {}
        self._lifelines: LifelineWatcher | None = None
        self._deaths: select.epoll | None = None  # all of them: one descriptor to wait for

    def watch(self, order: control.WatchNodes, fds: list[int], died: Callable[[str], None]) -> None:
        """Watch these nodes and no others; `fds` are their pidfds. Deaths are read from `fds()`."""
        self._nodes = nodes = order.nodes
        self._pidfds = dict(zip(fds, nodes, strict=True))
        watched = zip(nodes, order.pids, order.journals, strict=True)
        self._liveness = {node: Liveness(pid, journal) for node, pid, journal in watched}
        self._lifelines = LifelineWatcher(order.journals)
        self._deaths = select.epoll()
        for fd in (self._lifelines.fd, *fds):
            self._deaths.register(fd, select.EPOLLIN)

    def forget(self) -> None:
        if self._deaths is not None:
            self._deaths.close()
        for fd in self._pidfds:
            os.close(fd)
        for liveness in self._liveness.values():
            liveness.close()
        if self._lifelines is not None:
            self._lifelines.close()
        self._pidfds, self._liveness, self._lifelines, self._deaths = {}, {}, None, None

    def fds(self) -> tuple[int, ...]:
        return () if self._deaths is None else (self._deaths.fileno(),)

    def died(self, fd: int) -> list[str]:
        """The nodes that have died: those that the lifelines tell of, or else those that the pidfds do."""
        assert self._deaths is not None and self._lifelines is not None
        ready, found = [fd for fd, _ in self._deaths.poll(0)], []
        if self._lifelines.fd in ready:
            found = [self._nodes[index] for index in self._lifelines.died()]
            if self._lifelines.ended:
                self._deaths.unregister(self._lifelines.fd)
        return found or [self._pidfds[fd] for fd in ready if fd in self._pidfds]

    def look(self, now_ns: int) -> tuple[dict[str, int], bool]:
        seen_ns, busy = {}, False
        for node, liveness in self._liveness.items():
            seen_ns[node] = liveness.seen_ns(now_ns)
            busy = busy or not liveness.idle
        return seen_ns, busy


class BusLink(CarLink):
    """The `CarLink` over a bus: frames in, requests to the Client, replies out as AEB_REQ."""

    def __init__(self, gateway: "BusGateway", port: int, secret: str) -> None:
        from aftbed.vehicle.can.bus import BusOptions, open_bus  # noqa: PLC0415 - see make_source

        self._gateway = gateway
        self._bus = open_bus(BusOptions(port=port, secret=secret, node=GATEWAY, uses=gateway.uses))

    def fds(self) -> tuple[int, ...]:
        return (self._bus.fileno(),)

    def read(self) -> Iterator[bytes]:
        """The requests that all frames that are there make."""
        for frame in self._bus.drain():
            payload = self._gateway.on_frame(frame)
            if payload is not None:
                yield payload
            elif frame.can_id == self._gateway.request_id:
                self._bus.unasked(frame.can_id)
        for notice in self._gateway.noticed():
            self._bus.notice(notice)

    def deliver(self, reply: Reply, now_ns: int) -> None:
        for frame in self._gateway.on_reply(reply.payload, reply.replica, reply.epoch):
            self._bus.send(frame)

    def counts(self) -> dict[str, object]:
        """The frames that the gateway accepted and refused."""
        counts = self._gateway.counts
        return {
            "replies_refused": self._gateway.replies_refused,
            "accepted": counts.accepted,
            "ignored": counts.ignored,
            "refused": counts.refused,
        }


class LoadInTurns(Load):
    """Sends a request only in one of its turns.

    A closed loop sleeps until that begins, and its node with it: the turns of others are far shorter than
    what is taken for a hang. At a rate, what would be due in them is left out.
    """

    def __init__(
        self,
        client: Client,
        dialogue: Dialogue,
        requests: list[bytes],
        count: int,
        rate_hz: float,
        turns: Turns,
        on_end: Callable[[], None],
    ) -> None:
        super().__init__(client, dialogue, requests, count, rate_hz, on_end)
        self._turns = turns

    def take(self, now_ns: int) -> Submit | None:
        if self._period_ns:
            self._next_ns = max(self._next_ns, now_ns + self._turns.left_ns(now_ns))
            return super().take(now_ns)
        if self._client.unanswered:
            return None
        while left_ns := self._turns.left_ns(now_ns):  # again where it has slept through a turn
            time.sleep(left_ns / 1e9)
            now_ns = time.monotonic_ns()
        return super().take(now_ns)


def load_requests(seed: int, count: int, *, fixed: bool) -> list[bytes]:
    """What a load of `count` requests is drawn from, again and again; `fixed` as in `sample_requests`."""
    return sample_requests(seed, min(count, LOAD_REQUESTS), fixed=fixed)


def make_source(client: Client, options: SourceOptions, on_end: Callable[[], None]) -> Device:
    """Where the requests of a Client come from; the Client takes over from its predecessors.

    `on_end`: called when all requests of a load are answered.
    """
    journals, work = Path(options.journals), options.work
    state, since = last_words(journals, options.incarnation)
    resume_client(client, since, state)
    dialogue = DialogueFile(dialogue_path(journals, options.incarnation), "client")
    if isinstance(work, LoadRun):
        if work.requests:
            given = stored_requests(journals.parent)
            assert given, f"the requests are no longer in {journals.parent}"
            requests = list(given)
        else:
            fixed = is_foreign(options.application)
            requests = load_requests(options.seed, work.count, fixed=fixed)
        if work.turns is not None:
            return LoadInTurns(client, dialogue, requests, work.count, work.rate_hz, work.turns, on_end)
        return Load(client, dialogue, requests, work.count, work.rate_hz, on_end)
    # Imported here: the bus costs 150 ms to import, and only the zygote of the bus has it.
    from aftbed.vehicle.can.dbc_file import own_dbc  # noqa: PLC0415
    from aftbed.vehicle.gateway import Gateway  # noqa: PLC0415

    gateway: BusGateway
    encode = encode_fixed if is_foreign(options.application) else encode_request
    if isinstance(work, ReplayRun):
        from aftbed.vehicle.replay.map_file import bind, find_map  # noqa: PLC0415
        from aftbed.vehicle.replay.mapped_gateway import MappedGateway  # noqa: PLC0415

        gateway = MappedGateway(own_dbc(), bind(find_map(work.map), Path(work.dbc)), encode)
    else:
        gateway = Gateway(own_dbc(), encode)
    return CarDevice(client, dialogue, BusLink(gateway, options.port, options.secret))

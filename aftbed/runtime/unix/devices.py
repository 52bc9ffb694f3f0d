"""Devices: what joins a brick's port to the world outside of the graph.

A brick is pure, so something in its host must hold the pidfds that a Watchdog hears of, and the
source of requests behind the Client. A device has descriptors to poll, hands in messages for one
port, and takes what the brick sends to `deliver`.
"""

import os
from collections import deque
from pathlib import Path
from typing import Final, Protocol

import msgspec

from aftbed.core.journal import Entry, entries
from aftbed.core.messages import NodeDied, Pulses, Reply, Submit
from aftbed.ftm.client import Client
from aftbed.ftm.failover import PERIOD_NS
from aftbed.runtime.source import Load, resume_client
from aftbed.runtime.unix import linux
from aftbed.runtime.unix.journal import Dialogue, Header
from aftbed.runtime.unix.lifeline import Watcher

STALE_NS: Final = 35_000_000  # a pulse older than this is looked into; it comes every 20 ms


class Device(Protocol):
    """`port` is the brick's port that it feeds."""

    port: str

    def fds(self) -> tuple[int, ...]:
        """Descriptors that make `ready` worth calling when they are readable."""
        ...

    def ready(self, fd: int, now_ns: int) -> None:
        """`fd` is readable."""
        ...

    def take(self, now_ns: int) -> Submit | NodeDied | Pulses | None:
        """The next message for the brick, or None."""
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


class Sensor:
    """The senses of a Watchdog: lifelines, pidfds, and the pulses in the journals of its replica."""

    port = "sense"

    def __init__(self) -> None:
        self._pidfds: dict[int, str] = {}
        self._headers: dict[str, Header] = {}
        self._nodes: tuple[str, ...] = ()
        self._lifelines: Watcher | None = None
        self._starvation: dict[str, linux.Starvation] = {}
        self._died: deque[str] = deque()
        self._alarmed = False
        self._next_ns = 0

    def watch(
        self, nodes: tuple[str, ...], journals: tuple[str, ...], pids: tuple[int, ...], pidfds: list[int]
    ) -> None:
        """Watch these nodes and no others."""
        self.forget()
        self._pidfds = dict(zip(pidfds, nodes, strict=True))
        self._headers = {n: Header(Path(j)) for n, j in zip(nodes, journals, strict=True)}
        self._nodes, self._lifelines = nodes, Watcher(journals)
        self._starvation = {n: linux.Starvation(pid) for n, pid in zip(nodes, pids, strict=True)}

    def forget(self) -> None:
        """Watch nobody."""
        for fd in self._pidfds:
            os.close(fd)
        for header in self._headers.values():
            header.close()
        if self._lifelines is not None:
            self._lifelines.close()
        self._pidfds, self._headers, self._lifelines = {}, {}, None
        self._alarmed = False
        self._died.clear()

    def fds(self) -> tuple[int, ...]:
        """One pidfd per watched node, and all lifelines together; none after the first death."""
        if self._alarmed:
            return ()
        lifelines = (self._lifelines.fd,) if self._lifelines is not None else ()
        return (*lifelines, *self._pidfds)

    def ready(self, fd: int, now_ns: int) -> None:
        """A replica whose first node has died is lost: the deaths that follow are not looked at."""
        if self._lifelines is not None and fd == self._lifelines.fd:
            self._died += [self._nodes[index] for index in self._lifelines.died()]
        else:
            self._died.append(self._pidfds[fd])
        self._alarmed = bool(self._died)

    def take(self, now_ns: int) -> NodeDied | Pulses | None:
        """Deaths first."""
        if self._died:
            return NodeDied(self._died.popleft())
        if now_ns < self._next_ns or not self._headers or self._alarmed:
            return None
        self._next_ns = now_ns + PERIOD_NS
        return Pulses({node: self._seen_ns(node, now_ns) for node in self._headers})

    def _seen_ns(self, node: str, now_ns: int) -> int:
        """The node's pulse; one that is not let run counts as seen now."""
        pulse_ns, starvation = self._headers[node].pulse_ns(), self._starvation[node]
        if now_ns - pulse_ns < STALE_NS:
            starvation.forget()
        elif starvation.starves(now_ns):
            return now_ns
        return pulse_ns

    def accept(self, reply: Reply, now_ns: int) -> None:
        """Nothing is delivered to a sensor."""
        raise AssertionError("a reply delivered to a Watchdog's sensor")

    def quiet(self) -> None:
        """Watch nobody any more."""
        self.forget()

    def deadline_ns(self) -> int | None:
        """The next look at the pulses."""
        return self._next_ns if self._headers and not self._alarmed else None

    def stats(self) -> bytes:
        """None to give."""
        return msgspec.msgpack.encode({})


def told(dialogues: tuple[str, ...]) -> list[Entry]:
    """What the dialogues of earlier Clients tell, in order."""
    return [entry for path in dialogues for entry in entries(Path(path).read_bytes())]


class LoadOptions(msgspec.Struct, frozen=True):
    """`rate_hz` 0 is a closed loop: the next request follows the reply. Stops after `count`."""

    seed: int
    count: int
    rate_hz: float
    dialogue: str
    earlier: tuple[str, ...] = ()


def make_load(client: Client, options: LoadOptions, requests: list[bytes]) -> Load:
    """A load for a Client that may have had predecessors."""
    resume_client(client, told(options.earlier))
    dialogue = Dialogue(Path(options.dialogue), "client")
    return Load(client, dialogue, requests, options.count, options.rate_hz)

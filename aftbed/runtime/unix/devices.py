"""What the devices of a node that is a process work with: pidfds, lifelines and pulses; a load's options."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.journal import Entry, entries
from aftbed.ftm.client import Client
from aftbed.runtime import control
from aftbed.runtime.devices import Load, resume_client
from aftbed.runtime.unix import linux
from aftbed.runtime.unix.death_notice import Watcher
from aftbed.runtime.unix.journal_files import DialogueFile, Header

STALE_NS: Final = 35_000_000  # a pulse older than this is looked into; it comes every 20 ms


class ProcessSenses:
    """The `Senses` of a Watchdog: lifelines and pidfds for deaths, journals for pulses."""

    def __init__(self) -> None:
        self._pidfds: dict[int, str] = {}
        self._headers: dict[str, Header] = {}
        self._nodes: tuple[str, ...] = ()
        self._lifelines: Watcher | None = None
        self._starvation: dict[str, linux.Starvation] = {}

    def watch(self, order: control.WatchNodes, fds: list[int], died: Callable[[str], None]) -> None:
        """Watch these nodes and no others; `fds` are their pidfds. Deaths are read from `fds()`."""
        nodes = order.nodes
        self._pidfds = dict(zip(fds, nodes, strict=True))
        self._headers = {n: Header(Path(j)) for n, j in zip(nodes, order.journals, strict=True)}
        self._nodes, self._lifelines = nodes, Watcher(order.journals)
        self._starvation = {n: linux.Starvation(pid) for n, pid in zip(nodes, order.pids, strict=True)}

    def forget(self) -> None:
        """Watch no node."""
        for fd in self._pidfds:
            os.close(fd)
        for header in self._headers.values():
            header.close()
        if self._lifelines is not None:
            self._lifelines.close()
        self._pidfds, self._headers, self._lifelines = {}, {}, None

    def fds(self) -> tuple[int, ...]:
        """One pidfd per watched node, and all lifelines together."""
        lifelines = (self._lifelines.fd,) if self._lifelines is not None else ()
        return (*lifelines, *self._pidfds)

    def died(self, fd: int) -> list[str]:
        """`fd` is readable: the nodes that have died."""
        if self._lifelines is not None and fd == self._lifelines.fd:
            return [self._nodes[index] for index in self._lifelines.died()]
        return [self._pidfds[fd]]

    def pulse_ns(self, node: str, now_ns: int) -> int:
        """The node's pulse; now, where the machine does not let the node run."""
        pulse_ns, starvation = self._headers[node].pulse_ns(), self._starvation[node]
        if now_ns - pulse_ns < STALE_NS:
            starvation.forget()
        elif starvation.starves(now_ns):
            return now_ns
        return pulse_ns


def entries_of(dialogues: tuple[str, ...]) -> list[Entry]:
    """The entries of the dialogues of earlier Clients, in order."""
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
    resume_client(client, entries_of(options.earlier))
    dialogue = DialogueFile(Path(options.dialogue), "client")
    return Load(client, dialogue, requests, options.count, options.rate_hz)

"""The Unix runtime, as the executive sees it: see `runtime.interface`."""

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from random import Random
from typing import Final

from aftbed.core.errors import StepFailed
from aftbed.core.graph import Link
from aftbed.core.journal import Record, records
from aftbed.inject.kind import FaultKind
from aftbed.inject.receipts import BusReport
from aftbed.runtime.deployment import Keys
from aftbed.runtime.interface import DRAW_BITS, Met
from aftbed.runtime.interface import Process as AnyProcess
from aftbed.runtime.unix import process_memory
from aftbed.runtime.unix.bus_faults import BusFaults
from aftbed.runtime.unix.event_loop import EventLoop
from aftbed.runtime.unix.journal_files import JournalFile, contents, recorded_requests
from aftbed.runtime.unix.process_pool import UnixProcessPool
from aftbed.runtime.unix.shared_memory import MemfdMemory
from aftbed.runtime.unix.transport import UnixChannel
from aftbed.vehicle.condition import Condition

HISTORY_NAME: Final = "adaptations.jsonl"


class UnixRuntime:
    """Of one run; `record` is its directory."""

    def __init__(
        self,
        record: Path,
        loop: EventLoop,
        pool: UnixProcessPool,
        device: Callable[[str, int], tuple[str, bytes]],
        log: Callable[[str, str], None],
        seed: int = 0,
        bus: BusFaults | None = None,
        private: Path | None = None,
    ) -> None:
        self._record, self._seed, self._bus, self._private = record, seed, bus, private
        self.loop, self.pool, self.device, self.log = loop, pool, device, log
        self.journal = JournalFile(record / "journal" / "supervisor.1.journal", "supervisor")

    def channel(self, link: Link) -> UnixChannel:
        """A fresh pair of sockets."""
        return UnixChannel(link)

    def shared_memory(self) -> MemfdMemory:
        """A fresh memfd."""
        return MemfdMemory()

    def journal_of(self, node: str, incarnation: int) -> str:
        """A file for each life of a node."""
        return str(self._record / "journal" / f"{node.replace('/', '.')}.{incarnation}.journal")

    def records(self, journal: str) -> Iterable[Record]:
        """What is committed in the file; nothing, if its node has died before it made one."""
        try:
            return records(contents(Path(journal)))
        except FileNotFoundError:
            return ()

    def recorded_requests(self) -> tuple[bytes, ...]:
        """From the client's dialogue."""
        return recorded_requests(self._record)

    def draw(self, number: int) -> int:
        """Of the run's seed."""
        return Random(f"{self._seed}/{number}").getrandbits(DRAW_BITS)

    def disturb(self, number: int, fault: FaultKind, draw: int) -> Keys:
        """By the hub."""
        if self._bus is None:
            raise StepFailed(f"{fault}: this run has no bus")
        yield from self._bus.disturb(number, fault, draw)

    def watch(self, number: int, condition: Condition, met: Callable[[Met], None]) -> Keys:
        """By the car, whom the hub asks."""
        if self._bus is None:
            raise StepFailed(f"when {condition}: this run has no car")
        yield from self._bus.watch(number, condition, met)

    def flip_memory(self, process: AnyProcess, bit: int | None, address: int | None, draw: int) -> str:
        """By process_vm_writev(2)."""
        if self._private is None:
            raise StepFailed("nothing tells which processes are of this run")
        return process_memory.flip(
            process_memory.Owner(process.name, process.pid, self._private), bit, address, draw
        )

    def bus_fault(self, number: int) -> BusReport | None:
        """As the hub has said."""
        return self._bus.struck(number) if self._bus is not None else None

    def pin(self, pid: int, cpu: int) -> None:
        """See sched_setaffinity(2)."""
        os.sched_setaffinity(pid, {cpu})

    def record_adaptation(self, adaptation: bytes) -> None:
        """One line in the record."""
        with open(self._record / HISTORY_NAME, "ab") as file:
            file.write(adaptation + b"\n")

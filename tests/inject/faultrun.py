"""The faults of a run whose processes are names with a journal: the test does what a node would do.

The fixture `run` is imported by the tests that use it.
"""

from collections.abc import Callable, Generator, Iterable
from pathlib import Path
from typing import Final, cast

import pytest

from aftbed.core.errors import StepFailed
from aftbed.core.events import Event
from aftbed.ftm.compose import build
from aftbed.inject import model
from aftbed.inject.model import Fault, parse
from aftbed.runtime import control
from aftbed.runtime.fault_controller import FaultController
from aftbed.runtime.interface import ProcessKind
from aftbed.runtime.tasks import Wait
from aftbed.runtime.unix.event_loop import EventLoop
from aftbed.runtime.unix.journal_files import JournalFile
from aftbed.runtime.unix.options import LoadRun, RunOptions
from aftbed.runtime.unix.process_pool import UnixProcessPool
from aftbed.runtime.unix.supervisor import UnixRuntime
from aftbed.runtime.unix.workload import Workload

FIRST: Final = 1_000_001  # the number of a run's first fault


class FakeProcess:
    """A node's process; `wrote` is its journal. A signal kills it, or stops it, at once."""

    def __init__(self, name: str, folder: Path, incarnation: int) -> None:
        self.name, self.pid, self.pidfd, self.kind = name, 10_000 + incarnation, -1, ProcessKind.NODE
        path = folder / f"{name.replace('/', '.')}.{incarnation}.journal"
        self.journal, self.wrote = str(path), JournalFile(path, name)
        self.alive = self.thaws = True
        self.signals: list[int] = []

    def kill(self) -> None:
        self.signals.append(9)
        self.alive = False

    def freeze(self, for_ms: int = 0) -> None:
        self.signals.append(19)

    def thaw(self) -> bool:
        self.signals.append(18)
        return self.thaws

    def stopped(self) -> bool:
        return bool(self.signals)


class FakeSlot:
    """A replica's nodes."""

    def __init__(self, nodes: list[str]) -> None:
        self.nodes = nodes


class FakeDeployment:
    """`told`: the orders, by node. Whoever is killed is dead when the job that did it goes on."""

    def __init__(self, folder: Path, ftm: str, placement: str) -> None:
        self.graph, self.folder = build(ftm, placement), folder
        self.leader, self.backup = "a", "b"
        self.nodes: dict[str, FakeProcess] = {}
        self.told: list[tuple[str, control.Arm | control.SlowDown]] = []
        self.refuses = False
        self.pool = self
        self.made = 0
        self.renew(*self.graph.nodes)
        self.slots = {r: FakeSlot([n for n in self.nodes if n.startswith(f"{r}/")]) for r in "ab"}

    @property
    def processes(self) -> list[FakeProcess]:
        return list(self.nodes.values())

    def renew(self, *names: str) -> None:
        for name in names:
            self.made += 1
            self.nodes[name] = FakeProcess(name, self.folder, self.made)

    def lives(self, node: str) -> bool:
        return node in self.nodes and self.nodes[node].alive

    def ask(self, node: str, make: Callable[[int], control.Arm]) -> Generator[Wait, object, bytes]:
        self.told.append((node, make(1)))
        yield Wait(frozenset())
        if self.refuses:
            raise StepFailed(f"{node}: no")
        return b""

    def order(
        self, process: FakeProcess, make: Callable[[int], control.SlowDown]
    ) -> tuple[tuple[str, str, int], str]:
        self.told.append((process.name, make(1)))
        return ("ack", process.name, 1), process.name

    def answers(self, sent: Iterable[object]) -> Generator[Wait, object, None]:
        list(sent)
        yield Wait(frozenset())
        if self.refuses:
            raise StepFailed("no")

    def fail_over(self) -> None:
        for name, process in self.nodes.items():
            if name.startswith("a/") and name != "a/watchdog":
                process.kill()
        self.leader, self.backup = "b", ""


class Run:
    """The faults of a run, and what was said about them."""

    def __init__(self, folder: Path, ftm: str = "pbr", seed: int = 0, placement: str = "process") -> None:
        self.deployment = FakeDeployment(folder, ftm, placement)
        self.said: list[str] = []
        (folder / "journal").mkdir()
        options = RunOptions("", "", str(folder), ftm, placement, seed, LoadRun(1, 0.0))
        loop, pool = EventLoop(), cast("UnixProcessPool", self.deployment)

        def log(event: str, text: str) -> None:
            self.said.append(f"{event}: {text}")

        ignored = lambda *_: None  # noqa: E731
        work = Workload(options, pool, loop, log, ignored, ignored, ignored)
        self.deployment.runtime = UnixRuntime(options, loop, pool, work, log)
        self.faults = FaultController(self.deployment)  # type: ignore[arg-type]

    def do(self, steps: Generator[Wait, object, None]) -> list[Wait]:
        """Run a job to its end; what it waited for, all of which is so."""
        waits = []
        try:
            waits.append(next(steps))
            while True:
                waits.append(steps.send({}))
        except StopIteration:
            return waits

    def arm(self, text: str, *, live: bool = False) -> Fault:
        fault = parse(text)
        self.do(self.faults.arm(fault, live=live))
        return fault

    def reports(self) -> list[tuple[str, str, str]]:
        """The words, the receipt and the detail of each fault."""
        return [(one.fault, one.receipt.value, one.detail) for one in self.faults.reports()]

    def last_armed(self) -> tuple[str, model.ArmedFault]:
        """The node and the fault of the last order."""
        node, order = self.deployment.told[-1]
        assert not isinstance(order, control.SlowDown)
        (armed,) = order.faults
        return node, armed

    def happened(self, node: str, event: Event, times: int, detail: int = 0, t_ns: int = 2**62) -> None:
        for request_id in range(1, times + 1):
            self.deployment.nodes[node].wrote.write(t_ns, event, request_id, detail)


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return Run(tmp_path)

"""Processes in virtual time: orders, reports and deaths take a while to arrive.

A signal is not instant: for some microseconds its target goes on. A death is seen first by the holder of the
lifeline (the Watchdog), later by the executive, as on Linux: 0.1 to 0.3 ms, and 0.5 to 0.8 ms (see
`runtime.unix.death_notice`).
"""

import functools
from collections import deque
from collections.abc import Callable, Generator

from aftbed.core.errors import ConfigError, FunctionFailedError, StepFailed
from aftbed.core.journal import Record
from aftbed.runtime import control, interface
from aftbed.runtime.assembly import Assembler
from aftbed.runtime.devices import Device, Senses
from aftbed.runtime.interface import ProcessKind
from aftbed.runtime.latencies import (
    BIRTH_NS,
    FIRST_NS,
    LIFELINE_NS,
    LINE_NS,
    PIDFD_NS,
    ROUSED_NS,
    SIGNAL_NS,
    SLEEPS_AFTER_NS,
)
from aftbed.runtime.node import Node
from aftbed.runtime.sim.clock import Clock
from aftbed.runtime.sim.node_io import SimChannel, SimIO, SimNode, SimulatedMemory
from aftbed.runtime.tasks import Key, Wait

MakeDevice = Callable[[control.Assign, SimIO], Device]


class Wire:
    """One direction between the executive and a process, or the news of its death."""

    def __init__(self, number: int, process: "SimProcess | None") -> None:
        self.number, self._process = -number, process

    def reader_names(self) -> frozenset[str] | None:
        """The process, where one was named; else the executive."""
        if self._process is None or self._process.io is None:
            return None
        return frozenset((self._process.io.name,))


class SimProcess:
    """A child of the executive, which becomes one node (see `runtime.interface.Process`)."""

    def __init__(self, number: int, pool: "SimProcessPool") -> None:
        self.name, self.kind, self.journal, self.incarnation = "spare", ProcessKind.SPARE, "", 0
        self.pid = self.pidfd = number
        self.alive = True  # as far as the executive knows
        self.io: SimIO | None = None
        self.bricks: tuple[tuple[str, str], ...] = ()
        self.dead = self._still = False
        self._pool, self._clock = pool, pool.clock
        self._order_ns = self._report_ns = 0  # of the last one that is under way
        self._orders: deque[tuple[control.ToNode, tuple[int, ...]]] = deque()
        self._known: set[type[control.ToNode]] = set()  # kinds of orders that it has had
        self._reports: deque[control.FromNode] = deque()
        self._noticed: list[Callable[[], None]] = []
        self._to_it, self._to_us, self._news = (
            Wire(4 * number, self),
            Wire(4 * number + 1, None),
            Wire(4 * number + 2, None),
        )

    @property
    def node(self) -> SimNode | None:
        return self.io.node if self.io is not None else None

    # -- signals ------------------------------------------------------------------------------

    def kill(self) -> bool:
        """Send SIGKILL, which takes effect some microseconds later."""
        if self.dead:
            return False
        self._clock.message(self._clock.ns + self._clock.between_ns(*SIGNAL_NS), self._to_it, self.die)
        return True

    def freeze(self, for_ms: int = 0) -> bool:
        """Stop it at once. It is not continued after `for_ms`: the simulated executive does not die."""
        if self.dead:
            return False
        self._still = True
        if self.io is not None:
            self.io.freeze()
        self._pool.on_freeze(self, for_ms)
        return True

    def thaw(self) -> bool:
        if self.dead:
            return False
        self._still = False
        if self.io is not None:
            self.io.thaw()
        return True

    def stopped(self) -> bool:
        return self.dead or self._still or (self.io is not None and bool(self.io.frozen_ns))

    def dying(self) -> bool:
        return not self.alive

    def hangs(self, now_ns: int, deadline_ns: int) -> bool:
        return self.alive and self.seen_ns(now_ns) < now_ns - deadline_ns

    def seen_ns(self, now_ns: int) -> int:
        return now_ns if self.io is None else self.io.seen_ns(now_ns)

    # -- death --------------------------------------------------------------------------------

    def die(self) -> None:
        if self.io is not None:
            self.io.die()
        else:
            self.ended("")

    def ended(self, reason: str) -> None:
        """Mark it dead; watchers notice it later."""
        if self.dead:
            return
        self.dead = True
        self._pool.on_end(self, reason)
        for call in self._noticed:
            self._clock.message(self._clock.ns + self._clock.between_ns(*LIFELINE_NS), self._news, call)
        seen_ns = max(self._report_ns, self._clock.ns + self._clock.between_ns(*PIDFD_NS))
        self._clock.message(seen_ns, self._to_us, self._seen)

    def notice(self, call: Callable[[], None]) -> None:
        """Have `call` called when it is dead."""
        if self.dead:
            self._clock.message(self._clock.ns + self._clock.between_ns(*LIFELINE_NS), self._news, call)
        else:
            self._noticed.append(call)

    def _seen(self) -> None:
        self.alive = False
        self._pool.processes.remove(self)
        self._pool.on_death(self)

    # -- the line -----------------------------------------------------------------------------

    def order(self, order: control.ToNode, fds: tuple[int, ...]) -> None:
        if self.dead:
            raise StepFailed(f"{self.name} cannot be reached")
        delay_ns = self._clock.between_ns(*LINE_NS)
        if type(order) not in self._known:
            self._known.add(type(order))
            delay_ns += self._clock.between_ns(*FIRST_NS)
        self._order_ns = max(self._order_ns + 1, self._clock.ns + delay_ns)
        self._orders.append((order, fds))
        self._clock.message(self._order_ns, self._to_it, self.read)

    def read(self) -> None:
        order, fds = self._orders.popleft()
        if self.dead:
            return
        if isinstance(order, control.Assign):
            born_ns = self._clock.ns + self._clock.between_ns(*BIRTH_NS)
            self._order_ns = max(self._order_ns, born_ns)
            self._clock.at(born_ns, lambda: self._become(order, fds))
        elif self.io is not None:
            self.io.order(order, fds)

    def _become(self, order: control.Assign, fds: tuple[int, ...]) -> None:
        if self.dead:
            return
        try:
            self.io = self._pool.build(self, order, fds)
        except (ConfigError, FunctionFailedError) as error:
            self.report(control.Ack(order.token, error=str(error)))
            self.die()
        else:
            if self._still:
                self.io.freeze()

    def report(self, report: control.FromNode) -> None:
        delay_ns = self._clock.between_ns(*LINE_NS) + self._pool.rouse_ns()
        self._report_ns = max(self._report_ns + 1, self._clock.ns + delay_ns)
        self._reports.append(report)
        self._clock.message(self._report_ns, self._to_us, self.on_line)

    def on_line(self) -> None:
        """Hand the oldest report to the executive."""
        self._pool.on_report(self, self._reports.popleft())

    def assigned(self) -> None: ...

    def announce(self) -> None: ...

    def announced(self) -> bool:
        return False


class SimSenses(Senses):
    """The `Senses` of a Watchdog, which is woken by `wake`. `find`: a process by the number in an order."""

    def __init__(self, find: Callable[[int], SimProcess], wake: Callable[[], None]) -> None:
        self._find, self._wake = find, wake
        self._nodes: dict[str, SimProcess] = {}
        self._seen_ns: dict[str, int] = {}

    def watch(self, order: control.WatchNodes, fds: list[int], died: Callable[[str], None]) -> None:
        """Watch these nodes and no others; a node that is dead already is noticed at once."""
        watched = self._nodes = dict(zip(order.nodes, map(self._find, fds), strict=True))

        def noticed(node: str) -> None:
            if watched is self._nodes:
                died(node)
            self._wake()

        for node, process in watched.items():
            process.notice(functools.partial(noticed, node))

    def forget(self) -> None:
        self._nodes, self._seen_ns = {}, {}

    def look(self, now_ns: int) -> tuple[dict[str, int], bool]:
        for name, process in self._nodes.items():
            if name not in self._seen_ns or process.seen_ns(now_ns) == now_ns:
                self._seen_ns[name] = now_ns
        return dict(self._seen_ns), True


class SimProcessPool:
    """Spares without end, at once: what a birth costs is in `BIRTH_NS` (see `runtime.interface`)."""

    def __init__(
        self,
        clock: Clock,
        assembler: Assembler,
        make_device: MakeDevice,
        end: Callable[[int], SimChannel],
        records: Callable[[str], list[Record]],
    ) -> None:
        self.clock = clock
        self._assembler, self._make_device, self._end, self._records = assembler, make_device, end, records
        self.processes: list[SimProcess] = []
        self.by_number: dict[int, SimProcess] = {}
        self.zygotes: dict[str, SimProcess] = {}
        self.cells: list[SimulatedMemory] = []
        self._reported_ns = 0
        self.on_report: Callable[[SimProcess, control.FromNode], None] = lambda process, report: None
        self.on_death: Callable[[SimProcess], None] = lambda process: None
        self.on_end: Callable[[SimProcess, str], None] = lambda process, reason: None
        self.on_freeze: Callable[[SimProcess, int], None] = lambda process, for_ms: None

    def rouse_ns(self) -> int:
        """Extra delay of a report, in ns, because the executive may sleep."""
        asleep = self.clock.ns - self._reported_ns > SLEEPS_AFTER_NS
        self._reported_ns = self.clock.ns
        return self.clock.between_ns(*ROUSED_NS) if asleep else 0

    def spare(self, zygote: str) -> Generator[Wait, dict[Key, bytes], SimProcess]:
        process = SimProcess(len(self.by_number) + 1, self)
        self.by_number[process.pid] = process
        self.processes.append(process)
        yield Wait(frozenset())
        return process

    def wait_for_forks(self, zygote: str) -> Generator[Wait, dict[Key, bytes], None]:
        """Return at once: a virtual fork takes no time."""
        yield Wait(frozenset())

    def refill(self, zygote: str, count: int) -> None:
        """Do nothing: the supply of spares is unlimited."""

    def order(self, process: interface.Process, order: control.ToNode, fds: tuple[int, ...] = ()) -> None:
        """Send an order. Raises StepFailed if the process is gone."""
        assert isinstance(process, SimProcess)
        process.order(order, fds)

    def build(self, process: SimProcess, order: control.Assign, fds: tuple[int, ...]) -> SimIO:
        """The node that `order` describes. Raises ConfigError where a class is no good."""
        records = self._records(order.journal)
        io = SimIO(order.node, self.clock, records, self._end, process.report, process.ended, self.cells)
        self._assembler.build(Node(order.node, io), order, list(fds), lambda: self._make_device(order, io))
        self.clock.at(self.clock.ns, io.run)
        return io

"""One simulated run: the whole graph, the executive, a source of requests, faults and adaptations; one seed.

Two phases, as in TigerBeetle's simulator: while faults fly, only safety is asked for (nothing wrong, doubled
or out of order). When all of them have been, the run must come to rest within a bound: every request has its
answer, no script is under way, redundancy is back. It leaves a history, for the checkers of real runs.
"""

from collections.abc import Callable, Iterable
from random import Random
from typing import Final, NoReturn

import msgspec

from aftbed.adapt.plugins import LoadModule
from aftbed.core.application import Application
from aftbed.core.graph import Graph, Link
from aftbed.core.journal import Entry, EntryKind, History, Record
from aftbed.core.messages import Goal, Scheduled
from aftbed.ftm.client import Client
from aftbed.inject.kind import FaultKind
from aftbed.inject.model import Fault, FaultReport
from aftbed.inject.receipts import BusReport
from aftbed.runtime import control
from aftbed.runtime.adaptations import Outcome
from aftbed.runtime.assembly import Assembler, MakeSetting
from aftbed.runtime.deployment import Keys
from aftbed.runtime.devices import CarDevice, Device, Load, Sensor, resume_client
from aftbed.runtime.hosting import Hosted, hosted
from aftbed.runtime.interface import Met, ProcessKind
from aftbed.runtime.run_controller import RunController, ScriptRun
from aftbed.runtime.sim import ending
from aftbed.runtime.sim.channels import SimChannel
from aftbed.runtime.sim.clock import START_NS, Clock
from aftbed.runtime.sim.devices import SimSenses, VirtualCarLink
from aftbed.runtime.sim.drive import Drive
from aftbed.runtime.sim.givens import SimJournal, check, graph_of, nothing_off_line, requests_of
from aftbed.runtime.sim.node_io import SimIO, SimNode
from aftbed.runtime.sim.processes import SimProcess, SimProcessPool
from aftbed.runtime.sim.shared_memory import SimulatedMemory
from aftbed.runtime.tasks import Wait
from aftbed.vehicle.aeb.function import default_application
from aftbed.vehicle.condition import Condition
from aftbed.vehicle.plant import VehicleResult

STOPPED: Final = "detected stop"  # in the reason of a death
REST_NS_MAX: Final = 3_000_000_000  # from the last fault to the rest, in virtual time
TICK_SECONDS: Final = 0.02  # as the supervisor looks after what no Watchdog watches
STRAY_NS: Final = 5_000_000  # so long after the rest, what comes too late would still be seen
LOOK_EVERY: Final = 32  # events between two looks at whether all is done
EVENTS_MAX: Final = 20_000_000
DRAW_BITS: Final = 63


class Doom(msgspec.Struct, frozen=True):
    """The node of `brick` dies before that effect of the brick, counted from 0 in its first life."""

    brick: str
    effect: int


class Setup(msgspec.Struct, frozen=True):
    """What a run is made of, so that it can be repeated: nothing else has a part in it.

    `count` requests at `rate_hz` (0: the next follows the reply); or those of a car in `scenario`.
    """

    ftm: str = "pbr"
    placement: str = "process"
    seed: int = 0
    count: int = 100
    rate_hz: float = 0.0
    faults: tuple[Fault, ...] = ()
    adaptations: tuple[Scheduled, ...] = ()
    dooms: tuple[Doom, ...] = ()
    scenario: str = ""


class Rest(msgspec.Struct, frozen=True):
    """How a run came to its end; `why_not` is empty if it came to rest in time."""

    why_not: tuple[str, ...]
    lost: bool  # no replica is left
    ended_ns: int
    leader: str
    graph: Graph
    hosted: Hosted
    states: dict[str, str]  # digests of the Servers' states, by replica


class Run(msgspec.Struct, frozen=True):
    """What a run leaves behind."""

    setup: Setup
    history: History
    rest: Rest
    told: tuple[tuple[int, str, str], ...]  # time, event, text
    scripts: tuple[ScriptRun, ...]  # of Recovery
    adaptations: tuple[Outcome, ...]
    faults: tuple[FaultReport, ...]
    failures: tuple[str, ...]  # of asserts, in nodes
    vehicle: VehicleResult | None
    effects: dict[str, int]  # by brick: how many it has performed in its first life
    struck: tuple[tuple[int, str], ...]  # who died, or was stopped, of a fault, and when


class World:
    """The `Support` of a simulated run, and the run itself."""

    def __init__(
        self,
        setup: Setup,
        *,
        function: Callable[[], Application] = default_application,
        requests: list[bytes] | None = None,
        make: MakeSetting | None = None,
        load: LoadModule = nothing_off_line,
        channel: type[SimChannel] = SimChannel,
        clock: Callable[[Random], Clock] = Clock,
    ) -> None:
        self.setup, self._channel = setup, channel
        self._requests = requests if requests is not None else requests_of(0)
        self.loop = clock(Random(setup.seed))
        self._drive = Drive(setup.scenario, setup.seed, self.loop) if setup.scenario else None
        for fault in setup.faults:
            check(fault, self.setup.scenario)
        self.journals: dict[str, list[Record]] = {}
        self.dialogue: list[Entry] = []
        self.told: list[tuple[int, str, str]] = []
        self._ends: dict[int, SimChannel] = {}
        self.failures: list[str] = []
        self.struck: list[tuple[int, str]] = []  # who died, or was stopped, of a fault, and when
        self.effects: dict[str, int] = {}
        self.lost = False
        self.journal = SimJournal(self.journals.setdefault("supervisor.1", []))
        assembler = Assembler(function, load, make)
        self.pool = SimProcessPool(
            self.loop, assembler, self._make_device, self._ends.__getitem__, self._journal_for
        )
        self.controller = RunController(graph_of(setup.ftm, setup.placement), self, None, self._on_loss)
        self.pool.on_report = self._on_report
        self.pool.on_death = self._on_death
        self.pool.on_end = self._on_end
        self.pool.on_freeze = lambda process: self.struck.append((self.loop.ns, process.name))
        self._launched = False

    # -- the runtime, as the executive sees it: see `runtime.interface.Runtime` ------------------

    def channel(self, link: Link) -> SimChannel:
        """A fresh one."""
        channel = self._channel(link, self.loop, len(self._ends) + 1)
        for end in (channel.write, channel.read):
            self._ends[end.number] = channel
        return channel

    def shared_memory(self) -> SimulatedMemory:
        """A fresh one."""
        cell = SimulatedMemory(len(self.pool.cells))
        self.pool.cells.append(cell)
        return cell

    def device(self, kind: str, incarnation: int) -> tuple[str, bytes]:
        """By the kind of its brick."""
        return {"watchdog": "sensor", "client": "source"}.get(kind, ""), b""

    def journal_of(self, node: str, incarnation: int) -> str:
        """A name."""
        return f"{node.replace('/', '.')}.{incarnation}"

    def records(self, journal: str) -> Iterable[Record]:
        """What has been written."""
        return self.journals.get(journal, ())

    def recorded_requests(self) -> tuple[bytes, ...]:
        """The first few of the dialogue."""
        return tuple(e.payload for e in self.dialogue if e.kind is EntryKind.SENT)[:16]

    def draw(self, number: int) -> int:
        """Of the run's seed."""
        return Random(f"{self.setup.seed}/{number}").getrandbits(DRAW_BITS)

    def disturb(self, number: int, fault: FaultKind, draw: int) -> Keys:
        """In the car's own bus."""
        assert self._drive is not None, fault
        self._drive.disturb(number, fault, draw)
        yield Wait(frozenset())

    def watch(self, number: int, condition: Condition, met: Callable[[Met], None]) -> Keys:
        """By the car itself."""
        assert self._drive is not None, condition
        self._drive.watch(number, condition, met)
        yield Wait(frozenset())

    def flip_memory(self, process: object, bit: int | None, address: int | None, draw: int) -> NoReturn:
        """Nobody asks for it: see `givens.check`."""
        raise AssertionError(f"{process} has no memory")

    def bus_fault(self, number: int) -> BusReport | None:
        """By the car's bus."""
        return self._drive.report(number) if self._drive is not None else None

    def pin(self, pid: int, cpu: int) -> None:
        """There are no cores here."""

    def record_adaptation(self, adaptation: bytes) -> None:
        """The outcome has them all."""

    def log(self, event: str, text: str) -> None:
        """For the outcome."""
        self.told.append((self.loop.ns, event, text))

    # -- parts --------------------------------------------------------------------------------

    def _journal_for(self, name: str) -> list[Record]:
        return self.journals.setdefault(name, [])

    def _make_device(self, order: control.Assign, io: SimIO) -> Device:
        if order.device == "sensor":
            by_number = self.pool.by_number

            def notice(number: int, call: Callable[[], None]) -> None:
                def noticed() -> None:
                    call()
                    io.run()

                by_number[number].notice(noticed)

            return Sensor(SimSenses(by_number.__getitem__, notice))
        client = io.node.brick(order.bricks[0].name)
        assert isinstance(client, Client)
        resume_client(client, self.dialogue)
        if self._drive is not None:
            return CarDevice(client, self, VirtualCarLink(*self._drive.seat(io.run)))
        return Load(client, self, self._requests, self.setup.count, self.setup.rate_hz)

    def write(self, now_ns: int, request_id: int, epoch: int, kind: EntryKind, payload: bytes) -> None:
        """An entry of the dialogue."""
        self.dialogue.append(Entry(now_ns, request_id, epoch, kind, payload))

    def _on_report(self, process: SimProcess, report: control.FromNode) -> None:
        self.controller.on_report(process, report)
        self.loop.watch_jobs()

    def _on_death(self, process: SimProcess) -> None:
        self.controller.on_death(process)
        self.loop.watch_jobs()

    def _on_end(self, process: SimProcess, reason: str) -> None:
        if process.node is not None and process.incarnation == 1:
            self._count(process.node)
        flipped = STOPPED in reason and any(fault.action.alters_value for fault in self.setup.faults)
        if (not reason or flipped) and process.kind is not ProcessKind.KILLED:
            self.struck.append((self.loop.ns, process.name))
        if reason.startswith("assertion"):
            self.failures.append(f"{process.name}: {reason}")
            self.log("assert", f"{process.name}: {reason}")

    def _count(self, node: SimNode) -> None:
        for brick in node.bricks.values():
            self.effects.setdefault(brick.name, brick.performed)

    def _on_loss(self) -> None:
        self.lost = True

    # -- the run ------------------------------------------------------------------------------

    def _launch(self) -> Keys:
        yield from self.controller.deployment.launch(held=("client",))
        for fault in self.setup.faults:
            yield from self.controller.faults.arm(fault)
        yield from self.controller.adaptations.schedule(self.setup.adaptations)
        for doom in self.setup.dooms:
            self._doom(doom)

    def _doom(self, doom: Doom) -> None:
        deployment = self.controller.deployment
        process = deployment.nodes.get(deployment.graph.node_of(doom.brick))
        assert isinstance(process, SimProcess) and process.io is not None
        process.io.die_before(doom.brick, doom.effect)

    def _on_launched(self, failure: str) -> None:
        assert not failure, f"the launch of {self.setup}: {failure}"
        self._launched = True
        if self._drive is not None:
            self._drive.go()
        self.controller.inform_recovery(failed=False)
        self.loop.after(TICK_SECONDS, self._tick)
        self.loop.begin()
        self.controller.deployment.leave("client", control.Resume(control.UNANSWERED))

    def _tick(self) -> None:
        self.controller.look_for_hangs()
        self.loop.after(TICK_SECONDS, self._tick)

    def run(self) -> Run:
        """From the launch to the rest."""
        self.start()
        self.end()
        return self.outcome()

    def start(self) -> None:
        """Launch; requests come from here on."""
        self.loop.tasks.start("launch", self._launch(), self._on_launched)
        self.loop.watch_jobs()
        while not self._launched:
            assert self.loop.step(), f"the launch of {self.setup} ends nowhere"
            self.loop.watch_jobs()

    def advance(self, until_ns: int) -> None:
        """Let happen what happens up to that time."""
        while self.loop.heap and self.loop.heap[0][0] <= until_ns:
            self.loop.step()
            self.loop.watch_jobs()
        self.loop.ns = max(self.loop.ns, until_ns)

    def inject(self, fault: Fault) -> None:
        """Arm one more, now. Raises ConfigError where there is no such fault."""
        check(fault, self.setup.scenario)
        fault.check(self.controller.deployment.graph)
        self.loop.tasks.start("inject", self.controller.faults.arm(fault), lambda failure: None)
        self.loop.watch_jobs()

    def adapt(self, goal: Goal) -> None:
        """Ask for an adaptation, now. Raises ConfigError where it is refused at once."""
        self.controller.adaptations.ask(goal, lambda outcome: None)
        self.loop.watch_jobs()

    def end(self) -> None:
        """Come to rest: all requests made, all faults over, everything answered; or to the bound."""
        loop = self.loop
        rested_ns = done_ns = 0
        for _ in range(EVENTS_MAX // LOOK_EVERY):
            if not loop.steps(LOOK_EVERY):
                return
            loop.watch_jobs()
            ended = ending.source_ended(self.controller.deployment, self.setup.count)
            if not done_ns and (ended or (self.lost and self._drive is None)):
                done_ns = loop.ns
            if done_ns:
                rested_ns = (rested_ns or loop.ns) if self.lost or not ending.unrest(self.controller) else 0
            late = loop.ns > self._limit_ns() or (done_ns and loop.ns > done_ns + REST_NS_MAX)
            if late or (rested_ns and loop.ns > rested_ns + STRAY_NS):
                return
        raise AssertionError(f"no end in sight: {self.setup}")

    def _limit_ns(self) -> int:
        """A source that is held up for ever must not hold up the simulator."""
        period = 1 / self.setup.rate_hz if self.setup.rate_hz else 0.001
        seconds = 60.0 if self._drive is not None else self.setup.count * period
        return START_NS + round(seconds * 1e9) + 2 * REST_NS_MAX

    def outcome(self) -> Run:
        """What there is to judge."""
        deployment = self.controller.deployment
        for process in deployment.nodes.values():
            if isinstance(process, SimProcess) and process.node is not None and process.incarnation == 1:
                self._count(process.node)
        rest = Rest(
            () if self.lost else tuple(ending.unrest(self.controller)),
            self.lost,
            self.loop.ns,
            deployment.leader,
            deployment.graph,
            hosted(deployment),
            ending.states_of(deployment),
        )
        return Run(
            self.setup,
            History(self.journals, self.dialogue),
            rest,
            tuple(self.told),
            tuple(self.controller.scripts),
            tuple(self.controller.adaptations.history),
            tuple(self.controller.faults.reports()),
            tuple(self.failures),
            self._drive.result() if self._drive is not None else None,
            self.effects,
            tuple(self.struck),
        )


def simulate(setup: Setup) -> Run:
    """One run."""
    return World(setup).run()

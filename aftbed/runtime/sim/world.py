"""One simulated run: the whole graph, the executive, a source of requests, faults and adaptations; one seed.

Two phases, as in TigerBeetle's simulator: while faults fly, only safety is asked for (nothing wrong, doubled
or out of order). When all of them have been, the run must come to rest within a bound: every request has its
answer, no script is under way, redundancy is back. It leaves a history, for the checkers of real runs.
"""

import contextlib
from collections.abc import Callable, Iterable
from functools import lru_cache
from random import Random
from typing import Final, NamedTuple, NoReturn

import msgspec

from aftbed.core.application import Application
from aftbed.core.errors import FUNCTION_FAILED, ConfigError, FunctionFailedError, PeerError
from aftbed.core.events import Event
from aftbed.core.graph import Graph, Link
from aftbed.core.journal import Entry, EntryKind, History, JournalsInMemory, Record
from aftbed.core.messages import Goal, Reply, Scheduled
from aftbed.ftm.client import Client
from aftbed.ftm.compose import build, replication_of
from aftbed.ftm.pages import PAGE_BYTES
from aftbed.functions.load import NO_CODE, Code
from aftbed.functions.request_file import GivenRequests
from aftbed.functions.source import is_foreign
from aftbed.inject.bus import BusFault
from aftbed.inject.bus_disturber import Disturber
from aftbed.inject.kind import FaultKind
from aftbed.inject.model import Fault, FaultReport
from aftbed.inject.radar import RadarFault, RadarFaults
from aftbed.inject.receipts import BusReport, RadarReport
from aftbed.inject.shared_state import look
from aftbed.runtime import control
from aftbed.runtime.adaptations import Outcome
from aftbed.runtime.assembly import Assembler, MakeSetting
from aftbed.runtime.deployment import Hosted, Keys, digest
from aftbed.runtime.devices import CarDevice, CarLink, Device, Load, Sensor, resume_client
from aftbed.runtime.interface import DRAW_BITS, Met, ProcessKind
from aftbed.runtime.run_controller import RunController, ScriptRun
from aftbed.runtime.sim.clock import START_NS, Clock
from aftbed.runtime.sim.node_io import SimChannel, SimIO, SimNode, SimulatedMemory
from aftbed.runtime.sim.processes import SimProcess, SimProcessPool, SimSenses
from aftbed.runtime.tasks import Wait
from aftbed.vehicle.aeb.function import default_application, sample_requests
from aftbed.vehicle.aeb.messages import encode_fixed, encode_request
from aftbed.vehicle.can.dbc_file import own_dbc
from aftbed.vehicle.condition import Condition
from aftbed.vehicle.drive_virtual import VirtualCar
from aftbed.vehicle.ecus import End
from aftbed.vehicle.plant import STEP_US, VehicleResult
from aftbed.vehicle.scenarios.library import load_scenario

REQUESTS: Final = 512  # of a load; then they repeat
STEP_NS: Final = STEP_US * 1000  # of a car
FUNCTION: Final = "function"  # the event of one that failed
STOPPED: Final = "detected stop"  # in the reason of a death
REST_NS_MAX: Final = 3_000_000_000  # from the last fault to the rest, in virtual time
TICK_SECONDS: Final = 0.02  # between two looks for hangs
STRAY_NS: Final = 5_000_000  # so long after the rest, what comes too late would still be seen
LOOK_EVERY: Final = 32  # events between two looks at whether all is done
EVENTS_MAX: Final = 20_000_000


class Doom(msgspec.Struct, frozen=True):
    """The node of `brick` dies before that effect of the brick, counted from 0 in its first life."""

    brick: str
    effect: int


class Setup(msgspec.Struct, frozen=True):
    """What a run is made of, so that it can be repeated: nothing else has a part in it.

    `count` requests at `rate_hz` (0: the next follows the reply), which are `given` or drawn from a seed; or
    those of a car in `scenario`. `application`: the protected function, "" for the built-in one. With small
    pages (`page_bytes`) its checkpoints travel as those of a large state do.
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
    application: str = ""
    given: GivenRequests | None = None
    page_bytes: int = PAGE_BYTES
    ftti_ms: float = 0.0  # that the judge holds against each fault; 0: none


class Rest(msgspec.Struct, frozen=True):
    """How a run came to its end; `why_not` is empty if it came to rest in time."""

    why_not: tuple[str, ...]
    lost: bool  # no replica is left
    ended_ns: int
    leader: str
    graph: Graph
    hosted: Hosted
    states: dict[str, str]  # digests of the Servers' states, by replica


class StruckNode(NamedTuple):
    """A node that died of a fault, or was stopped: by a fault, for `for_ms` (0: for good), or by a fence."""

    t_ns: int
    node: str
    for_ms: int = 0


class Run(msgspec.Struct, frozen=True):
    """What a run leaves behind."""

    setup: Setup
    history: History
    rest: Rest
    logged: tuple[tuple[int, str, str], ...]  # time, event, text
    scripts: tuple[ScriptRun, ...]  # of Recovery
    adaptations: tuple[Outcome, ...]
    scheduled: tuple[Outcome | None, ...]  # those of the setup, as `Adaptations.scheduled`
    faults: tuple[FaultReport, ...]
    failures: tuple[str, ...]  # of asserts, in nodes
    vehicle: VehicleResult | None
    drive_end: End | None  # None: the car was still under way, or there was none
    drive_us: int  # of bus time
    effects: dict[str, int]  # by brick: how many it has performed in its first life
    struck: tuple[StruckNode, ...]


@lru_cache(maxsize=8)
def requests_of(seed: int, *, fixed: bool = False) -> list[bytes]:
    """The payloads of a seed's load."""
    return sample_requests(seed, REQUESTS, fixed=fixed)


@lru_cache(maxsize=64)
def graph_of(ftm: str, placement: str, application: str = "") -> Graph:
    """The graph that a run begins with."""
    return build(ftm, placement, application=application)


def check(fault: Fault, scenario: str) -> None:
    """Raise ConfigError if a simulated run has nothing that `fault` could strike, or wait for."""
    if not fault.action.simulated:
        raise ConfigError(f"{fault}: simulated processes have no memory of their own; use real ones")
    if scenario:
        return
    if fault.action.needs_car:
        raise ConfigError(f"{fault}: without a scenario there is no radar")
    if fault.action.needs_bus:
        raise ConfigError(f"{fault}: without a scenario there is no bus")
    if fault.trigger.when is not None:
        raise ConfigError(f"{fault}: 'when' looks at the car, and without a scenario there is none")


class ExecutiveJournal:
    def __init__(self, records: list[Record]) -> None:
        self._records = records

    def write(self, now_ns: int, event: Event, request_id: int, detail: int, brick: int = 0) -> None:
        self._records.append(Record(now_ns, event, request_id, detail, "supervisor", brick))


class Drive(CarLink):
    """The car of a simulated run, and the `CarLink` of its client. It begins with the first client.

    The car (`vehicle.drive_virtual`) is advanced on demand, which is once in a cycle of its radar. While a
    condition is waited for, it is driven step by step: what begins on that condition begins at the very
    virtual time of that step and, as in lockstep, before anything else that belongs to the step.
    """

    def __init__(self, setup: Setup, clock: Clock) -> None:
        self._clock = clock
        encode = encode_fixed if is_foreign(setup.application) else encode_request
        scenario = load_scenario(setup.scenario)
        self._car = VirtualCar(scenario, seed=setup.seed, codec=own_dbc(), encode=encode)
        self._faults = Disturber()  # of its bus
        self._radar_faults = RadarFaults()
        self._began_ns = 0
        self._wake: Callable[[], None] = lambda: None
        self._under_way = self._stepping = False

    def join(self, wake: Callable[[], None]) -> "Drive":
        """Serve a client; `wake` is called where there may be requests."""
        self._wake, self._began_ns = wake, self._began_ns or self._clock.ns
        return self

    # -- for the client: see `runtime.devices.CarLink` --------------------------------------------

    def advance(self, now_ns: int) -> Iterable[bytes]:
        """Drive up to `now_ns`: the requests that are made on the way."""
        return self._car.advance(now_ns - self._began_ns)

    def deliver(self, reply: Reply, now_ns: int) -> None:
        self._car.deliver(reply.payload, now_ns - self._began_ns, replica=reply.replica, epoch=reply.epoch)

    def deadline_ns(self) -> int | None:
        due = self._car.due_ns()
        return None if due is None else due + self._began_ns

    # -- for the run ------------------------------------------------------------------------------

    @property
    def over(self) -> bool:
        """Whether the car makes no more requests."""
        return self._car.due_ns() is None

    def go(self) -> None:
        self._under_way = True
        self._step_by_step()

    def result(self) -> VehicleResult:
        """The result so far."""
        return self._car.result()

    @property
    def end(self) -> End | None:
        return self._car.end

    @property
    def t_us(self) -> int:
        """How far the car has come."""
        return self._car.t_us

    def disturb(self, number: int, fault: FaultKind, draw: int) -> None:
        """Arm `fault` in the car's bus or radar. Raises ConfigError where it names what does not exist."""
        now_us = self._car.before(self._t_ns() if self._under_way else 0)
        if isinstance(fault, RadarFault):
            self._radar_faults.arm(number, fault, draw)
            self._car.disturb_radar(self._radar_faults)
            return
        assert isinstance(fault, BusFault), fault
        fault = fault if fault.targets is not None else fault.resolved([own_dbc()])
        self._faults.arm(number, fault, draw, now_us)
        self._car.disturb(self._faults)

    def report(self, number: int) -> BusReport | RadarReport | None:
        """What has become of a fault of the car's bus or radar."""
        reports: list[BusReport | RadarReport] = [*self._faults.reports(), *self._radar_faults.reports()]
        return next((one for one in reports if one.number == number), None)

    def watch(self, number: int, condition: Condition, met: Callable[[Met], None]) -> None:

        def held(t_us: int) -> None:  # in the middle of a step, perhaps of the fault's target
            self._clock.at(self._clock.ns, lambda: self._met(met, t_us))

        self._car.watch(number, condition, held)
        if self._under_way:
            self._step_by_step()

    def _met(self, met: Callable[[Met], None], t_us: int) -> None:
        met(Met(t_us, 0, self._go_on))
        self._clock.watch_jobs()

    def _go_on(self) -> None:
        self._car.go_on(self._t_ns())
        self._clock.at(self._clock.ns, self._wake)

    def _t_ns(self) -> int:
        return self._clock.ns - self._began_ns

    def _step_by_step(self) -> None:
        if self._car.watched and not self._stepping:
            self._stepping = True
            self._clock.at(self._began_ns + -(-self._t_ns() // STEP_NS) * STEP_NS, self._step)

    def _step(self) -> None:
        self._car.pass_time(self._t_ns())
        self._stepping = self._car.watched
        if self._stepping:
            self._clock.at(self._clock.ns + STEP_NS, self._step)


class World:
    """The `Runtime` of a simulated run, and the run itself. `code`: how that of the user is found."""

    def __init__(
        self,
        setup: Setup,
        *,
        function: Callable[[], Application] = default_application,
        requests: list[bytes] | None = None,
        make: MakeSetting | None = None,
        code: Code = NO_CODE,
        channel: type[SimChannel] = SimChannel,
        clock: Callable[[Random], Clock] = Clock,
    ) -> None:
        self.setup, self._channel = setup, channel
        if setup.given is not None:
            drawn = list(setup.given.requests)
        else:
            drawn = requests_of(0, fixed=is_foreign(setup.application))
        self._requests = requests if requests is not None else drawn
        self.loop = clock(Random(setup.seed))
        self._drive = Drive(setup, self.loop) if setup.scenario else None
        for fault in setup.faults:
            check(fault, self.setup.scenario)
        self.journals: dict[str, list[Record]] = {}
        self.dialogue: list[Entry] = []
        self.logged: list[tuple[int, str, str]] = []
        self._ends: dict[int, SimChannel] = {}
        self.failures: list[str] = []
        self.struck: list[StruckNode] = []
        self.effects: dict[str, int] = {}
        self.lost = False
        self.journal = ExecutiveJournal(self.journals.setdefault("supervisor.1", []))
        self._assembler = assembler = Assembler(function, code, make, setup.page_bytes)
        self.pool = SimProcessPool(
            self.loop, assembler, self._make_device, self._ends.__getitem__, self._journal_for
        )
        graph = graph_of(setup.ftm, setup.placement, setup.application)
        self.controller = RunController(graph, self, None, lambda: setattr(self, "lost", True))
        self.pool.on_report = self._on_report
        self.pool.on_death = self._on_death
        self.pool.on_end = self._on_end
        self.pool.on_freeze = lambda process, ms: self.struck.append(
            StruckNode(self.loop.ns, process.name, ms)
        )
        self._launched = False

    # -- the runtime, as the executive sees it: see `runtime.interface.Runtime` ------------------

    def channel(self, link: Link) -> SimChannel:
        channel = self._channel(link, self.loop, len(self._ends) + 1)
        for end in (channel.write, channel.read):
            self._ends[end.number] = channel
        return channel

    def shared_memory(self) -> SimulatedMemory:
        cell = SimulatedMemory(len(self.pool.cells))
        self.pool.cells.append(cell)
        return cell

    def state_file(self) -> None:
        """An answer holds any state."""

    def device(self, kind: str, incarnation: int) -> tuple[str, bytes]:
        return {"watchdog": "sensor", "client": "source"}.get(kind, ""), b""

    def journal_of(self, node: str, incarnation: int) -> str:
        return f"{node.replace('/', '.')}.{incarnation}"

    def records(self, journal: str) -> Iterable[Record]:
        return self.journals.get(journal, ())

    def recorded_requests(self) -> tuple[bytes, ...]:
        return tuple(e.payload for e in self.dialogue if e.kind is EntryKind.SENT)[:16]

    def draw(self, number: int) -> int:
        return Random(f"{self.setup.seed}/{number}").getrandbits(DRAW_BITS)

    def disturb(self, number: int, fault: FaultKind, draw: int) -> Keys:
        assert self._drive is not None, fault
        self._drive.disturb(number, fault, draw)
        yield Wait(frozenset())

    def watch(self, number: int, condition: Condition, met: Callable[[Met], None]) -> Keys:
        assert self._drive is not None, condition
        self._drive.watch(number, condition, met)
        yield Wait(frozenset())

    def flip_memory(self, process: object, bit: int | None, address: int | None, draw: int) -> NoReturn:
        """Never called: see `check`."""
        raise AssertionError(f"{process} has no memory")

    def disturbance(self, number: int) -> BusReport | RadarReport | None:
        return self._drive.report(number) if self._drive is not None else None

    def pin(self, pid: int, cpu: int) -> None:
        """Do nothing: virtual nodes have no cores."""

    def record_adaptation(self, adaptation: bytes) -> None:
        """Do nothing: `outcome` has all adaptations."""

    def log(self, event: str, text: str) -> None:
        self.logged.append((self.loop.ns, event, text))

    # -- parts --------------------------------------------------------------------------------

    def _journal_for(self, name: str) -> list[Record]:
        return self.journals.setdefault(name, [])

    def _make_device(self, order: control.Assign, io: SimIO) -> Device:
        if order.device == "sensor":
            return Sensor(SimSenses(self.pool.by_number.__getitem__, io.run))
        client = io.node.brick(order.bricks[0].name)
        assert isinstance(client, Client)
        resume_client(client, self.dialogue)
        if self._drive is not None:
            return CarDevice(client, self, self._drive.join(io.run))
        return Load(client, self, self._requests, self.setup.count, self.setup.rate_hz)

    def write(self, now_ns: int, request_id: int, epoch: int, kind: EntryKind, payload: bytes) -> None:
        self.dialogue.append(Entry(now_ns, request_id, epoch, kind, payload))

    def keep(self, now_ns: int, capture: Callable[[], bytes]) -> None:
        """Do nothing: a new Client has the whole dialogue."""

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
            self.struck.append(StruckNode(self.loop.ns, process.name))
        if FUNCTION_FAILED in reason:
            self.log(FUNCTION, reason)
        if reason.startswith("assertion"):
            self.failures.append(f"{process.name}: {reason}")
            self.log("assert", f"{process.name}: {reason}")

    def _count(self, node: SimNode) -> None:
        for brick in node.bricks.values():
            self.effects.setdefault(brick.name, brick.performed)

    # -- the run ------------------------------------------------------------------------------

    def _launch(self) -> Keys:
        yield from self.controller.deployment.launch(held=("client",))
        for fault in self.setup.faults:
            yield from self.controller.faults.arm(fault)
        yield from self.controller.adaptations.schedule(self.setup.adaptations)
        for doom in self.setup.dooms:
            io = self._io_of(doom.brick)
            assert io is not None, doom
            io.die_before(doom.brick, doom.effect)

    def _on_launched(self, failure: str) -> None:
        assert not failure, f"the launch of {self.setup}: {failure}"
        self._launched = True
        if self._drive is not None:
            self._drive.go()
        self.controller.inform_recovery(failed=False)
        self.loop.after(TICK_SECONDS, self._tick)
        self.loop.begin()
        self.controller.deployment.leave("client", control.ResumeNode(control.UNANSWERED))

    def _tick(self) -> None:
        self.controller.look_for_hangs()
        self.loop.after(TICK_SECONDS, self._tick)

    def run(self) -> Run:
        """Run from the launch to the state of rest."""
        try:
            self.start()
            self.end()
            return self.outcome()
        finally:
            self._assembler.close()

    def start(self) -> None:
        """Launch; requests are sent from here on."""
        self.loop.tasks.start("launch", self._launch(), self._on_launched)
        self.loop.watch_jobs()
        while not self._launched:
            assert self.loop.step(), f"the launch of {self.setup} ends nowhere"
            self.loop.watch_jobs()

    def advance(self, until_ns: int) -> None:
        """Handle all events up to `until_ns`."""
        while self.loop.heap and self.loop.heap[0][0] <= until_ns:
            self.loop.step()
            self.loop.watch_jobs()
        self.loop.ns = max(self.loop.ns, until_ns)

    def inject(self, fault: Fault) -> None:
        """Arm another fault now. Raises ConfigError where there is no such fault."""
        check(fault, self.setup.scenario)
        fault.check(self.controller.deployment.graph)
        armed = self.controller.faults.arm(fault, live=True)
        self.loop.tasks.start("inject", armed, lambda failure: None)
        self.loop.watch_jobs()

    def adapt(self, goal: Goal) -> None:
        """Request an adaptation now. Raises ConfigError where it is refused at once."""
        self.controller.adaptations.ask(goal, lambda outcome: None)
        self.loop.watch_jobs()

    def end(self) -> None:
        """Wait until all requests are sent and answered and all faults are over, or for the bound."""
        loop = self.loop
        rested_ns = done_ns = 0
        for _ in range(EVENTS_MAX // LOOK_EVERY):
            if not loop.steps(LOOK_EVERY):
                return
            loop.watch_jobs()
            if not done_ns and (self._source_ended() or (self.lost and self._drive is None)):
                done_ns = loop.ns
            if done_ns:
                rested_ns = (rested_ns or loop.ns) if self.lost or not self._unrest() else 0
            late = loop.ns > self._limit_ns() or (done_ns and loop.ns > done_ns + REST_NS_MAX)
            if late or (rested_ns and loop.ns > rested_ns + STRAY_NS):
                return
        raise AssertionError(f"no end in sight: {self.setup}")

    def _io_of(self, brick: str) -> SimIO | None:
        """The node that hosts `brick`, unless it is dead."""
        deployment = self.controller.deployment
        process = deployment.nodes.get(deployment.graph.node_of(brick))
        return process.io if isinstance(process, SimProcess) and not process.dead else None

    def _source_ended(self) -> bool:
        """Whether all requests have been sent, answered or not."""
        io = self._io_of("client")
        if io is None or io.node.device is None:
            return False
        return self._drive.over if self._drive is not None else self._next_request() > self.setup.count

    def _next_request(self) -> int:
        """The id of the request that the Client sends next; 0 if it is dead."""
        io = self._io_of("client")
        client = io.node.brick("client") if io is not None else None
        return client.next_id if isinstance(client, Client) else 0

    def _unrest(self) -> list[str]:
        """Why the run has not come to rest."""
        controller, deployment = self.controller, self.controller.deployment
        io = self._io_of("client")
        device = io.node.device if io is not None else None
        found = []
        if not isinstance(device, Load | CarDevice):
            found.append("no client")
        elif not device.done or not self._source_ended():
            found.append("requests wait")
        found += controller.unrest()
        if any(request < self._next_request() for request in controller.adaptations.awaited):
            found.append("an adaptation waits for a request that was sent")
        if replication_of(deployment.graph.ftm) and not deployment.backup:
            found.append("no redundancy")
        processes = [p for p in deployment.nodes.values() if isinstance(p, SimProcess)]
        return found + [f"{p.name} is dead or stopped" for p in processes if p.stopped()][:1]

    def _states(self) -> dict[str, str]:
        """Digests of states by replica, without replicas that are stopped or whose function has no state."""
        deployment, found = self.controller.deployment, dict[str, str]()
        for replica in filter(None, (deployment.leader, deployment.backup)):
            io = self._io_of(f"{replica}/server")
            if io is not None and not io.frozen_ns:
                with contextlib.suppress(PeerError, FunctionFailedError):
                    state = look(io.node.brick(f"{replica}/server"))
                    found |= {replica: digest(state)} if state else {}
        return found

    def _limit_ns(self) -> int:
        """The end of a run whose source is held up."""
        period = 1 / self.setup.rate_hz if self.setup.rate_hz else 0.001
        seconds = 60.0 if self._drive is not None else self.setup.count * period
        return START_NS + round(seconds * 1e9) + 2 * REST_NS_MAX

    def outcome(self) -> Run:
        """The record of the run, to be judged."""
        deployment = self.controller.deployment
        for process in deployment.nodes.values():
            if isinstance(process, SimProcess) and process.node is not None and process.incarnation == 1:
                self._count(process.node)
        rest = Rest(
            () if self.lost else tuple(self._unrest()),
            self.lost,
            self.loop.ns,
            deployment.leader,
            deployment.graph,
            deployment.hosted(),
            self._states(),
        )
        return Run(
            self.setup,
            History(JournalsInMemory(self.journals), self.dialogue),
            rest,
            tuple(self.logged),
            tuple(self.controller.scripts),
            tuple(self.controller.adaptations.history),
            self.controller.adaptations.scheduled,
            tuple(self.controller.faults.reports()),
            tuple(self.failures),
            self._drive.result() if self._drive is not None else None,
            self._drive.end if self._drive is not None else None,
            self._drive.t_us if self._drive is not None else 0,
            self.effects,
            tuple(self.struck),
        )


def simulate(setup: Setup, code: Code = NO_CODE) -> Run:
    return World(setup, code=code).run()

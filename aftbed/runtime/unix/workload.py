"""Where the requests of a run come from, as the supervisor has it: a load inside the Client; or a car, or a
replayed log, on the bus, which is a process, too (the hub).

The hub also carries out the faults of the bus, and passes on the conditions of the car at which other faults
begin: the car is connected to it.
"""

import contextlib
import json
import os
import socket
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.errors import StepFailed
from aftbed.inject.bus import BusFault
from aftbed.inject.kind import FaultKind
from aftbed.inject.radar import RadarFault
from aftbed.inject.receipts import BusReport, RadarReport, ReceiptState
from aftbed.runtime import control
from aftbed.runtime.deployment import Deployment, Keys
from aftbed.runtime.interface import BUS, LIGHT, Met, ProcessKind
from aftbed.runtime.tasks import STATS_TASK, Key, Wait
from aftbed.runtime.unix.event_loop import EventLoop
from aftbed.runtime.unix.options import PLAYER, CarRun, LoadRun, RunOptions, SourceOptions
from aftbed.runtime.unix.process_pool import UnixProcess, UnixProcessPool
from aftbed.runtime.unix.run_directory import BUS_NAME
from aftbed.vehicle.aeb.messages import Sight
from aftbed.vehicle.condition import Condition
from aftbed.vehicle.plant import Telemetry

ATTACH_SECONDS_MAX: Final = 10.0
LOAD_POLL_SECONDS: Final = (0.2, 0.5)  # between two questions how far a load has come: at least, at most
STALL_SECONDS_MAX: Final = 3.0  # a recovery takes milliseconds, a loss is seen after half a second
SLOWEST_SECONDS: Final = 2.0
SLOWEST_MAX: Final = 100  # the Client is asked no more often than `LOAD_POLL_SECONDS`
CYCLE_EVERY: Final = 10  # reports of the car, after which requests are counted
VEHICLE: Final = "vehicle"
SECRET_BYTES: Final = 16


class CarFaults:
    """Faults of the bus and of the radar, and conditions of the car.

    `settle` ends the wait of tasks for hub and vehicle.
    """

    def __init__(
        self, pool: UnixProcessPool, settle: Callable[[Key], None], log: Callable[[str, str], None]
    ) -> None:
        self._pool, self._settle, self._log = pool, settle, log
        self.hub: UnixProcess | None = None
        self.vehicle: UnixProcess | None = None
        self._faults: dict[int, BusFault | RadarFault] = {}
        self._reports: dict[int, BusReport | RadarReport] = {}
        self._on_met: dict[int, Callable[[Met], None]] = {}
        self.counts: object = None  # what happened on the bus, as last asked for

    def disturb(self, number: int, fault: FaultKind, draw: int) -> Keys:
        """Return when the hub, or the vehicle, has armed the fault. Raises StepFailed."""
        if isinstance(fault, RadarFault):
            if self.vehicle is None or not self.vehicle.alive:
                raise StepFailed(f"{fault.name}: this run has no car, or its drive has ended")
            self._faults[number] = fault
            self._pool.order(self.vehicle, control.DisturbRadar(number, fault, draw))
            yield Wait(frozenset({(control.RADAR_FAULT_ARMED, VEHICLE, number)}), frozenset({VEHICLE}))
            return
        assert isinstance(fault, BusFault), fault
        if self.hub is None or not self.hub.alive:
            raise StepFailed(f"{fault}: this run has no bus")
        if fault.targets is None:
            raise StepFailed(f"{fault}: its names were not resolved")
        self._faults[number] = fault
        self._pool.order(self.hub, control.DisturbBus(number, fault, draw))
        yield Wait(frozenset({(control.BUS_FAULT_ARMED, control.HUB, number)}), frozenset({control.HUB}))

    def watch(self, number: int, condition: Condition, met: Callable[[Met], None]) -> Keys:
        """Return when the car checks the condition. Raises StepFailed."""
        if self.hub is None or not self.hub.alive:
            raise StepFailed(f"when {condition}: this run has no car")
        self._on_met[number] = met
        self._pool.order(self.hub, control.WatchCar(number, condition))
        yield Wait(frozenset({(control.CONDITION_WATCHED, control.HUB, number)}), frozenset({control.HUB}))

    def ask(self) -> Keys:
        """Have the hub report on all faults, and on strangers, once more."""
        if self.hub is not None and self.hub.alive:
            with contextlib.suppress(StepFailed):  # then its earlier reports have to do
                self._pool.order(self.hub, control.Stats(control.UNANSWERED))
                yield Wait(frozenset({(control.BUS_FAULTS_ASKED, control.HUB, 0)}), frozenset({control.HUB}))

    def on_report(self, kind: str, data: bytes) -> None:
        """A report of the hub, or of the vehicle about its radar."""
        if kind == control.RADAR_FAULT_ARMED:
            self._settle((kind, VEHICLE, int(data)))
            return
        if kind in (control.BUS_FAULT_ARMED, control.CONDITION_WATCHED):
            self._settle((kind, control.HUB, int(data)))
            return
        if kind == control.BUS_COUNTS:
            self.counts = msgspec.msgpack.decode(data)
            return
        if kind == control.BUS_STRANGER:
            self._log("bus", data.decode())
            return
        if kind == control.CONDITION_MET:
            number, t_us, since_ns = msgspec.msgpack.decode(data, type=tuple[int, int, int])
            hub, on_met = self.hub, self._on_met.pop(number, None)
            if on_met is not None and hub is not None:
                on_met(Met(t_us, since_ns, lambda: self._pool.order(hub, control.Ack(number))))
            return
        reports: Sequence[BusReport | RadarReport] = (
            msgspec.msgpack.decode(data, type=list[RadarReport])
            if kind == control.RADAR_FAULTS_CHANGED
            else msgspec.msgpack.decode(data, type=list[BusReport])
        )
        for report in reports:
            number, found = report.number, report.receipt
            before = self._reports[number].receipt.state if number in self._reports else ReceiptState.ARMED
            self._reports[number] = report
            if found.state is not before:
                self._log("fault", f"{self._faults[number]}: {found.state.value}, {found.detail}")
        if kind == control.BUS_FAULTS_ASKED:
            self._settle((control.BUS_FAULTS_ASKED, control.HUB, 0))

    def report(self, number: int) -> BusReport | RadarReport | None:
        """The latest report on a fault."""
        return self._reports.get(number)


class Workload:
    """`ended`: the source has. `awaits_replies`: some of its requests may still be answered."""

    deployment: Deployment  # set by the supervisor before anything is started

    def __init__(
        self,
        options: RunOptions,
        pool: UnixProcessPool,
        loop: EventLoop,
        log: Callable[[str, str], None],
        finish: Callable[[str], None],
        report_owner: Callable[[str, bytes], None],
        counted: Callable[[], None],
    ) -> None:
        """`report_owner`: a report to the command; `counted`: what the client has counted is new."""
        self._options, self._pool, self._loop = options, pool, loop
        self._log, self._finish, self._report_owner, self._counted = log, finish, report_owner, counted
        self._is_load = isinstance(options.work, LoadRun)
        self._secret = os.urandom(SECRET_BYTES).hex()  # of the bus: for the processes of this run alone
        self._source = VEHICLE if isinstance(options.work, CarRun) else PLAYER  # of a run with a bus
        self._services: dict[str, UnixProcess] = {}
        self._ready: set[str] = set()  # names of services
        self.bus = CarFaults(pool, loop.tasks.settle, log)
        self._result: object = None
        self._stats: dict[str, object] = {}
        self._slowest: deque[tuple[int, float]] = deque(maxlen=SLOWEST_MAX)  # when it was told, and in us
        self.telemetry: Telemetry | None = None  # of a drive
        self.sight: Sight | None = None  # of a replay
        self.ended, self.awaits_replies = False, True
        self._stalled = False
        self._reported = 0
        self._progress: tuple[object, object] = (None, None)
        self._moved_ns = time.monotonic_ns()

    # -- launch -------------------------------------------------------------------------------

    def device_of(self, kind: str, incarnation: int) -> tuple[str, bytes]:
        """The device of a brick of `kind`, and its options."""
        if kind == "watchdog":
            return "sensor", b""
        if kind != "client":
            return "", b""
        options, journals = self._options, Path(self._options.record) / "journal"
        source = SourceOptions(
            options.work,
            options.seed,
            options.port,
            self._secret,
            str(journals),
            incarnation,
            options.application,
        )
        return "load" if self._is_load else "gateway", msgspec.msgpack.encode(source)

    def spares(self) -> dict[str, int]:
        """How many spares of each zygote the graph and its source take."""
        nodes = len(self.deployment.graph.nodes)
        return (
            {LIGHT: nodes} if self._is_load else {LIGHT: nodes - 1, BUS: 2}
        )  # its source, beside the client

    @property
    def held(self) -> tuple[str, ...]:
        """Nodes that must not begin before faults and adaptations are armed: a load is inside the Client."""
        return ("client",) if self._is_load else ()

    def start_bus(self) -> Keys:
        """Start the hub, which the graph needs."""
        options, work = self._options, self._options.work
        if isinstance(work, LoadRun):
            return
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC
        log = os.open(Path(options.record) / BUS_NAME, flags, 0o600)
        hub = {
            "secret": self._secret,
            "open_to_all": options.bus_open,
            "beacon": f"aftbed run {options.run}",
            "lockstep": work.pace is None,
            "pace": work.pace or 1.0,
            "origin_ns": time.monotonic_ns(),
        }
        yield from self._assign(LIGHT, control.HUB, msgspec.msgpack.encode(hub), (options.listener, log))
        yield from self._until_ready(control.HUB)
        self.bus.hub = self._services[control.HUB]
        os.close(log)
        socket.socket(fileno=options.listener).close()  # only the hub has it from here on

    def prepare(self) -> Keys:
        """Have the vehicle or the player attach to the bus, while the graph is made."""
        options = self._options
        if not self._is_load:
            source = SourceOptions(
                options.work, options.seed, options.port, self._secret, drive=options.drive
            )
            fds = (options.log,) if options.log >= 0 else ()
            yield from self._assign(BUS, self._source, msgspec.msgpack.encode(source), fds)
            for fd in fds:
                os.close(fd)
            self.bus.vehicle = self._services.get(VEHICLE)

    def start(self) -> Keys:
        """The graph is complete: let requests come."""
        if self._is_load:
            yield from self.deployment.ask("client", control.ResumeNode)
            self._poll_load()
            return
        yield from self._until_ready(self._source)
        self._pool.order(self._services[self._source], control.ResumeNode(control.UNANSWERED))
        self._pool.refill(BUS, 1)

    def _assign(self, zygote: str, name: str, options: bytes, fds: tuple[int, ...]) -> Keys:
        """Make a spare the service `name`."""
        process = yield from self._pool.spare(zygote)
        process.name, process.kind = name, ProcessKind.SERVICE
        self._services[name] = process
        self._pool.order(process, control.Serve(control.UNANSWERED, name, options), fds)

    def _until_ready(self, name: str) -> Keys:
        if name not in self._ready:
            yield Wait(frozenset({("ready", name, 0)}), frozenset({name}), ATTACH_SECONDS_MAX)

    # -- while it runs ------------------------------------------------------------------------

    def on_report(self, process: UnixProcess, kind: str, data: bytes) -> None:
        """A report of a service, or of the Client's node."""
        if kind == control.LOAD_ENDED:
            self._load_ended()
        elif kind == "ready":
            self._ready.add(process.name)
            self._loop.tasks.settle(("ready", process.name, 0))
        elif kind in control.BUS_REPORTS:
            self.bus.on_report(kind, data)
        elif kind == control.TELEMETRY:
            self.telemetry = msgspec.msgpack.decode(data, type=Telemetry)
            self._show(kind, data)
        elif kind == control.SIGHT:
            self.sight = msgspec.msgpack.decode(data, type=Sight)
            self._show(kind, data)
        elif kind == "trouble":
            self._log("trouble", f"{process.name}: {data.decode()}")
            self._finish(f"{process.name}: {data.decode()}")
        elif kind == "result" and process.name in (VEHICLE, PLAYER):
            self._result = json.loads(data)
            process.kind = ProcessKind.KILLED  # it has finished: its death is expected
            self._finish("")

    def _show(self, kind: str, data: bytes) -> None:
        """Report what the car does, and now and then what is counted."""
        self._report_owner(kind, data)
        self._reported += 1
        if self._reported % CYCLE_EVERY == 0:
            self._loop.tasks.start(STATS_TASK, self._ask_stats(), lambda _: self._counted())

    @property
    def requests(self) -> control.RequestCounts | None:
        """As last asked for."""
        match self._stats:
            case {"sent": int(sent), "answered": int(answered)}:
                return control.RequestCounts(sent, answered)
        return None

    @property
    def cycle_us(self) -> float | None:
        """At the client, from request to reply; the latest that is known."""
        cycle_us = self._stats.get("cycle_us")
        return cycle_us if isinstance(cycle_us, float | int) else None

    @property
    def slowest_us(self) -> float | None:
        """The longest cycle of the last seconds, such as of a request that waited for a failover.

        The Client tells the longest since it was asked before; this is the longest of `SLOWEST_SECONDS`.
        """
        since_ns = time.monotonic_ns() - round(SLOWEST_SECONDS * 1e9)
        while self._slowest and self._slowest[0][0] < since_ns:
            self._slowest.popleft()
        return max((us for _, us in self._slowest), default=None)

    def _poll_load(self) -> None:
        """Watch the load again when it can be over; now and then, in case nothing moves any more.

        The Client tells when it is over; but one that dies may not have told it.
        """
        work, sent, (pause, longest) = self._options.work, self._stats.get("sent"), LOAD_POLL_SECONDS
        if isinstance(work, LoadRun) and work.rate_hz and isinstance(sent, int):
            pause = min(longest, max(pause, (work.count - sent) / work.rate_hz))
        self._loop.after(pause, self._watch_load)

    def _watch_load(self) -> None:
        """Finish when all is answered, or when nothing moves any more: a lost reply would never come.

        A failover or an adaptation moves, however slow the machine makes it.
        """

        def asked(failure: str) -> None:
            progress, now_ns = (self._stats.get("sent"), self._stats.get("unanswered")), time.monotonic_ns()
            under_way = bool(self._loop.tasks.names())  # it has limits of its own
            if progress != self._progress or under_way:
                self._progress, self._moved_ns = progress, now_ns
            self._counted()
            if self._stats.get("done"):
                self._finish("")
            elif now_ns - self._moved_ns > STALL_SECONDS_MAX * 1e9:
                self._stalled = True
                self._log("stalled", f"no request was sent or answered for {STALL_SECONDS_MAX:g} s")
                self._finish("")
            else:
                self._poll_load()

        self._loop.tasks.start(STATS_TASK, self._ask_stats(), asked)

    def _load_ended(self) -> None:
        """The Client says so: ask for its last counts, show them, and finish."""

        def asked(failure: str) -> None:
            self._counted()
            if self._stats.get("done"):
                self._finish("")

        self._loop.tasks.start(STATS_TASK, self._ask_stats(), asked)

    def _ask_stats(self) -> Keys:
        data = yield from self.deployment.ask("client", control.Stats)
        self._stats = msgspec.msgpack.decode(data)
        if isinstance(slowest_us := self._stats.get("slowest_us"), float) and slowest_us > 0:
            self._slowest.append((time.monotonic_ns(), slowest_us))

    # -- the end ------------------------------------------------------------------------------

    def stop_source(self) -> Keys:
        """No more requests; the vehicle or the player ends with its result so far."""
        for name in (VEHICLE, PLAYER):
            process = self._services.get(name)
            if process is not None and process.alive and process.kind is ProcessKind.SERVICE:
                self._pool.order(process, control.Stop(control.UNANSWERED))
        yield from self.bus.ask()
        yield from self.wind_up()

    def wind_up(self) -> Keys:
        """Have no more requests sent; then count the unanswered ones: an earlier count may be out of date."""
        yield from self.deployment.ask("client", control.StopRequests)
        yield from self.bus.ask()
        yield from self._ask_stats()
        self.ended = self._result is not None or self._is_load
        self.awaits_replies = not self._stalled and bool(self._stats.get("unanswered", 1))

    def end(self) -> dict[str, object]:
        """For the record."""
        return {"result": self._result, "client": self._stats, "bus": self.bus.counts}

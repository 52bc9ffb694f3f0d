"""What makes the requests of a run: a load inside the client, or the car, or a replayed log, on the bus."""

import json
import os
import socket
import time
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Final

import msgspec

from aftbed.runtime import control
from aftbed.runtime.deployment import Deployment, Keys
from aftbed.runtime.interface import BUS, LIGHT, ProcessKind
from aftbed.runtime.tasks import STATS_TASK, Key, Wait
from aftbed.runtime.unix.bus_faults import BusFaults
from aftbed.runtime.unix.devices import LoadOptions
from aftbed.runtime.unix.event_loop import EventLoop
from aftbed.runtime.unix.options import (
    CarRun,
    GatewayOptions,
    LoadRun,
    PlayerOptions,
    ReplayRun,
    RunOptions,
    VehicleOptions,
)
from aftbed.runtime.unix.process_pool import UnixProcess, UnixProcessPool

ATTACH_SECONDS_MAX: Final = 10.0
LOAD_POLL_SECONDS: Final = 0.02
STALL_SECONDS_MAX: Final = 3.0  # a recovery takes milliseconds, a loss is seen after half a second
CYCLE_EVERY: Final = 10  # telemetries: so often the cycle time is shown


class Work:
    """`settled` turns true when the source is at its end and all is answered."""

    def __init__(
        self,
        options: RunOptions,
        pool: UnixProcessPool,
        loop: EventLoop,
        log: Callable[[str, str], None],
        finish: Callable[[str], None],
        report_owner: Callable[[str, bytes], None],
    ) -> None:
        self._options, self._pool, self._loop = options, pool, loop
        self._log, self._finish, self._report_owner = log, finish, report_owner
        self._services: dict[str, UnixProcess] = {}
        self.bus = BusFaults(pool, loop.tasks.settle, log)
        self._result: object = None
        self._stats: dict[str, object] = {}
        self.telemetry: dict[str, object] | None = None
        self.settled = False
        self._telemetries = 0
        self._progress: tuple[object, object] = (None, None)
        self._moved_ns = time.monotonic_ns()

    def device_of(self, kind: str, incarnation: int) -> tuple[str, bytes]:
        """The device of a brick of `kind`, and its options."""
        if kind == "watchdog":
            return "sensor", b""
        if kind != "client":
            return "", b""
        journal = Path(self._options.record) / "journal"
        dialogue = str(journal / f"client.{incarnation}.dialogue")
        earlier = tuple(str(journal / f"client.{i}.dialogue") for i in range(1, incarnation))
        earlier = tuple(path for path in earlier if Path(path).exists())
        work = self._options.work
        if isinstance(work, LoadRun):
            load = LoadOptions(self._options.seed, work.count, work.rate_hz, dialogue, earlier)
            return "load", msgspec.msgpack.encode(load)
        dbc, mapped = (work.dbc, work.map) if isinstance(work, ReplayRun) else ("", "")
        gateway = GatewayOptions(self._options.port, dialogue, earlier, dbc, mapped)
        return "gateway", msgspec.msgpack.encode(gateway)

    def spares_for(self, deployment: Deployment) -> dict[str, int]:
        """How many spares of each zygote the graph takes."""
        nodes = len(deployment.graph.nodes)
        return {LIGHT: nodes} if isinstance(self._options.work, LoadRun) else {LIGHT: nodes - 1, BUS: 1}

    @property
    def held(self) -> tuple[str, ...]:
        """Who must not begin before faults and adaptations are armed: a load is inside the Client."""
        return ("client",) if isinstance(self._options.work, LoadRun) else ()

    def before(self, deployment: Deployment) -> Keys:
        """What must stand before the graph does: the hub."""
        self._deployment = deployment
        work = self._options.work
        if isinstance(work, LoadRun):
            return
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC
        log = os.open(Path(self._options.record) / "bus.log", flags, 0o600)
        options = {"lockstep": work.pace is None, "pace": work.pace or 1.0, "origin_ns": time.monotonic_ns()}
        yield from self._serve(LIGHT, "hub", msgspec.msgpack.encode(options), (self._options.listener, log))
        self.bus.serve(self._services["hub"])
        os.close(log)
        socket.socket(fileno=self._options.listener).close()  # the hub's alone from here on

    def start(self, deployment: Deployment) -> Keys:
        """The graph stands: let requests come."""
        work = self._options.work
        if isinstance(work, LoadRun):
            yield from deployment.ask("client", control.Resume)
            self._loop.after(LOAD_POLL_SECONDS, lambda: self._watch_load(deployment))
            return
        if isinstance(work, CarRun):
            name, options = (
                "vehicle",
                msgspec.msgpack.encode(
                    VehicleOptions(
                        self._options.port, work.scenario, work.pace, work.brake_policy, self._options.seed
                    )
                ),
            )
        else:
            name, options = (
                "player",
                msgspec.msgpack.encode(
                    PlayerOptions(self._options.port, work.log, work.dbc, work.map, work.pace)
                ),
            )
        yield from self._serve(BUS, name, options, ())
        self._pool.order(self._services[name], control.Resume(0))
        self._pool.refill(BUS, 1)

    def _serve(
        self, zygote: str, name: str, options: bytes, fds: tuple[int, ...]
    ) -> Generator[Wait, dict[Key, bytes], None]:
        process = yield from self._pool.spare(zygote)
        process.name, process.kind = name, ProcessKind.SERVICE
        self._services[name] = process
        self._pool.order(process, control.Serve(0, name, options), fds)
        yield Wait(frozenset({("ready", name, 0)}), frozenset({name}), ATTACH_SECONDS_MAX)

    def on_report(self, process: UnixProcess, kind: str, data: bytes) -> None:
        """What a service says."""
        if kind == "ready":
            self._loop.tasks.settle(("ready", process.name, 0))
        elif kind in control.BUS_REPORTS:
            self.bus.on_report(kind, data)
        elif kind == "telemetry":
            self.telemetry = msgspec.msgpack.decode(data)
            self._report_owner("telemetry", data)
            self._telemetries += 1
            if self._telemetries % CYCLE_EVERY == 0:
                self._loop.tasks.start(STATS_TASK, self.ask_stats(self._deployment), self._report_cycle)
        elif kind == "trouble":
            self._log("trouble", f"{process.name}: {data.decode()}")
            self._finish(f"{process.name}: {data.decode()}")
        elif kind == "result" and process.name in ("vehicle", "player"):
            self._result = json.loads(data)
            process.kind = ProcessKind.KILLED  # it is done: its death is no event
            self._finish("")

    def _report_cycle(self, failure: str) -> None:
        if not failure:
            self._report_owner("cycle", json.dumps(self._stats.get("cycle_us")).encode())

    def stop_source(self, deployment: Deployment) -> Keys:
        """No more requests; the car or the player ends with the result so far."""
        for name in ("vehicle", "player"):
            process = self._services.get(name)
            if process is not None and process.alive and process.kind is ProcessKind.SERVICE:
                self._pool.order(process, control.Stop(0))
        yield from self.bus.ask()
        yield from self.wind_up(deployment)

    def wind_up(self, deployment: Deployment) -> Keys:
        """Have nothing more sent, then see what is unanswered: a count from before may be out of date."""
        yield from deployment.ask("client", control.Quiet)
        yield from self.ask_stats(deployment)
        source_is_done = self._result is not None or isinstance(self._options.work, LoadRun)
        self.settled = source_is_done and not self._stats.get("unanswered", 1)

    def _watch_load(self, deployment: Deployment) -> None:
        """Until all is answered, or nothing moves any more: a reply that got lost is waited for in vain."""

        def asked(failure: str) -> None:
            progress, now_ns = (self._stats.get("sent"), self._stats.get("unanswered")), time.monotonic_ns()
            if progress != self._progress:
                self._progress, self._moved_ns = progress, now_ns
            if self._stats.get("done"):
                self._finish("")
            elif now_ns - self._moved_ns > STALL_SECONDS_MAX * 1e9:
                self._log("stalled", f"no request was sent or answered for {STALL_SECONDS_MAX:g} s")
                self._finish("")
            else:
                self._loop.after(LOAD_POLL_SECONDS, lambda: self._watch_load(deployment))

        self._loop.tasks.start(STATS_TASK, self.ask_stats(deployment), asked)

    def ask_stats(self, deployment: Deployment) -> Keys:
        """Ask the client how far it is."""
        data = yield from deployment.ask("client", control.Stats)
        self._stats = msgspec.msgpack.decode(data)

    def end(self) -> dict[str, object]:
        """For the record."""
        return {"result": self._result, "client": self._stats}

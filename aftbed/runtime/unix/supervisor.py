"""The supervisor: starts the graph, executes what Recovery orders, replaces what dies, and ends the run.

It corresponds to the ROS master in the paper's count of processes, and is trusted as that one is. It is not
on the request path: while it sleeps, requests flow. Nothing outlives it: its death kills its children
(`PR_SET_PDEATHSIG`), and the end of the control line to its command ends the run.
"""

import contextlib
import json
import os
import socket
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from random import Random
from typing import Final

import msgspec

from aftbed.core.errors import AftbedError, StepFailed
from aftbed.core.graph import Link
from aftbed.core.journal import Record
from aftbed.ftm.compose import build
from aftbed.inject.kind import FaultKind
from aftbed.inject.receipts import BusReport, RadarReport
from aftbed.runtime import control
from aftbed.runtime.deployment import HANG_NS, Keys
from aftbed.runtime.interface import BUS, DRAW_BITS, LIGHT, Met, Process, ProcessKind
from aftbed.runtime.run_controller import RunController
from aftbed.runtime.tasks import STATS_TASK
from aftbed.runtime.unix import linux, process_memory, run_directory
from aftbed.runtime.unix.cleanup import UndoLedger
from aftbed.runtime.unix.control_server import ControlServer
from aftbed.runtime.unix.event_loop import EventLoop
from aftbed.runtime.unix.journal_files import JournalFile, recorded_requests, stored_records
from aftbed.runtime.unix.liveness import Starvation
from aftbed.runtime.unix.options import COMMAND_GONE, LoadRun, RunOptions
from aftbed.runtime.unix.process_pool import Started, UnixProcess, UnixProcessPool, reap
from aftbed.runtime.unix.run_directory import HISTORY_NAME
from aftbed.runtime.unix.transport import Line, MemfdMemory, MemfdState, UnixChannel, decode_order
from aftbed.runtime.unix.workload import Workload
from aftbed.vehicle.condition import Condition

LOOK_SECONDS: Final = 0.05  # between two looks for hangs
LOG_SECONDS: Final = 0.005  # until a line is written: a failover does not wait for that
# How much may be unread for a report to be sent: of what fits.
PICTURES_BACKLOG_MAX: Final = 0.5
BACKLOG_MAX: Final = {control.EVENT: 0.75, control.FINISHED: 1.0}
COUNTS_SECONDS: Final = 0.2  # between two reports that differ in counts alone, at least
LATE_NS_MAX: Final = 40_000_000  # of a look: beyond it the machine was too busy to judge what hangs
DRAIN_SECONDS_MAX: Final = 2.0
DRAIN_EXCUSED_SECONDS_MAX: Final = 10.0  # a process waited for a CPU, an adaptation was prepared: not counted
DRAIN_SECONDS: Final = 0.001  # between two checks of what is still under way
LOOKS_MAX: Final = 80  # at states that differ: time for a follower on a busy machine
LOOK_AGAIN_SECONDS: Final = 0.005  # at the states
STOP_SECONDS_MAX: Final = 1.0
LOOK_NS_MAX: Final = 20_000_000  # twenty times the pause between two looks
HUB_SECONDS_MAX: Final = 0.2  # for its last frames, and to tell its clients


class UnixRuntime:
    """The Unix runtime as the executive sees it: see `runtime.interface.Runtime`."""

    def __init__(
        self,
        options: RunOptions,
        loop: EventLoop,
        pool: UnixProcessPool,
        work: Workload,
        log: Callable[[str, str], None],
    ) -> None:
        self._options, self._record, self._bus = options, Path(options.record), work.bus
        self.loop, self.pool, self.device, self.log = loop, pool, work.device_of, log
        self.journal = JournalFile(self._record / "journal" / "supervisor.1.journal", "supervisor")

    def channel(self, link: Link) -> UnixChannel:
        """A fresh pair of sockets."""
        return UnixChannel(link)

    def shared_memory(self) -> MemfdMemory:
        """A fresh memfd."""
        return MemfdMemory()

    def state_file(self) -> MemfdState:
        """A fresh memfd."""
        return MemfdState()

    def journal_of(self, node: str, incarnation: int) -> str:
        """A file for each incarnation of a node."""
        return str(self._record / "journal" / f"{node.replace('/', '.')}.{incarnation}.journal")

    def records(self, journal: str) -> Iterable[Record]:
        """What is committed in the file; nothing if its node died before it made one."""
        try:
            return stored_records(Path(journal))[0]
        except FileNotFoundError:
            return ()

    def recorded_requests(self) -> tuple[bytes, ...]:
        """From the dialogue of the first Client."""
        return recorded_requests(self._record)

    def draw(self, number: int) -> int:
        """From the seed of the run."""
        return Random(f"{self._options.seed}/{number}").getrandbits(DRAW_BITS)

    def disturb(self, number: int, fault: FaultKind, draw: int) -> Keys:
        """By the hub, or by the vehicle."""
        return self._bus.disturb(number, fault, draw)

    def watch(self, number: int, condition: Condition, met: Callable[[Met], None]) -> Keys:
        """By the car, through the hub."""
        return self._bus.watch(number, condition, met)

    def disturbance(self, number: int) -> BusReport | RadarReport | None:
        """The latest report of hub or vehicle."""
        return self._bus.report(number)

    def flip_memory(self, process: Process, bit: int | None, address: int | None, draw: int) -> str:
        """By process_vm_writev(2)."""
        owner = process_memory.Owner(process.name, process.pid, Path(self._options.private))
        return process_memory.flip(owner, bit, address, draw)

    def pin(self, pid: int, cpu: int) -> None:
        """By sched_setaffinity(2)."""
        os.sched_setaffinity(pid, {cpu})

    def record_adaptation(self, adaptation: bytes) -> None:
        """One line in the record."""
        with open(self._record / HISTORY_NAME, "ab") as file:
            file.write(adaptation + b"\n")


class Supervisor:
    """One run. `owner` is the control line to the command; its end is the command's."""

    def __init__(
        self, options: RunOptions, owner: socket.socket, zygotes: dict[str, Started], ledger: UndoLedger
    ) -> None:
        self._options, self._zygotes, self._record = options, zygotes, Path(options.record)
        self._started_ns = time.monotonic_ns()
        self._owner = Line(owner, decode_order)
        self._owner.sock.setblocking(False)
        self._events = open(self._record / run_directory.EVENT_LOG_NAME, "ab", buffering=0)  # noqa: SIM115
        self._unwritten: list[bytes] = []  # lines of the log
        self._shown: object = None  # to the command, of the state
        self._counts_due_ns = 0
        self._graph_ms = 0.0
        self._waited_first_ns: dict[int, int] = {}  # for a CPU until the graph was complete, by pid
        self._last_look_ns = self._grace_until_ns = 0
        self._lost = False
        # Of the end: `_reason` is None before it, "" for the good one.
        self._reason: str | None = None
        self._unfinished: list[str] = []
        self._looks_left = LOOKS_MAX
        self._drained_ns = self._prepared_ns = 0  # last look while the end is waited for; preparing meanwhile
        self._states: dict[str, str] = {}  # digests, by replica

        self._loop = EventLoop()
        self.pool = UnixProcessPool(self._loop, self._on_report, self._on_death, ledger, options.application)
        self._work = Workload(
            options, self.pool, self._loop, self._log, self._finish, self._report_owner, self._report_state
        )
        runtime = UnixRuntime(options, self._loop, self.pool, self._work, self._log)
        cpus = sorted(os.sched_getaffinity(0))
        pinned = cpus if options.pin and len(cpus) > 1 else None
        self._controller = RunController(
            build(options.ftm, options.placement, application=options.application),
            runtime,
            pinned,
            self._on_loss,
        )
        self._deployment = self._work.deployment = self._controller.deployment
        self._server = ControlServer(options, self._loop, self._controller, self._work, self._finish)

    # -- life ---------------------------------------------------------------------------------

    def run(self) -> None:
        """From the first fork to the last reaped process."""
        linux.become_subreaper()
        linux.no_core()
        linux.use_short_slices()
        has_bus = not isinstance(self._options.work, LoadRun)
        for name in (BUS, LIGHT) if has_bus else (LIGHT,):
            self.pool.start_zygote(name, self._zygotes.get(name))
        self.pool.park(LIGHT, len(self._deployment.graph.nodes) + self._controller.spares() + has_bus)
        if has_bus:
            self.pool.park(BUS, 2)
        self._server.listen()
        self._loop.read(self._owner.fileno(), self._on_owner)
        self._loop.tasks.start("launch", self._launch(), self._launched)
        self._look()
        self._loop.run()
        self._tear_down()

    def _launch(self) -> Keys:
        yield from self._work.start_bus()
        for zygote, count in self._work.spares().items():
            yield from self.pool.parked_at_least(zygote, count)
        yield from self._work.prepare()
        began_ns = time.monotonic_ns()
        yield from self._deployment.launch(held=self._work.held)
        self._graph_ms = (time.monotonic_ns() - began_ns) / 1e6
        for fault in self._options.faults:
            yield from self._controller.faults.arm(fault)
        yield from self._controller.adaptations.schedule(self._options.adaptations)
        yield from self._work.start()

    def _launched(self, failure: str) -> None:
        if failure:
            self._log("launch.failed", failure)
            self._finish(f"launch failed: {failure}")
            return
        nodes = self._deployment.nodes.values()
        self._waited_first_ns = {process.pid: linux.waited_ns(process.pid) for process in nodes}
        self._log("started", f"{len(nodes)} nodes in {self._graph_ms:.1f} ms")
        self._controller.inform_recovery(failed=False)
        self._server.launched()

    def _look(self) -> None:
        """Look at the nodes: one that no Watchdog watches, and that hangs, is killed, and replaced."""
        now_ns = time.monotonic_ns()
        if now_ns - self._last_look_ns > LOOK_SECONDS * 1e9 + LATE_NS_MAX:
            self._grace_until_ns = now_ns + HANG_NS
        self._last_look_ns = now_ns
        if self._graph_ms and now_ns > self._grace_until_ns:  # births have a limit of their own
            self._controller.look_for_hangs()
        self._loop.after(LOOK_SECONDS, self._look)

    # -- processes ----------------------------------------------------------------------------

    def _on_report(self, process: UnixProcess, report: msgspec.Struct) -> None:
        if isinstance(report, control.Report):
            self._work.on_report(process, report.kind, report.data)
        else:
            self._controller.on_report(process, report)

    def _on_death(self, process: UnixProcess) -> None:
        self._controller.on_death(process)
        if process.kind is ProcessKind.KILLED or self._reason is not None:
            return
        if process.kind is ProcessKind.ZYGOTE:
            self.pool.restart_zygote(process.name)
        elif process.kind is ProcessKind.SERVICE:
            self._finish(f"{process.name} died")

    def _on_loss(self) -> None:
        """A load would wait for ever; a car drives on."""
        self._lost = True
        if isinstance(self._options.work, LoadRun):
            self._finish("")

    # -- the command --------------------------------------------------------------------------

    def _on_owner(self) -> None:
        try:
            got = self._owner.recv()
        except BlockingIOError:
            return
        except (OSError, AftbedError):
            got = None
        for fd in got[1] if got is not None else ():
            os.close(fd)
        if got is None:
            self._loop.forget(self._owner.fileno())
            self._finish(COMMAND_GONE)
        elif isinstance(got[0], control.Stop):
            self._finish("interrupted")

    def _report_owner(self, kind: str, data: bytes) -> None:
        """To the command; dropped if it does not read (Ctrl-Z), since a view must not stop a run.

        Pictures are dropped first, then events, so that there is room for how the run has ended.
        """
        try:
            if linux.backlog(self._owner.sock) <= BACKLOG_MAX.get(kind, PICTURES_BACKLOG_MAX):
                self._owner.send(control.Report(kind, data))
        except OSError:
            return

    def _report_state(self) -> None:
        """To the command, if it is another one. Each change of it but the counts is logged, and so seen."""
        state, now_ns = self._controller.state(self._work.cycle_us, self._work.requests), time.monotonic_ns()
        counts_only = (state.roles, state.ftm, state.adapting) == self._shown
        if counts_only and now_ns < self._counts_due_ns:
            return
        self._shown = (state.roles, state.ftm, state.adapting)
        self._counts_due_ns = now_ns + round(COUNTS_SECONDS * 1e9)
        self._report_owner(control.STATE, msgspec.msgpack.encode(state))

    def _log(self, event: str, text: str) -> None:
        """A line for people, to the record and to the command."""
        line = {"t_ms": self._ms_since_start(), "event": event, "text": text}
        self._unwritten.append(json.dumps(line).encode())
        if len(self._unwritten) == 1:
            self._loop.after(LOG_SECONDS, self._write_log)

    def _ms_since_start(self) -> float:
        return round((time.monotonic_ns() - self._started_ns) / 1e6, 3)

    def _write_log(self) -> None:
        lines, self._unwritten = self._unwritten, []
        self._events.write(b"".join(line + b"\n" for line in lines))
        for line in lines:
            self._report_owner(control.EVENT, line)
        self._report_state()

    # -- the end ------------------------------------------------------------------------------

    def _finish(self, reason: str) -> None:
        """End the run: let what is unanswered be answered, then stop. `""` is the good end."""
        if self._reason is not None:
            return
        self._reason = reason
        self._loop.tasks.start("stop", self._work.stop_source(), lambda _: None)
        self._drained_ns = time.monotonic_ns()
        self._drain(self._drained_ns, self._waited_now_ns())

    def _drain(self, began_ns: int, waited_ns: dict[int, int]) -> None:
        """Wait until all is answered, and what fails or changes has come to its end; or to the limit.

        Of a service that is lost, neither is waited for. `waited_ns`: when this began at `began_ns`. At the
        good end an adaptation is given the time to prepare itself: it imports what is the user's.
        """
        now_ns = time.monotonic_ns()
        if self._controller.adaptations.preparing and not self._reason:
            self._prepared_ns += now_ns - self._drained_ns
        self._drained_ns = now_ns
        unrest = self._work.awaits_replies or bool(self._controller.unrest())
        settled = self._work.ended and (self._lost or not unrest)
        command_gone = self._reason == COMMAND_GONE  # no process waits for a verdict
        if settled and self._looks_left:
            ask = self._deployment.ask_states(self._states)
            self._loop.tasks.start("states", ask, lambda _: self._looked(began_ns, waited_ns))
            return
        if command_gone or settled or self._drains_too_long(began_ns, waited_ns):
            if not settled and not command_gone:
                self._unfinished = self._controller.unrest()
            self._controller.ending = True
            self._loop.end()
            return
        if not len(self._loop.tasks):
            self._loop.tasks.start(STATS_TASK, self._work.wind_up(), lambda _: None)
        self._loop.after(DRAIN_SECONDS, lambda: self._drain(began_ns, waited_ns))

    def _drains_too_long(self, began_ns: int, waited_ns: dict[int, int]) -> bool:
        seconds = (time.monotonic_ns() - began_ns) / 1e9
        if seconds <= DRAIN_SECONDS_MAX:
            return False
        since_ns = [now_ns - waited_ns.get(pid, 0) for pid, now_ns in self._waited_now_ns().items()]
        return drains_too_long(seconds, (max(since_ns) + self._prepared_ns) / 1e9)

    def _waited_now_ns(self) -> dict[int, int]:
        """How long each process of the run has waited for a CPU so far, by pid; this one included."""
        pids = [os.getpid(), *(process.pid for process in self.pool.processes if process.pid)]
        return {pid: linux.waited_ns(pid) for pid in pids}

    def _looked(self, began_ns: int, waited_ns: dict[int, int]) -> None:
        """A replica may have yet to apply what was sent to it: look again, for a time."""
        self._looks_left = self._looks_left - 1 if len(set(self._states.values())) > 1 else 0
        pause_s = LOOK_AGAIN_SECONDS if self._looks_left else 0.0
        self._loop.after(pause_s, lambda: self._drain(began_ns, waited_ns))

    @property
    def reason(self) -> str | None:
        """Why the run ends; None before it does, `""` for the good end."""
        return self._reason

    def _tear_down(self) -> None:
        """Kill and reap all processes, and report how the run ended."""
        self._write_log()
        living = self._deployment.hosted()
        waits = [linux.waited_ns(pid) - before for pid, before in self._waited_first_ns.items()]
        left = self._kill_all()
        end = {
            "reason": self._reason,
            "ended_ns": time.monotonic_ns(),
            "seconds": round(self._ms_since_start() / 1e3, 3),
            "graph_ms": round(self._graph_ms, 3),
            "left": left,
            "unfinished": self._unfinished,
            "lost": self._lost,
            "leader": self._deployment.leader,
            "backup": self._deployment.backup,
            "hosted": msgspec.to_builtins(living) if self._graph_ms else None,  # the graph was never complete
            "states": self._states,
            "starved_ms": round(max(waits, default=0) / 1e6, 3),  # of the node that waited longest for a CPU
            "epoch": self._deployment.epoch,
            "faults": msgspec.to_builtins(self._controller.faults.reports()),
            **self._work.end(),
        }
        new = self._record / "end.json.new"
        new.write_text(json.dumps(end))
        new.rename(self._record / "end.json")  # complete, or not there
        self._report_owner(control.FINISHED, json.dumps(end).encode())

    def _let_end(self, hub: UnixProcess) -> None:
        """Give the hub time to tell its clients that the run has ended."""
        with contextlib.suppress(StepFailed, OSError):
            self.pool.order(hub, control.Stop(control.UNANSWERED))
            linux.ends(hub.pidfd, HUB_SECONDS_MAX)

    def _kill_all(self) -> list[str]:
        """Kill all processes and reap them; what is left after a second in which they had a CPU to die on.

        Of each its name, pid and state (proc(5)): `D` waits for the kernel, `Z` is held by a tracer.
        Watchdogs and Recovery come first, so that the shutdown triggers no failover; see `killed_in_turn`.
        """
        dying = self.pool.processes
        starvation = {p.pid: Starvation(p.pid) for p in dying if p.pid}
        began_ns = time.monotonic_ns()
        for one in starvation.values():
            one.starves(began_ns)  # counts from here
        for process in sorted(dying, key=UnixProcess.killed_in_turn):
            if process is self._work.bus.hub and process.alive:
                self._let_end(process)
            process.kill()
        patience = Patience(STOP_SECONDS_MAX, time.monotonic_ns())
        while dying:
            before = len(dying)
            for process in list(dying):
                if not process.pid or reap(process):
                    process.close()
                    dying.remove(process)
            now_ns = time.monotonic_ns()
            late = patience.ends(now_ns) and len(dying) == before
            if late and not any(starvation[p.pid].starves(now_ns) for p in dying):
                break  # while some die, the rest may become ours to reap: a zygote's children
            time.sleep(0.001)  # no event to wait for: a killed process is a matter of a millisecond
        left = [f"{p.name} ({p.pid}), state {starvation[p.pid].state()}" for p in dying]
        for one in starvation.values():
            one.close()
        return left


class Patience:
    """A wait of `seconds` by one look after the other.

    Of the time between two looks `LOOK_NS_MAX` counts: a supervisor that the machine did not let run has not
    waited meanwhile, and what it waits for may not have run either.
    """

    def __init__(self, seconds: float, now_ns: int) -> None:
        self._left_ns, self._looked_ns = seconds * 1e9, now_ns

    def ends(self, now_ns: int) -> bool:
        """Whether this look is behind the end of the wait."""
        self._left_ns -= min(now_ns - self._looked_ns, LOOK_NS_MAX)
        self._looked_ns = now_ns
        return self._left_ns < 0


def drains_too_long(seconds: float, excused_s: float) -> bool:
    """Whether the end is no longer waited for: after `DRAIN_SECONDS_MAX` in which all processes could run.

    `excused_s`: for how long in these `seconds` the process that waited longest was not let run, and an
    adaptation was being prepared.
    """
    return seconds > DRAIN_SECONDS_MAX + min(excused_s, DRAIN_EXCUSED_SECONDS_MAX)


def supervise(
    options: RunOptions, owner: socket.socket, zygotes: dict[str, Started], ledger: UndoLedger
) -> None:
    """Be the supervisor of a run, in a process of its own; the first zygote has been started.

    Raises OSError or HarnessError if the machine does not let the run go on or be recorded. Such a run has no
    `end.json`: how it would have ended is not known.
    """
    supervisor = Supervisor(options, owner, zygotes, ledger)
    try:
        supervisor.run()
    finally:
        for process in supervisor.pool.processes:
            process.kill()
    if supervisor.reason == COMMAND_GONE:
        run_directory.remove(Path(options.private))  # the warden does the same, if it lives

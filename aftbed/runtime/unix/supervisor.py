"""The supervisor: starts the graph, carries out what Recovery orders, replaces what dies, ends it all.

It has the place of the ROS master in the paper's count of processes, and it is trusted as that one is.
It is not on the request path: while it sleeps, requests flow. It outlives nobody: its death kills its
children (`PR_SET_PDEATHSIG`), and the end of its owner's line ends the run.
"""

import json
import os
import socket
import time
from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.errors import AftbedError
from aftbed.ftm.compose import build
from aftbed.runtime import control
from aftbed.runtime.deployment import HANG_NS, Keys
from aftbed.runtime.interface import BUS, LIGHT, ProcessKind
from aftbed.runtime.run_controller import RunController
from aftbed.runtime.tasks import STATS_TASK
from aftbed.runtime.unix import linux
from aftbed.runtime.unix.cleanup import UndoLedger
from aftbed.runtime.unix.control_server import ControlServer
from aftbed.runtime.unix.event_loop import EventLoop
from aftbed.runtime.unix.options import COMMAND_GONE, LoadRun, RunOptions
from aftbed.runtime.unix.process_pool import UnixProcess, UnixProcessPool
from aftbed.runtime.unix.spawn import Started
from aftbed.runtime.unix.support import UnixRuntime
from aftbed.runtime.unix.transport import Line, decode_order
from aftbed.runtime.unix.workload import Work

TICK_SECONDS: Final = 0.02
TELL_SECONDS: Final = 0.005
LATE_NS_MAX: Final = 40_000_000
DRAIN_SECONDS_MAX: Final = 2.0
DRAIN_SECONDS: Final = 0.005  # between two looks at what is still under way
LOOKS_MAX: Final = 80  # at states that differ: time for a follower on a busy machine
STOP_SECONDS_MAX: Final = 1.0


class Supervisor:
    """One run. `owner` is the line to the command; its end is the command's."""

    def __init__(
        self, options: RunOptions, owner: socket.socket, zygotes: dict[str, Started], ledger: UndoLedger
    ) -> None:
        self.options, self._zygotes = options, zygotes
        self.record = Path(options.record)
        self.started_ns = time.monotonic_ns()
        self.owner = Line(owner, decode_order)
        self.owner.sock.setblocking(False)
        self.loop = EventLoop()
        self.pool = UnixProcessPool(self.loop, self._on_report, self._on_death, ledger)
        self._events = open(self.record / "events.jsonl", "ab", buffering=0)  # noqa: SIM115 - for the whole run
        self._ending = ""
        self._told: list[bytes] = []
        self._finish_reason = ""
        self._grace_until_ns = 0
        self.graph_ms = 0.0
        self._incomplete: list[str] = []
        self._lost, self._looks_left = False, LOOKS_MAX
        self._waited_ns: dict[int, int] = {}
        self._states: dict[str, str] = {}  # digests, by replica, at the end
        self._last_tick_ns = 0
        self._situation_wanted = False
        graph = build(options.ftm, options.placement)
        cpus = sorted(os.sched_getaffinity(0))
        pinned = cpus if options.pin and len(cpus) > 1 else None
        self.work = Work(options, self.pool, self.loop, self.log, self._finish, self._report_owner)
        runtime = UnixRuntime(
            self.record,
            self.loop,
            self.pool,
            self.work.device_of,
            self.log,
            options.seed,
            self.work.bus,
            Path(options.private),
        )
        self.controller = RunController(graph, runtime, pinned, self._on_loss)
        self.deployment, self.faults = self.controller.deployment, self.controller.faults
        self.adaptations = self.controller.adaptations
        self.questions = ControlServer(
            options, self.loop, self.deployment, self.faults, self.adaptations, self.work, self._finish
        )

    # -- life ---------------------------------------------------------------------------------

    def run(self) -> None:
        """From the first fork to the last reaped process."""
        linux.become_subreaper()
        linux.no_core()
        linux.answer_soon()
        wants_bus = BUS in self._zygotes
        for name in (BUS, LIGHT) if wants_bus else (LIGHT,):
            self.pool.start_zygote(name, self._zygotes.get(name))
        self.pool.park(LIGHT, len(self.deployment.graph.nodes) + self.controller.spares() + wants_bus)
        if wants_bus:
            self.pool.park(BUS, 2)
        self.questions.listen()
        self.loop.read(self.owner.fileno(), self._on_owner)
        self.loop.tasks.start("launch", self._launch(), self._launched)
        self._tick()
        self.loop.run()
        self._teardown()

    def _launch(self) -> Keys:
        yield from self.work.before(self.deployment)
        for zygote, count in self.work.spares_for(self.deployment).items():
            yield from self.pool.parked_at_least(zygote, count)
        began_ns = time.monotonic_ns()
        yield from self.deployment.launch(held=self.work.held)
        self.graph_ms = (time.monotonic_ns() - began_ns) / 1e6
        for fault in self.options.faults:
            yield from self.faults.arm(fault)
        yield from self.adaptations.schedule(self.options.adaptations)
        yield from self.work.start(self.deployment)

    def _launched(self, failure: str) -> None:
        if failure:
            self.log("launch.failed", failure)
            self._finish(f"launch failed: {failure}")
            return
        self._waited_ns = {p.pid: linux.waited_ns(p.pid) for p in self.deployment.nodes.values()}
        self.log("started", f"{len(self.deployment.nodes)} nodes in {self.graph_ms:.1f} ms")
        self.controller.inform_recovery(failed=False)
        self.questions.launched()

    def _on_owner(self) -> None:
        try:
            got = self.owner.recv()
        except BlockingIOError:
            return
        except (OSError, AftbedError):
            got = None
        for fd in got[1] if got is not None else ():
            os.close(fd)
        if got is None or isinstance(got[0], control.Stop):
            self._finish(COMMAND_GONE if got is None else "interrupted")
            if got is None:
                self.loop.forget(self.owner.fileno())

    def _report_owner(self, kind: str, data: bytes) -> None:
        """For the command; dropped where it does not read, since a view must not stop a run."""
        try:
            self.owner.send(control.Report(kind, data))
        except OSError:
            return

    def log(self, event: str, text: str) -> None:
        """A line for people: to the record, and to the command. Soon, since a failover does not wait."""
        t_ms = round((time.monotonic_ns() - self.started_ns) / 1e6, 3)
        self._told.append(json.dumps({"t_ms": t_ms, "event": event, "text": text}).encode())
        if len(self._told) == 1:
            self.loop.after(TELL_SECONDS, self._tell_all)

    def _tell_all(self) -> None:
        told, self._told = self._told, []
        self._events.write(b"".join(line + b"\n" for line in told))
        for line in told:
            self._report_owner("event", line)

    # -- the end ------------------------------------------------------------------------------

    def _finish(self, reason: str) -> None:
        """End the run: let what is unanswered be answered, then stop. `""` is the good end."""
        if self._ending:
            return
        self._ending = reason or "done"
        self._finish_reason = reason
        limit_ns = time.monotonic_ns() + round(DRAIN_SECONDS_MAX * 1e9)
        self.loop.tasks.start("stop", self.work.stop_source(self.deployment), lambda _: None)
        self._drain(limit_ns)

    def _drain(self, limit_ns: int) -> None:
        """Wait until all is answered, and what fails or changes has come to its end; or to the limit."""
        settled = self.work.settled and (self._lost or not self.controller.unrest())
        if settled and self._looks_left:
            ask = self.deployment.ask_states(self._states)
            self.loop.tasks.start("states", ask, lambda _: self._looked(limit_ns))
            return
        if self.owner_gone() or settled or time.monotonic_ns() > limit_ns:
            if not settled and not self.owner_gone():
                self._incomplete = self.loop.tasks.names()
            self.controller.ending = True
            self.loop.end()
            return
        if not len(self.loop.tasks):
            self.loop.tasks.start(STATS_TASK, self.work.wind_up(self.deployment), lambda _: None)
        self.loop.after(DRAIN_SECONDS, lambda: self._drain(limit_ns))

    def _looked(self, limit_ns: int) -> None:
        """A replica may have yet to apply what was sent to it: look again, for a time."""
        self._looks_left -= 1
        if len(set(self._states.values())) <= 1:
            self._looks_left = 0
        pause_s = DRAIN_SECONDS if self._looks_left else 0.0
        self.loop.after(pause_s, lambda: self._drain(limit_ns))

    def owner_gone(self) -> bool:
        """Nobody waits for a verdict."""
        return self._finish_reason == COMMAND_GONE

    def _teardown(self) -> None:
        """Kill what is left, reap it, say how it ended, and leave."""
        self._tell_all()
        living = self.deployment.hosted()
        waits = [linux.waited_ns(pid) - before for pid, before in self._waited_ns.items()]
        left = self._bury()
        end = {
            "reason": self._finish_reason,
            "ended_ns": time.monotonic_ns(),
            "seconds": round((time.monotonic_ns() - self.started_ns) / 1e9, 3),
            "graph_ms": round(self.graph_ms, 3),
            "left": left,
            "unfinished": self._incomplete,
            "lost": self._lost,
            "leader": self.deployment.leader,
            "backup": self.deployment.backup,
            "hosted": msgspec.to_builtins(living),
            "states": self._states,
            "starved_ms": round(max(waits, default=0) / 1e6, 3),  # of the node that waited longest for a CPU
            "epoch": self.deployment.epoch,
            "faults": msgspec.to_builtins(self.faults.reports()),
            **self.work.end(),
        }
        unfinished = self.record / "end.json.new"
        unfinished.write_text(json.dumps(end))
        unfinished.rename(self.record / "end.json")  # whole, or not there
        self._report_owner("finished", json.dumps(end).encode())

    def _bury(self) -> list[str]:
        """Kill all, and reap what dies; what is left after a second. The dying need a CPU, too.

        Whoever watches is killed first: the end of the run is nothing to recover from.
        """
        dying = self.pool.processes
        starvation = {p.pid: linux.Starvation(p.pid) for p in dying if p.pid}
        began_ns = time.monotonic_ns()
        for watch in starvation.values():
            watch.starves(began_ns)  # counts from here
        for process in sorted(dying, key=UnixProcess.watches, reverse=True):
            process.kill()
        while dying:
            before = len(dying)
            for process in list(dying):
                if not process.pid or linux.reap(process.pid) is not None:
                    process.close()
                    dying.remove(process)
            now_ns = time.monotonic_ns()
            late = now_ns - began_ns > STOP_SECONDS_MAX * 1e9 and len(dying) == before
            if late and not any(starvation[p.pid].starves(now_ns) for p in dying):
                break  # while some die, the rest may become ours to reap: a zygote's children
            time.sleep(0.001)  # no event to wait for: a killed process is a matter of a millisecond
        return [f"{p.name} ({p.pid})" for p in dying]

    # -- what processes say -------------------------------------------------------------------

    def _on_report(self, process: UnixProcess, report: msgspec.Struct) -> None:
        if isinstance(report, control.Report):
            self.work.on_report(process, report.kind, report.data)
        else:
            self.controller.on_report(process, report)

    # -- deaths and hangs ---------------------------------------------------------------------

    def _on_death(self, process: UnixProcess) -> None:
        self.controller.on_death(process)
        if process.kind is ProcessKind.KILLED or self._ending:
            return
        if process.kind is ProcessKind.ZYGOTE:
            self.pool.restart_zygote(process.name)
        elif process.kind is ProcessKind.SERVICE:
            self._finish(f"{process.name} died")

    def _on_loss(self) -> None:
        """A load would wait for ever; a car drives on."""
        self._lost = True
        if isinstance(self.options.work, LoadRun):
            self._finish("")

    def _tick(self) -> None:
        """Look after the pulses of what no Watchdog watches: a node that hangs is killed, and replaced."""
        now_ns = time.monotonic_ns()
        late = now_ns - self._last_tick_ns > TICK_SECONDS * 1e9 + LATE_NS_MAX
        if late:
            self._grace_until_ns = now_ns + HANG_NS
        self._last_tick_ns = now_ns
        self.deployment.nudge_late()
        if self.graph_ms and now_ns > self._grace_until_ns:  # births have a limit
            self.controller.look_for_hangs()
        self.loop.after(TICK_SECONDS, self._tick)


def supervise(
    options: RunOptions, owner: socket.socket, zygotes: dict[str, Started], ledger: UndoLedger
) -> None:
    """Be the supervisor of a run, in a process of its own; the first zygote has been started."""
    supervisor = Supervisor(options, owner, zygotes, ledger)
    try:
        supervisor.run()
    finally:
        for process in supervisor.pool.processes:
            process.kill()

"""The supervisor: starts the graph, carries out what Recovery orders, replaces what dies, ends it all.

It has the place of the ROS master in the paper's count of processes, and it is trusted as that one is.
It is not on the request path: while it sleeps, requests flow. It outlives nobody: its death kills its
children (`PR_SET_PDEATHSIG`), and the end of its owner's line ends the run.
"""

import json
import os
import signal
import socket
import time
from pathlib import Path
from typing import Final

import msgspec

from aftbed.core import message, script
from aftbed.core.errors import AftbedError
from aftbed.core.event import Event
from aftbed.core.script import Phase
from aftbed.ftm.mechanism import build
from aftbed.runtime.unix import control, linux
from aftbed.runtime.unix.adaptations import ENGINE, REPLACE, Adaptations
from aftbed.runtime.unix.deployment import WATCHED_KINDS, Deployment, Keys
from aftbed.runtime.unix.faults import Faults
from aftbed.runtime.unix.jobs import STATS_JOB, StepFailed
from aftbed.runtime.unix.journal import Journal
from aftbed.runtime.unix.loop import Loop
from aftbed.runtime.unix.options import LoadRun, RunOptions
from aftbed.runtime.unix.processes import Nursery, Process
from aftbed.runtime.unix.questions import Questions
from aftbed.runtime.unix.spawn import BUS, LIGHT, Started
from aftbed.runtime.unix.verbs import Executor
from aftbed.runtime.unix.work import Work

TICK_SECONDS: Final = 0.02
TELL_SECONDS: Final = 0.005
RETRY_SECONDS: Final = 0.002
SETTLE_SECONDS: Final = 0.002
LOSSES: Final = ("failover", "drop backup")
LOSS_SECONDS: Final = 0.5  # a failover is done long before
HANG_NS: Final = 150_000_000  # of what no Watchdog watches; a channel's pulse is 20 ms
LATE_NS_MAX: Final = 40_000_000
DRAIN_SECONDS_MAX: Final = 2.0
STOP_SECONDS_MAX: Final = 1.0


class Supervisor:
    """One run. `owner` is the line to the command; its end is the command's."""

    def __init__(self, options: RunOptions, owner: socket.socket, zygotes: dict[str, Started]) -> None:
        self.options, self._zygotes = options, zygotes
        self.record = Path(options.record)
        self.started_ns = time.monotonic_ns()
        self.owner = control.Line(owner, control.decode_order)
        self.owner.sock.setblocking(False)
        self.loop = Loop()
        self.nursery = Nursery(self.loop, self._on_report, self._on_death)
        self.journal = Journal(self.record / "journal" / "supervisor.1.journal", "supervisor")
        self._events = open(self.record / "events.jsonl", "ab", buffering=0)  # noqa: SIM115 - for the whole run
        self._ending = ""
        self._told: list[bytes] = []
        self._finish_reason = ""
        self._grace_until_ns = 0
        self.graph_ms = 0.0
        self._incomplete: list[str] = []
        self._last_tick_ns = 0
        self._situation_wanted = False
        graph = build(options.ftm, options.placement)
        cpus = sorted(os.sched_getaffinity(0))
        pinned = cpus if options.pin and len(cpus) > 1 else None
        self.work = Work(options, self.nursery, self.loop, self.tell, self._finish, self._report_owner)
        self.deployment = Deployment(graph, self.nursery, self.record, self.work.device_of, pinned)
        self.executor = Executor(self.deployment, self.journal, self.tell)
        self.faults = Faults(self.deployment, self.loop, self.journal, self.tell, seed=options.seed)
        self.adaptations = Adaptations(
            self.deployment,
            self.executor,
            self.loop,
            self.journal,
            self.faults,
            self.record,
            self.tell,
            lambda: self._inform_recovery(failed=False),
        )
        self.questions = Questions(
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
            self.nursery.start_zygote(name, self._zygotes.get(name))
        self.nursery.park(LIGHT, len(self.deployment.graph.nodes) + self._spares() + wants_bus)
        if wants_bus:
            self.nursery.park(BUS, 2)
        self.questions.listen()
        self.loop.read(self.owner.fileno(), self._on_owner)
        self.loop.jobs.start("launch", self._launch(), self._launched)
        self._tick()
        self.loop.run()
        self._teardown()

    def _spares(self) -> int:
        """Enough for a replica and for one node beside it."""
        slots, nodes = self.deployment.slots.values(), self.deployment.graph.nodes.values()
        chain = max(sum(set(bricks) <= slot.bricks for bricks in nodes) for slot in slots)
        return chain + 1 if len(slots) > 1 else 1

    def _launch(self) -> Keys:
        yield from self.work.before(self.deployment)
        for zygote, count in self.work.spares_for(self.deployment).items():
            yield from self.nursery.parked_at_least(zygote, count)
        began_ns = time.monotonic_ns()
        yield from self.deployment.launch(held=self.work.held)
        self.graph_ms = (time.monotonic_ns() - began_ns) / 1e6
        for fault in self.options.faults:
            yield from self.faults.arm(fault)
        yield from self.adaptations.schedule(self.options.adaptations)
        yield from self.work.start(self.deployment)

    def _launched(self, failure: str) -> None:
        if failure:
            self.tell("launch.failed", failure)
            self._finish(f"launch failed: {failure}")
            return
        self.tell("started", f"{len(self.deployment.nodes)} nodes in {self.graph_ms:.1f} ms")
        self._inform_recovery(failed=False)

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
            self._finish("the command is gone" if got is None else "interrupted")
            if got is None:
                self.loop.forget(self.owner.fileno())

    def _report_owner(self, kind: str, data: bytes) -> None:
        """For the command; dropped where it does not read, since a view must not stop a run."""
        try:
            self.owner.send(control.Report(kind, data))
        except OSError:
            return

    def tell(self, event: str, text: str) -> None:
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
        self.loop.jobs.start("stop", self.work.stop_source(self.deployment), lambda _: None)
        self._drain(limit_ns)

    def _drain(self, limit_ns: int) -> None:
        """Wait until all is answered and no script is under way, or the limit is reached."""
        settled = self.work.settled and not self.executor.busy and not len(self.loop.jobs)
        if self.owner_gone() or settled or time.monotonic_ns() > limit_ns:
            if not settled and not self.owner_gone():
                self._incomplete = self.loop.jobs.names()
            self.loop.end()
            return
        if not len(self.loop.jobs):
            self.loop.jobs.start(STATS_JOB, self.work.ask_stats(self.deployment), lambda _: None)
        self.loop.after(0.005, lambda: self._drain(limit_ns))

    def owner_gone(self) -> bool:
        """Nobody waits for a verdict."""
        return self._finish_reason == "the command is gone"

    def _teardown(self) -> None:
        """Kill what is left, reap it, say how it ended, and leave."""
        self._tell_all()
        for process in self.nursery.processes:
            process.kill()
        limit = time.monotonic() + STOP_SECONDS_MAX
        while self.nursery.processes and time.monotonic() < limit:
            for process in list(self.nursery.processes):
                if not process.pid or linux.reap(process.pid) is not None:
                    process.close()
                    self.nursery.processes.remove(process)
            time.sleep(0.001)  # no event to wait for: a killed process is a matter of a millisecond
        left = [f"{p.name} ({p.pid})" for p in self.nursery.processes]
        end = {
            "reason": self._finish_reason,
            "ended_ns": time.monotonic_ns(),
            "seconds": round((time.monotonic_ns() - self.started_ns) / 1e9, 3),
            "graph_ms": round(self.graph_ms, 3),
            "left": left,
            "unfinished": self._incomplete,
            "leader": self.deployment.leader,
            "backup": self.deployment.backup,
            "epoch": self.deployment.epoch,
            "faults": self.faults.receipts(),
            **self.work.end(),
        }
        unfinished = self.record / "end.json.new"
        unfinished.write_text(json.dumps(end))
        unfinished.rename(self.record / "end.json")  # whole, or not there
        self._report_owner("finished", json.dumps(end).encode())

    # -- what processes say -------------------------------------------------------------------

    def _on_report(self, process: Process, report: msgspec.Struct) -> None:
        match report:
            case control.Ack(token, data, error):
                self.deployment.assigned(process)
                key = ("ack", process.name, token)
                if error:
                    self.tell("refused", f"{process.name}: {error}")
                    self.loop.jobs.fail(key, f"{process.name}: {error}")
                else:
                    self.loop.jobs.settle(key, data)
            case control.Said(brick, message.Promoted(epoch)):
                self.loop.jobs.settle(("promoted", brick, epoch))
            case control.Said(_, message.Adapted() as told):
                self.adaptations.adapted(told)
                self.loop.after(SETTLE_SECONDS, self._settle)
            case control.Ordered(_, ordered, Phase.WHOLE):
                self._on_script(ordered)
            case control.Ordered(_, ordered, phase, number):
                self.adaptations.ordered(ordered, phase, number)
            case control.Fired(fault):
                if not self.adaptations.fired(process, fault):
                    self.faults.fired(process, fault)
            case control.Report(kind, data):
                self.work.on_report(process, kind, data)
            case _:
                self.tell("refused", f"{process.name} said {type(report).__name__}")

    def _on_script(self, ordered: script.Script) -> None:
        if self.executor.busy or self._ending:
            return  # another script is under way; Recovery hears how it ended
        if ordered.purpose in LOSSES and self.adaptations.interrupted(ordered.replica):
            return  # the way back first
        began_ns = time.monotonic_ns()

        def ended(failure: str) -> None:
            ms = f"{(time.monotonic_ns() - began_ns) / 1e6:.2f} ms"
            self.tell("script.failed" if failure else "script.done", f"{ordered.purpose}: {failure or ms}")
            self._inform_recovery(failed=bool(failure))
            self.loop.after(SETTLE_SECONDS, lambda: self._settle_after(ordered))

        self.loop.jobs.start(ordered.purpose, self.executor.execute(ordered), ended)
        if ordered.purpose in LOSSES:  # its nodes are killed only when the new leader serves
            self.tell("alarm", f"{ordered.replica}: {self.deployment.cause_of_loss(ordered.replica)}")
        self.tell("script", f"{ordered.purpose} ({ordered.replica})")

    def _settle_after(self, ordered: script.Script) -> None:
        """What can wait until after a script: spares, and faults that are still to come."""
        if ordered.purpose == "new backup":
            self._settle()
        elif not self._ending:
            self.loop.jobs.start("rearm", self.faults.rearm(), lambda _: None)

    def _settle(self) -> None:
        if self._ending:
            return
        self.nursery.level(LIGHT, self._spares())
        self.loop.jobs.start("rearm", self.faults.rearm(), lambda _: None)

    def _inform_recovery(self, *, failed: bool) -> None:
        deployment = self.deployment
        roles = f"{deployment.leader or 'nobody'} leads, {deployment.backup or 'nobody'} backs up"
        self.tell("roles", f"{roles}, epoch {deployment.epoch}")
        if self.executor.busy or not deployment.lives("recovery") or self._ending:
            return
        situation = self.executor.situation(failed=failed)
        try:
            deployment.order("recovery", lambda token: control.Tell(token, "recovery", situation))
        except StepFailed as error:
            self.tell("refused", str(error))

    # -- deaths and hangs ---------------------------------------------------------------------

    def _on_death(self, process: Process) -> None:
        self.journal.write(time.monotonic_ns(), Event.NODE_DIED, 0, process.pid)
        self.loop.jobs.settle(("died", process.name, process.pid))
        if process.kind == "killed" or self._ending:
            return
        self.tell("died", f"{process.name} (pid {process.pid})")
        self.loop.jobs.died(process.name)
        if process.kind == "zygote":
            self.nursery.restart_zygote(process.name)
        elif process.kind == "spare":
            self.nursery.level(LIGHT, self._spares())
        elif process.kind == "service":
            self._finish(f"{process.name} died")
        elif process.kind == "staged":
            return  # who waits for it has heard
        elif process.kind == "node" and self._replaceable(process.name):
            if process.name != ENGINE:
                self.adaptations.give_up_preparing(f"{process.name} died")
            self._replace(process.name)
        else:
            self.loop.after(LOSS_SECONDS, self._look_for_loss)

    def _look_for_loss(self) -> None:
        """No replica is left and none will come: say so, and end a load, which would wait for ever."""
        deployment = self.deployment
        if self._ending or self.executor.busy or deployment.backup:
            return
        slot = deployment.slots.get(deployment.leader)
        nodes = slot.nodes if slot is not None and deployment.leader not in deployment.lost else []
        if nodes and all(deployment.lives(node) for node in nodes):
            return
        self.tell("lost", "no replica is left: the service is gone")
        if isinstance(self.options.work, LoadRun):
            self._finish("")

    def _replaceable(self, node: str) -> bool:
        bricks = self.deployment.graph.nodes[node]
        return self.deployment.graph.brick(bricks[0]).kind in WATCHED_KINDS

    def _replace(self, node: str) -> None:
        if self.adaptations.acting:  # both hand channels out
            self.loop.after(RETRY_SECONDS, lambda: self._replace(node))
            return
        began_ns = time.monotonic_ns()

        def ended(failure: str) -> None:
            ms = (time.monotonic_ns() - began_ns) / 1e6
            self.tell("replaced", f"{node}: {failure or f'{ms:.2f} ms'}")
            half = self.deployment.nodes.get(node)
            if failure and not self._ending and half is not None and half.alive:
                half.kill()  # half bound: its death is heard, and replaced in turn
            elif failure and not self._ending:
                self.loop.after(TICK_SECONDS, lambda: self._replace(node))
            if node == "recovery":
                self._inform_recovery(failed=False)
            if node == ENGINE and not failure:
                self.adaptations.engine_is_new()
            self.nursery.level(LIGHT, self._spares())

        self.loop.jobs.start(f"{REPLACE}{node}", self.deployment.respawn(node), ended)

    def _tick(self) -> None:
        """Look after the pulses of what no Watchdog watches: a node that hangs is killed, and replaced."""
        now_ns = time.monotonic_ns()
        late = now_ns - self._last_tick_ns > TICK_SECONDS * 1e9 + LATE_NS_MAX
        if late:
            self._grace_until_ns = now_ns + HANG_NS
        self._last_tick_ns = now_ns
        self.deployment.nudge_late()
        if now_ns > self._grace_until_ns and not self._ending:
            for process in self.nursery.processes:
                single = process.kind == "node" and self._replaceable(process.name)
                if single and process.hangs(now_ns, HANG_NS):
                    self.tell("hangs", f"{process.name} (pid {process.pid}): killed, to be replaced")
                    process.kill(signal.SIGKILL)
        self.loop.after(TICK_SECONDS, self._tick)


def supervise(options: RunOptions, owner: socket.socket, zygotes: dict[str, Started]) -> None:
    """Be the supervisor of a run, in a process of its own; the first zygote has been started."""
    supervisor = Supervisor(options, owner, zygotes)
    try:
        supervisor.run()
    finally:
        for process in supervisor.nursery.processes:
            process.kill()

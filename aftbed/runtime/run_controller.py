"""The controller of a run: handles orders of bricks, reports of processes, and their deaths.

Recovery orders scripts, the Engine phases of adaptations. They are executed one at a time, and the brick is
informed of how each ended. A node of no replica (Client, Proxy, Watchdog, Recovery, Engine) is replaced when
it dies. The controller is not on the request path: while it sleeps, requests flow.
"""

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Final

import msgspec

from aftbed.core import messages, script
from aftbed.core.errors import StepFailed
from aftbed.core.events import Event
from aftbed.core.graph import Graph
from aftbed.core.messages import Redundancy
from aftbed.core.script import LOSSES, Phase, ScriptKind
from aftbed.ftm.compose import replication_of
from aftbed.ftm.registry import BRICKS
from aftbed.runtime import control
from aftbed.runtime.adaptations import CLIENT, ENGINE, REPLACE, Adaptations
from aftbed.runtime.deployment import HANG_NS, Deployment
from aftbed.runtime.fault_controller import FaultController
from aftbed.runtime.interface import LIGHT, Process, ProcessKind, Runtime
from aftbed.runtime.script_executor import ScriptExecutor
from aftbed.runtime.tasks import death_of

RETRY_SECONDS: Final = 0.002
AGAIN_SECONDS: Final = 0.02
SETTLE_SECONDS: Final = 0.002
RESTOCK_SECONDS: Final = 0.05  # from a new backup until spares are forked anew: the next loss may be near
LOSS_SECONDS: Final = 0.5  # a failover is done long before


class ScriptRun(msgspec.Struct):
    """A script of Recovery: `ended_ns` is 0 while it runs, `failure` is `""` if it was done."""

    kind: ScriptKind
    replica: str
    began_ns: int
    ended_ns: int = 0
    failure: str = ""


class RunController:
    """One run. `on_loss` is called when no replica is left and none will come."""

    def __init__(
        self, graph: Graph, runtime: Runtime, cpus: list[int] | None, on_loss: Callable[[], None]
    ) -> None:
        self._runtime, self._loop, self._on_loss = runtime, runtime.loop, on_loss
        self.deployment = Deployment(graph, runtime, cpus)
        self.executor = ScriptExecutor(self.deployment)
        self.faults = FaultController(self.deployment)
        self.adaptations = Adaptations(
            self.deployment, self.executor, self.faults, lambda: self.inform_recovery(failed=False)
        )
        self.ending = False
        self.scripts: list[ScriptRun] = []  # of Recovery

    def under_way(self) -> list[str]:
        """What was asked for and has not ended. An adaptation that is observed has no task meanwhile."""
        script = ["a script"] if self.executor.busy or self.adaptations.busy else []
        delayed = ["an adaptation that waits for redundancy"] if self.adaptations.delayed else []
        return script + delayed + self._loop.tasks.names()

    def unrest(self) -> list[str]:
        """Why the run is not at rest, as far as is known."""
        found = [f"{name} is under way" for name in self.under_way()]
        missing = (node for node in sorted(self.deployment.graph.nodes) if not self.deployment.lives(node))
        return found + [f"{node} is missing" for node in missing]

    def spares(self) -> int:
        """Enough for a replica and for one node beside it."""
        slots, nodes = self.deployment.slots.values(), self.deployment.graph.nodes.values()
        chain = max(sum(set(bricks) <= slot.bricks for bricks in nodes) for slot in slots)
        return chain + 1 if len(slots) > 1 else 1

    # -- reports of processes -----------------------------------------------------------------

    def on_report(self, process: Process, report: msgspec.Struct) -> None:
        """`report` has come from `process`."""
        tasks = self._loop.tasks
        match report:
            case control.Ack(token, data, error):
                process.assigned()
                key = ("ack", process.name, token)
                if not error:
                    tasks.settle(key, data)
                elif not tasks.fail(key, f"{process.name}: {error}"):  # else its task tells, if it matters
                    self._runtime.log("refused", f"{process.name}: {error}")
            case control.BrickReport(brick, messages.Promoted(epoch)):
                tasks.settle(("promoted", brick, epoch))
            case control.BrickReport(_, messages.RequestHeld(request_id)):
                self.adaptations.request_held(request_id)
            case control.BrickReport(_, messages.Adapted() as ended):
                self.adaptations.adapted(ended)
                self._loop.after(SETTLE_SECONDS, self._replace_missing)
                self._loop.after(SETTLE_SECONDS, self._rearm)
                self._loop.after(SETTLE_SECONDS, self._restock)  # the next one waits until that is done
            case control.Ordered(_, ordered, Phase.WHOLE):
                self._on_script(ordered)
            case control.Ordered(_, ordered, phase, number):
                self.adaptations.ordered(ordered, phase, number)
            case control.Fired(fault):
                self.faults.fired(process, fault)
            case _:
                self._runtime.log("refused", f"{process.name} said {type(report).__name__}")

    def _on_script(self, ordered: script.Script) -> None:
        if self.executor.busy or self.ending or self.executor.stale(ordered):
            return  # another script is under way, or has been; Recovery is informed of its end
        if ordered.kind in LOSSES and self.adaptations.interrupted(ordered.replica):
            return  # the way back first
        run = ScriptRun(ordered.kind, ordered.replica, self._loop.now_ns())
        self.scripts.append(run)
        log = self._runtime.log

        def settle() -> None:  # spares, and faults that are still to come
            if ordered.kind is ScriptKind.NEW_BACKUP:
                if not run.failure:
                    self.deployment.rehearse(ordered.replica)
                self._loop.after(RESTOCK_SECONDS, partial(self._restock_after, len(self.scripts)))
            self._rearm()

        def ended(failure: str) -> None:
            run.ended_ns, run.failure = self._loop.now_ns(), failure
            ms = f"{(run.ended_ns - run.began_ns) / 1e6:.2f} ms"
            log("script.failed" if failure else "script.done", f"{ordered.purpose}: {failure or ms}")
            self.inform_recovery(failed=bool(failure))
            self._loop.after(SETTLE_SECONDS, settle)
            if failure:
                self._loop.after(LOSS_SECONDS, self._look_for_loss)

        self._loop.tasks.start(ordered.purpose, self.executor.execute(ordered), ended)
        if ordered.kind in LOSSES:  # its nodes are killed only when the new leader serves
            log("alarm", f"{ordered.replica}: {self.deployment.cause_of_loss(ordered.replica)}")
        log("script", f"{ordered.purpose} ({ordered.replica})")

    def _rearm(self) -> None:
        if not self.ending:
            self._loop.tasks.start("rearm", self.faults.rearm(), lambda _: None)

    def _restock_after(self, scripts: int) -> None:
        """Unless something is under way again, which needs the CPUs."""
        if scripts == len(self.scripts) and not self.adaptations.busy:
            self._restock()

    def _restock(self) -> None:
        if not self.ending:
            self._runtime.pool.refill(LIGHT, self.spares())

    def state(self, cycle_us: float | None, requests: control.RequestCounts | None) -> control.ServiceState:
        """What serves now; what the client has counted is given."""
        deployment = self.deployment
        return control.ServiceState(
            ftm=deployment.graph.ftm,
            adapting=self.adaptations.busy,
            leader=deployment.leader,
            backup=deployment.backup,
            epoch=deployment.epoch,
            cycle_us=cycle_us,
            requests=requests,
        )

    def inform_recovery(self, *, failed: bool) -> None:
        """Send it the situation; it may act again."""
        deployment = self.deployment
        self._runtime.log("roles", self.state(None, None).roles)
        self._tell_redundancy()
        if self.executor.busy or not deployment.lives("recovery") or self.ending:
            return
        situation = self.executor.situation(failed=failed)
        try:
            deployment.order("recovery", lambda token: control.Deliver(token, "recovery", situation))
        except StepFailed as error:
            self._runtime.log("refused", str(error))

    def _tell_redundancy(self) -> None:
        """To those bricks of the leader that go by it."""
        deployment = self.deployment
        alone = bool(replication_of(deployment.graph.ftm)) and not deployment.backup
        told = Redundancy(deployment.epoch, alone)
        for brick in deployment.graph.bricks:
            if brick.replica == deployment.leader and BRICKS[brick.kind].told_redundancy:
                with suppress(StepFailed):  # a node that is dead is replaced, or its replica is
                    deployment.leave(
                        deployment.graph.node_of(brick.name),
                        control.Deliver(control.UNANSWERED, brick.name, told),
                    )

    # -- deaths and hangs -------------------------------------------------------------------------------

    def on_death(self, process: Process) -> None:
        """A process is dead; that was intended only if its kind is `killed`."""
        self._runtime.journal.write(self._loop.now_ns(), Event.NODE_DIED, 0, process.pid)
        self._loop.tasks.settle(death_of(process.pid))
        if process.kind is ProcessKind.KILLED or self.ending:
            return
        self._runtime.log("died", f"{process.name} (pid {process.pid})")
        self._loop.tasks.died(process.name)
        if process.kind is ProcessKind.SPARE:
            self._runtime.pool.refill(LIGHT, self.spares())
        elif process.kind is ProcessKind.NODE and process.name in self.deployment.singles:
            if process.name != ENGINE:
                self.adaptations.give_up_preparing(f"{process.name} died")
            self._replace(process.name)
        elif process.kind is ProcessKind.NODE:
            self._loop.after(LOSS_SECONDS, self._look_for_loss)

    def look_for_hangs(self) -> None:
        """Look at the nodes that no Watchdog watches: one that hangs is killed, and so replaced.

        While an adaptation is under way, look at all, since its undo leaves out a replica that hangs.
        """
        now_ns, singles, adapting = self._loop.now_ns(), self.deployment.singles, self.adaptations.busy
        nodes = [
            process
            for process in self._runtime.pool.processes
            if process.kind is ProcessKind.NODE and (adapting or process.name in singles)
        ]
        for process in [process for process in nodes if process.hangs(now_ns, HANG_NS)]:
            if process.name in singles:
                self._runtime.log("hangs", f"{process.name} (pid {process.pid}): killed, to be replaced")
                process.kill()

    def _look_for_loss(self) -> None:
        deployment = self.deployment
        if self.ending or deployment.backup:
            return
        if self.executor.busy:
            self._loop.after(LOSS_SECONDS, self._look_for_loss)
            return
        slot = deployment.slots.get(deployment.leader)
        nodes = slot.nodes if slot is not None and deployment.leader not in deployment.lost else []
        if nodes and all(deployment.lives(node) for node in nodes):
            return
        self._runtime.log("lost", "no replica is left: the service is gone")
        self._on_loss()

    def _replace_missing(self) -> None:
        """Replace what was staged, died, and became a part of the graph all the same."""
        for node in self.deployment.singles:
            if not self.ending:
                self._replace(node)

    def _replace(self, node: str) -> None:
        under_way = f"{REPLACE}{node}" in self._loop.tasks.names()
        if node not in self.deployment.singles or under_way or self.deployment.lives(node):
            return  # the graph that runs by now has no place for it, or it is taken
        if self.adaptations.acting:  # both hand channels out
            self._loop.after(RETRY_SECONDS, lambda: self._replace(node))
            return
        began_ns = self._loop.now_ns()

        def ended(failure: str) -> None:
            ms = (self._loop.now_ns() - began_ns) / 1e6
            self._runtime.log("replaced", f"{node}: {failure or f'{ms:.2f} ms'}")
            replacement = self.deployment.nodes.get(node)
            serves = not failure and self.deployment.lives(node)
            if failure and not self.ending and replacement is not None and replacement.alive:
                replacement.kill()  # half bound: its death is noticed, and it is replaced in turn
            elif not serves and not self.ending:  # it may have died while others were bound to it
                self._loop.after(AGAIN_SECONDS, lambda: self._replace(node))
            if node == "recovery" or self.deployment.lost:
                self.inform_recovery(failed=False)
            if node == ENGINE and serves:
                self.adaptations.engine_is_new()
            if node == CLIENT and serves:
                self._loop.tasks.start("resume client", self.adaptations.client_is_new(), lambda _: None)
            if serves:  # faults that waited in the dead one
                self._loop.after(SETTLE_SECONDS, self._rearm)
            self._runtime.pool.refill(LIGHT, self.spares())

        held = node == CLIENT and bool(self.adaptations.awaited)  # until it knows what waits for its requests
        self._loop.tasks.start(f"{REPLACE}{node}", self.deployment.respawn(node, held=held), ended)

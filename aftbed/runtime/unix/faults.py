"""Faults on real processes: armed in the node that emits the event, applied through pidfds of this run.

A crash of the emitter itself happens there, at the very point. Anything else is asked for: the
emitter waits until the supervisor has hit the target and seen it hit (dead, or in state `T`), since a
process goes on for a while after a signal was sent. Each fault ends with a receipt.
"""

import contextlib
import itertools
import signal
import time
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Final

from aftbed.core.event import Event, event_named
from aftbed.core.fault import Act, Fault
from aftbed.core.journal import records
from aftbed.runtime import targets
from aftbed.runtime.unix import control, linux
from aftbed.runtime.unix.deployment import Deployment, Keys
from aftbed.runtime.unix.jobs import Key, StepFailed, Wait
from aftbed.runtime.unix.journal import Journal
from aftbed.runtime.unix.loop import Loop
from aftbed.runtime.unix.processes import Process

STOP_SECONDS_MAX: Final = 0.5


class Armed:
    """A fault and what has become of it: armed, applied, not_activated."""

    def __init__(self, number: int, fault: Fault) -> None:
        self.number, self.fault = number, fault
        self.state = "armed"
        self.armed_ns = time.monotonic_ns()
        self.host: Process | None = None  # where it waits for its event
        self.itself = False
        self.journals: set[Path] = set()


class Faults:
    """All faults of a run."""

    def __init__(
        self, deployment: Deployment, loop: Loop, journal: Journal, tell: Callable[[str, str], None]
    ) -> None:
        self._deployment, self._loop, self._journal, self._tell = deployment, loop, journal, tell
        self._numbers = itertools.count(1_000_001)  # apart from the tokens of orders
        self._armed: list[Armed] = []

    def arm(self, fault: Fault) -> Keys:
        """Apply `fault` now, later, or have its emitter wait for its event. Raises StepFailed."""
        armed = Armed(next(self._numbers), fault)
        self._armed.append(armed)
        self._tell("armed", str(fault))
        if fault.trigger.event:
            yield from self._arm_event(armed)
        elif fault.trigger.after_ms:
            self._loop.after(fault.trigger.after_ms / 1e3, lambda: self._start(armed))
        else:
            yield from self._apply(armed)

    def _start(self, armed: Armed) -> None:
        self._loop.jobs.start(f"fault {armed.fault}", self._apply(armed), lambda failure: None)

    def _arm_event(self, armed: Armed) -> Keys:
        deployment, trigger = self._deployment, armed.fault.trigger
        node = targets.emitter(deployment.graph, trigger.event, deployment.leader, deployment.backup)
        if node is None or not deployment.lives(node):
            raise StepFailed(f"{armed.fault}: nobody emits {trigger.event} now")
        process = deployment.nodes[node]
        happened = self._count(armed)
        armed.host = process
        if process.journal is not None:
            armed.journals.add(process.journal)
        armed.itself = armed.fault.act is Act.CRASH and node in self._nodes_of(armed.fault.target)
        nth = max(1, trigger.nth - happened)
        yield from deployment.ask(
            node,
            lambda token: control.Arm(token, armed.number, trigger.event, nth, armed.fault.act, armed.itself),
        )

    def _count(self, armed: Armed) -> int:
        """How often the event has happened since `armed`, in nodes that are no longer the emitter."""
        event = event_named(armed.fault.trigger.event)
        return sum(
            r.event is event and r.t_ns >= armed.armed_ns
            for path in armed.journals
            for r in records(path.read_bytes())
        )

    def rearm(self) -> Keys:
        """After a change of roles: what waits in a node that is not the emitter any more moves on."""
        for armed in self._armed:
            self._look(armed)
            if armed.state == "armed" and armed.host is not None and not armed.host.alive:
                try:
                    yield from self._arm_event(armed)
                except StepFailed:
                    continue  # nobody emits it now; the next change of roles asks again

    def _look(self, armed: Armed) -> None:
        """A node that crashed itself has left word in its journal."""
        if armed.state != "armed" or not armed.itself:
            return
        for path in armed.journals:
            for record in records(path.read_bytes()):
                if record.event is Event.FAULT_APPLIED and record.detail == armed.number:
                    armed.state = "applied"

    def fired(self, process: Process, number: int) -> None:
        """The emitter has reached the point, and waits."""
        armed = next((a for a in self._armed if a.number == number), None)
        if armed is None:
            return
        emitter = process

        def answer(failure: str) -> None:
            with contextlib.suppress(StepFailed):  # it may be among those that were hit
                self._deployment.nursery.order(emitter, control.Ack(number))

        self._loop.jobs.start(f"fault {armed.fault}", self._apply(armed), answer)

    # -- the few places that touch a process --------------------------------------------------

    def _nodes_of(self, target: str) -> list[str]:
        deployment = self._deployment
        if target in targets.ROLES:
            name = deployment.leader if target == "primary" else deployment.backup
            return list(deployment.slots[name].nodes) if name else []
        return [target] if target in deployment.graph.nodes else []

    def _hit(self, target: str) -> list[Process]:
        nodes = self._nodes_of(target)
        found = [p for n, p in self._deployment.nodes.items() if n in nodes and p.alive]
        return found or [p for p in self._deployment.nursery.processes if p.name == target and p.pid]

    def _apply(self, armed: Armed) -> Keys:
        hit = self._hit(armed.fault.target)
        if not hit:
            armed.state = "not_activated"
            self._tell("fault", f"{armed.fault}: nobody to hit")
            return
        self._journal.write(time.monotonic_ns(), Event.FAULT_APPLIED, 0, armed.number)
        if armed.fault.act is Act.CRASH:
            dead: set[Key] = {("died", p.name, p.pid) for p in hit}
            for process in hit:
                process.kill()
            armed.state = "applied"
            yield Wait(frozenset(dead))
        else:
            yield from self._hang(armed, hit)

    def _hang(self, armed: Armed, hit: list[Process]) -> Generator[Wait, dict[Key, bytes], None]:
        for process in hit:
            process.kill(signal.SIGSTOP)
        limit = time.monotonic() + STOP_SECONDS_MAX
        while not all(_stopped(p) for p in hit) and time.monotonic() < limit:
            time.sleep(0)  # the state change is the kernel's next few microseconds of work
        armed.state = "applied"
        if armed.fault.for_ms:
            pidfds = [p.pidfd for p in hit]
            self._loop.after(armed.fault.for_ms / 1e3, lambda: _resume(hit, pidfds))
        yield Wait(frozenset())

    def receipts(self) -> list[dict[str, object]]:
        """What became of each fault."""
        for armed in self._armed:
            self._look(armed)
        return [
            {"fault": str(a.fault), "receipt": "not_activated" if a.state == "armed" else a.state}
            for a in self._armed
        ]


def _stopped(process: Process) -> bool:
    """Whether the kernel has it in state `T` (proc(5)); a dead one counts as stopped."""
    try:
        stat = Path(f"/proc/{process.pid}/stat").read_text()
    except OSError:
        return True
    return stat.rpartition(")")[2].split()[0] in "TZX"


def _resume(processes: list[Process], pidfds: list[int]) -> None:
    for process, pidfd in zip(processes, pidfds, strict=True):
        if process.alive and process.pidfd == pidfd:
            linux.kill(pidfd, signal.SIGCONT)

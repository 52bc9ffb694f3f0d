"""Faults of a run: armed in the node that emits the event, applied to processes of this run.

A crash of the emitter itself happens there, at the very point; so does a bitflip, which needs nobody
else. Anything else is asked for: the emitter waits until the supervisor has hit the target and seen it
hit (dead, or in state `T`), since a process goes on for a while after a signal was sent. What an
adaptation comes through is emitted by the supervisor itself: see `Faults.at`. Each fault ends with a receipt.
"""

import contextlib
import itertools
from collections.abc import Generator, Iterable
from typing import Final

from aftbed.core.event import Event, event_named
from aftbed.core.fault import Act, Fault, Flip, marked
from aftbed.core.journal import Record
from aftbed.runtime import control, targets
from aftbed.runtime.deployment import Deployment, Keys
from aftbed.runtime.interface import Process
from aftbed.runtime.jobs import Key, StepFailed, Wait

STOP_NS_MAX: Final = 500_000_000


class Armed:
    """A fault and what has become of it: armed, applied, refused, not_activated; `detail` says more."""

    def __init__(self, number: int, fault: Fault, draw: int) -> None:
        self.number, self.fault, self.draw = number, fault, draw
        self.state, self.detail = "armed", ""
        self.left = fault.trigger.nth  # of the occurrences of its event, since it came to its host
        self.waits = False  # for its event: in its host, or, while nobody emits it, in none
        self.host: Process | None = None
        self.brick = ""
        self.itself = False
        self.journals: set[str] = set()
        self._since_ns = 0
        self._share = 1  # how many bricks of the host emit the event

    def move_in(self, host: Process, brick: str, share: int, now_ns: int, *, itself: bool) -> None:
        """Wait in `host` from now on."""
        assert host.journal, host.name
        self.host, self.brick, self._share, self.itself = host, brick, share, itself
        self.journals.add(host.journal)
        self._since_ns = now_ns

    def move_out(self, records: Iterable[Record]) -> None:
        """What happened in the host has been counted there, by its records, and is not forgotten."""
        event = event_named(self.fault.event)
        happened = sum(r.event is event and r.t_ns >= self._since_ns for r in records)
        self.left = max(1, self.left - happened // self._share)
        self.host = None

    def blow(self, nth: int) -> control.Blow:
        """What the host is told."""
        fault = self.fault
        return control.Blow(self.number, self.brick, nth, fault.act, self.itself, fault.flip, self.draw)


class Faults:
    """All faults of a run."""

    def __init__(self, deployment: Deployment) -> None:
        self._deployment, self._support = deployment, deployment.support
        self._loop, self._tell = self._support.loop, self._support.tell
        self._numbers = itertools.count(1_000_001)  # apart from the tokens of orders
        self._armed: list[Armed] = []

    def arm(self, fault: Fault) -> Keys:
        """Apply `fault` now, later, or have its emitter wait for its event. Raises StepFailed."""
        number = next(self._numbers)
        armed = Armed(number, fault, self._support.draw(number))
        self._armed.append(armed)
        self._tell("armed", str(fault))
        if fault.trigger.after_ms and not fault.trigger.event:
            self._loop.after(fault.trigger.after_ms / 1e3, lambda: self._start(armed))
            return
        try:
            yield from self._begin(armed)
        except StepFailed:
            armed.state = "not_activated"
            raise

    def _start(self, armed: Armed) -> None:
        self._loop.jobs.start(f"fault {armed.fault}", self._begin(armed), lambda failure: None)

    def _begin(self, armed: Armed) -> Keys:
        yield from self._place(armed) if armed.fault.event else self._apply(armed)

    def _place(self, armed: Armed) -> Keys:
        """Have whoever emits its event wait for it. Raises StepFailed where nobody does now."""
        deployment, fault = self._deployment, armed.fault
        graph, roles = deployment.graph, (deployment.leader, deployment.backup)
        armed.waits = True
        if targets.emitter(graph, fault.event, *roles) == targets.SUPERVISOR:
            return
        brick = targets.waits_in(fault, graph, *roles)
        node = "" if brick is None else graph.node_of(brick)
        if brick is None or not deployment.lives(node):
            raise StepFailed(f"{fault}: nobody emits {fault.event} now")
        itself = fault.act is Act.CRASH and node in self._nodes_of(fault.target)
        share = targets.emitters_in(graph, fault.event, node)
        armed.move_in(deployment.nodes[node], brick, share, self._loop.now_ns(), itself=itself)
        yield from deployment.ask(
            node, lambda token: control.Arm(token, fault.event, (armed.blow(armed.left),))
        )

    def _stands(self, armed: Armed) -> bool:
        """Whether the host of `armed` still is the one that emits its event."""
        deployment, host = self._deployment, armed.host
        brick = targets.waits_in(armed.fault, deployment.graph, deployment.leader, deployment.backup)
        if host is None or brick != armed.brick:
            return False
        return host.alive and deployment.nodes.get(deployment.graph.node_of(brick)) is host

    def _withdraw(self, armed: Armed) -> Keys:
        """Its host no longer emits its event, or lives no longer."""
        host = armed.host
        assert host is not None
        armed.move_out(self._support.records(host.journal))
        if host.alive and self._deployment.nodes.get(host.name) is host:
            event, blow = armed.fault.event, armed.blow(0)
            yield from self._deployment.ask(host.name, lambda token: control.Arm(token, event, (blow,)))

    def rearm(self) -> Keys:
        """After a change of roles, or of the graph: what waits in a node that is not the emitter moves on."""
        for armed in self._armed:
            self._look(armed)
            if armed.state != "armed" or not armed.waits or self._stands(armed):
                continue
            with contextlib.suppress(StepFailed):  # nobody emits it now; the next change asks again
                if armed.host is not None:
                    yield from self._withdraw(armed)
                yield from self._place(armed)

    def at(self, event: Event) -> Keys:
        """The executor has come to `event`: who is due is hit, and has been seen hit when this ends.

        But for what is under way: there, the death and the answer to the step are on their way at once.
        """
        for armed in list(self._armed):
            if armed.state == "armed" and armed.waits and armed.fault.event == event.label:
                armed.left -= 1
                if armed.left == 0 and event is Event.ADAPT_STEP_ACT:
                    next(self._apply(armed), None)
                elif armed.left == 0:
                    yield from self._apply(armed)

    def _look(self, armed: Armed) -> None:
        """A node that has hit itself has left word in its journal."""
        if armed.state != "armed" or not (armed.itself or armed.fault.flip):
            return
        for path in armed.journals:
            for record in self._support.records(path):
                if marked(record.detail)[0] != armed.number:
                    continue
                if armed.fault.flip is not None:
                    _settle_flip(armed, armed.fault.flip, record)
                elif record.event is Event.FAULT_APPLIED:
                    armed.state = "applied"

    def fired(self, process: Process, number: int) -> None:
        """The emitter has reached the point, and waits; for a bitflip it has done what was to do."""
        armed = next((a for a in self._armed if a.number == number), None)
        if armed is None:
            return
        if armed.fault.flip is not None:
            self._look(armed)
            self._tell("fault", f"{armed.fault}: {armed.state}, {armed.detail}")
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
        self._support.journal.write(self._loop.now_ns(), Event.FAULT_APPLIED, 0, armed.number)
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
            process.freeze()
        limit_ns = self._loop.now_ns() + STOP_NS_MAX
        while not all(p.stopped() for p in hit) and self._loop.now_ns() < limit_ns:
            self._loop.rest(0)  # the state change is the kernel's next few microseconds of work
        armed.state = "applied"
        if armed.fault.for_ms:
            self._loop.after(armed.fault.for_ms / 1e3, lambda: _resume(hit))
        yield Wait(frozenset())

    def receipts(self) -> list[dict[str, str]]:
        """What became of each fault; `detail` where there is more to say."""
        for armed in self._armed:
            self._look(armed)
        return [
            {"fault": str(a.fault), "receipt": "not_activated" if a.state == "armed" else a.state}
            | ({"detail": a.detail} if a.detail else {})
            for a in self._armed
        ]


def _settle_flip(armed: Armed, flip: Flip, record: Record) -> None:
    """What the Server's host says of a bitflip: which bit it hit, or that there were so many and no other."""
    _, bits = marked(record.detail)
    of = f"of the {flip.place.value} of request {record.request_id} in {armed.brick}"
    if record.event is Event.FAULT_APPLIED:
        armed.state, armed.detail = "applied", f"bit {bits} {of}"
    elif not bits or (flip.bit is not None and flip.bit >= bits):
        armed.state, armed.detail = "not_activated", f"there are {bits} bits {of}"
    else:
        bit = flip.bit if flip.bit is not None else armed.draw % bits
        armed.state, armed.detail = "refused", f"the function refused bit {bit} {of}"


def _resume(processes: list[Process]) -> None:
    for process in processes:
        process.thaw()

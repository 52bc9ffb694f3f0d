"""Faults of a run: armed in the node that emits the event, applied to processes of this run.

A crash of the emitter itself happens there, at the very point; so does what strikes a value or a message,
which needs nobody else. Anything else is asked for: the emitter waits until the supervisor has hit the target
and seen it hit (dead, in state `T`, or slow by its own word), since a process goes on for a while after a
signal was sent. What an adaptation comes through is emitted by the supervisor itself: see `Faults.at`.

A fault with a condition of the car is armed when that holds. In virtual time and in lockstep the car waits
with its next step until that is done; in real time it drives on, and the receipt says for how long.

Each fault ends with a receipt. One that has struck stays where it is, even if it lasts: it belongs to that
process, and not to the one that takes its place.
"""

import contextlib
import itertools
from collections.abc import Generator, Iterable
from typing import Final, assert_never

from aftbed.core.busfault import BusFault
from aftbed.core.errors import ConfigError
from aftbed.core.events import Event
from aftbed.core.fault import Crash, Disturb, Fault, FlipMemory, Hang, Slow
from aftbed.core.journal import Record
from aftbed.core.valuefault import Flip, Place
from aftbed.runtime import control, receipts, targets
from aftbed.runtime.armed import Armed
from aftbed.runtime.cell import check_field
from aftbed.runtime.cells import Cells, receipt
from aftbed.runtime.deployment import Deployment, Keys
from aftbed.runtime.interface import Met, Process
from aftbed.runtime.jobs import Key, StepFailed, Wait
from aftbed.runtime.receipts import ACTIVATED, APPLIED, ARMED, INJECT_ERROR, NOT_ACTIVATED, Receipt

STOP_NS_MAX: Final = 500_000_000


class NobodyThere(StepFailed):
    """Nobody comes to the point of a fault as things are."""


class Faults:
    """All faults of a run."""

    def __init__(self, deployment: Deployment) -> None:
        self._deployment, self._support = deployment, deployment.support
        self._loop, self._tell = self._support.loop, self._support.tell
        self._numbers = itertools.count(1_000_001)  # apart from the tokens of orders
        self._armed: list[Armed] = []
        self._cells = Cells(deployment)

    def arm(self, fault: Fault) -> Keys:
        """Apply `fault` now, later, or have its emitter wait for its event.

        Raises StepFailed; NobodyThere is a refusal: nothing has been armed, and the run is not judged by it.
        """
        number = next(self._numbers)
        armed = Armed(number, fault, self._support.draw(number))
        self._armed.append(armed)
        self._tell("armed", str(fault))
        if isinstance(fault.action, Flip) and fault.action.field:
            yield from self._move_in(armed, fault.action)
        if fault.trigger.when is not None:
            yield from self._support.watch(number, fault.trigger.when, lambda met: self._met(armed, met))
            return
        if fault.trigger.after_ms and not fault.trigger.event:
            self._loop.after(fault.trigger.after_ms / 1e3, lambda: self._start(armed))
            return
        try:
            yield from self._begin(armed)
        except NobodyThere as refusal:
            self._armed.remove(armed)
            self._tell("refused", str(refusal))
            raise

    def _start(self, armed: Armed) -> None:
        self._loop.jobs.start(f"fault {armed.fault}", self._begin(armed), lambda failure: None)

    def _met(self, armed: Armed, met: Met) -> None:
        """Its condition holds."""
        armed.met, armed.unmet = met, None
        self._tell("met", f"{armed.fault}: at {met.t_us / 1e6:.6f} s")
        self._loop.jobs.start(
            f"fault {armed.fault}", self._begin(armed), lambda failure: armed.begun(self._loop.now_ns())
        )

    def _begin(self, armed: Armed) -> Keys:
        action = armed.fault.action
        waits = armed.fault.event or isinstance(action, Disturb)
        try:
            if isinstance(action, BusFault):
                yield from self._support.disturb(armed.number, action, armed.draw)
            else:
                yield from self._place(armed) if waits else self._apply(armed)
        except NobodyThere as failure:
            armed.receipt = Receipt(NOT_ACTIVATED, str(failure))
            raise
        except StepFailed as failure:
            armed.receipt = Receipt(INJECT_ERROR, str(failure))
            raise

    def _place(self, armed: Armed) -> Keys:
        """Have whoever comes to its point wait for it. Raises NobodyThere, or StepFailed."""
        deployment, fault = self._deployment, armed.fault
        graph, roles = deployment.graph, (deployment.leader, deployment.backup)
        armed.waits = True
        if fault.event and targets.emitter(graph, fault.event, *roles) == targets.SUPERVISOR:
            return
        brick = targets.waits_in(fault, graph, *roles)
        node = "" if brick is None else graph.node_of(brick)
        if brick is None or not deployment.lives(node):
            does = f"emits {fault.event}" if fault.event else "sends there"
            raise NobodyThere(f"{fault}: nobody {does} now")
        itself = isinstance(fault.action, Crash) and node in self._nodes_of(fault.target)
        share = targets.emitters_in(graph, fault.event, node) if fault.event else 1
        armed.move_in(deployment.nodes[node], brick, share, self._loop.now_ns(), itself=itself)
        yield from deployment.ask(node, lambda token: armed.order(token, armed.left))

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
            yield from self._deployment.ask(host.name, lambda token: armed.order(token, 0))

    def rearm(self) -> Keys:
        """After a change of roles, or of the graph: what waits in a node that is not the emitter moves on."""
        self._cells.leave_the_dead()
        for armed in self._armed:
            if armed.receipt.state != ARMED or not armed.waits:
                continue
            self._look(armed)
            if armed.receipt.state != ARMED or self._stands(armed):
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
            if armed.receipt.state == ARMED and armed.waits and armed.fault.event == event.label:
                armed.left -= 1
                if armed.left == 0 and event is Event.ADAPT_STEP_ACT:
                    next(self._apply(armed), None)
                elif armed.left == 0:
                    yield from self._apply(armed)

    def _look(self, armed: Armed) -> None:
        """A node that has hit itself, or has felt what hit it, has left word in its journal."""
        paths = armed.journals | {p.journal for p in armed.hit if p.journal}
        journal = [record for path in paths for record in self._support.records(path)]
        words = receipts.told(armed.number, journal)
        match armed.fault.action:
            case Crash():
                self._look_for_death(armed, itself=bool(words) and armed.itself)
            case FlipMemory():
                pass
            case Hang():
                if armed.receipt.state == APPLIED and not all(p.alive for p in armed.hit):
                    armed.receipt = Receipt(ACTIVATED)
            case Slow():
                if armed.receipt.state == APPLIED and words:
                    armed.receipt = Receipt(ACTIVATED)
            case BusFault():
                struck = self._support.bus_fault(armed.number)
                if struck is not None:
                    armed.receipt = Receipt(struck.receipt, struck.detail)
                    armed.unmet = armed.fault.action.opening.when if struck.waits else None
            case Disturb():
                if words:
                    armed.receipt = receipts.of_channel(armed.brick, words)
            case Flip() as flip:
                if armed.flipped is not None:
                    records = self._support.records(armed.flipped.home.process.journal)
                    armed.receipt = receipt(armed.flipped, records)
                elif words and not flip.field:
                    used = [*journal, *self._log_of(armed)] if flip.place is Place.LOG else journal
                    found = receipts.of_flip(armed.fault, flip, armed.brick, armed.draw, words, used)
                    armed.receipt = found
            case _:
                assert_never(armed.fault.action)

    def _look_for_death(self, armed: Armed, *, itself: bool) -> None:
        if itself:
            dead = armed.host is None or not armed.host.alive
            armed.receipt = Receipt(ACTIVATED if dead else APPLIED)
        elif armed.receipt.state == APPLIED and not any(p.alive for p in armed.hit):
            armed.receipt = Receipt(ACTIVATED)

    def _log_of(self, armed: Armed) -> Iterable[Record]:
        """What the Protocol of the struck replica has written, if it is not the one that was struck."""
        deployment = self._deployment
        replica = armed.brick.partition("/")[0]
        node = next(
            (n for n, hosted in deployment.graph.nodes.items() if f"{replica}/protocol" in hosted), ""
        )
        process = deployment.nodes.get(node)
        if process is None or process.journal in armed.journals:
            return ()
        return self._support.records(process.journal)

    def fired(self, process: Process, number: int) -> None:
        """The emitter has reached the point, and waits; or it has done by itself what was to do."""
        armed = next((a for a in self._armed if a.number == number), None)
        if armed is None:
            return
        action = armed.fault.action
        if isinstance(action, Disturb) or (isinstance(action, Flip) and not action.field):
            self._look(armed)
            self._tell("fault", f"{armed.fault}: {armed.receipt.state}, {armed.receipt.detail}")
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

    # -- a field of the state -----------------------------------------------------------------

    def _move_in(self, armed: Armed, flip: Flip) -> Keys:
        """Have the function that is meant live in a cell. Raises StepFailed where it has no such field."""
        with contextlib.suppress(StepFailed):  # it is gone: who takes its place is asked when it is time
            home = yield from self._cells.of(self._replica_of(armed.fault.target), armed.number)
            try:
                check_field(flip, home.layout.fields)
            except ConfigError as error:
                armed.receipt = Receipt(NOT_ACTIVATED, str(error))
        if armed.receipt.state == NOT_ACTIVATED:
            raise NobodyThere(armed.receipt.detail)

    def _replica_of(self, target: str) -> str:
        """The replica that is meant now, or `""`."""
        return {"primary": self._deployment.leader, "backup": self._deployment.backup}.get(target, target)

    def _flip(self, armed: Armed, flip: Flip) -> Keys:
        """In memory, wherever that is now: who leads may be another since the arming."""
        try:
            home = yield from self._cells.of(self._replica_of(armed.fault.target), armed.number)
            now_ns = self._loop.now_ns()
            self._support.journal.write(now_ns, Event.FAULT_APPLIED, 0, armed.number)
            armed.flipped = home.flip(flip, now_ns, armed.draw)
        except (StepFailed, ConfigError) as error:
            armed.receipt = Receipt(NOT_ACTIVATED, str(error))
        else:
            armed.receipt = receipt(armed.flipped, ())
        self._tell("fault", f"{armed.fault}: {armed.receipt.state}, {armed.receipt.detail}")

    def _apply(self, armed: Armed) -> Keys:
        if isinstance(armed.fault.action, Flip):
            yield from self._flip(armed, armed.fault.action)
            return
        armed.hit = hit = self._hit(armed.fault.target)
        if not hit:
            armed.receipt = Receipt(NOT_ACTIVATED, "nobody to hit")
            self._tell("fault", f"{armed.fault}: nobody to hit")
            return
        self._support.journal.write(self._loop.now_ns(), Event.FAULT_APPLIED, 0, armed.number)
        match armed.fault.action:
            case Crash():
                dead: set[Key] = {("died", p.name, p.pid) for p in hit}
                for process in hit:
                    process.kill()
                armed.receipt = Receipt(APPLIED)
                yield Wait(frozenset(dead))
            case Hang(for_ms):
                yield from self._hang(armed, hit, for_ms)
            case Slow() as slow:
                yield from self._slow(armed, hit, slow)
            case FlipMemory() as flip:
                self._flip_memory(armed, hit, flip)
                yield Wait(frozenset())
            case Disturb() | BusFault():
                raise AssertionError(f"{armed.fault} strikes where it waits")
            case _:
                assert_never(armed.fault.action)

    def _hang(self, armed: Armed, hit: list[Process], for_ms: int) -> Generator[Wait, dict[Key, bytes], None]:
        for process in hit:
            process.freeze(for_ms)
        limit_ns = self._loop.now_ns() + STOP_NS_MAX
        while not all(p.stopped() for p in hit) and self._loop.now_ns() < limit_ns:
            self._loop.rest(0)  # the state change is the kernel's next few microseconds of work
        running = [p.name for p in hit if not p.stopped()]
        if running:
            seconds = STOP_NS_MAX / 1e9
            armed.receipt = Receipt(
                INJECT_ERROR, f"not seen stopped within {seconds} s: {', '.join(running)}"
            )
        else:
            armed.receipt = Receipt(APPLIED)
        if for_ms:
            self._loop.after(for_ms / 1e3, lambda: _resume(armed))
        yield Wait(frozenset())

    def _slow(self, armed: Armed, hit: list[Process], slow: Slow) -> Keys:
        deployment, number = self._deployment, armed.number
        by_ns, share = round(slow.by_ms * 1e6), slow.share or control.WHOLE
        sent = [
            deployment.order_to(p, lambda token: control.SlowDown(token, number, by_ns, share)) for p in hit
        ]
        yield from deployment.all_of(sent)
        armed.receipt = Receipt(APPLIED)
        if slow.for_ms:
            self._loop.after(slow.for_ms / 1e3, lambda: self._speed_up(armed))

    def _speed_up(self, armed: Armed) -> None:
        for process in armed.hit:
            with contextlib.suppress(StepFailed):  # it is gone, and its slowness with it
                self._deployment.order_to(process, lambda token: control.SlowDown(token, armed.number, 0))

    def _flip_memory(self, armed: Armed, hit: list[Process], flip: FlipMemory) -> None:
        """Of a replica, in one of its nodes."""
        process = sorted(hit, key=lambda p: p.name)[armed.draw % len(hit)]
        try:
            armed.receipt = Receipt(APPLIED, self._support.flip_memory(process, flip, armed.draw))
        except StepFailed as failure:
            armed.receipt = Receipt(INJECT_ERROR, str(failure))
        self._tell("fault", f"{armed.fault}: {armed.receipt.state}, {armed.receipt.detail}")

    def receipts(self) -> list[dict[str, str]]:
        """What became of each fault; `detail` where there is more to say."""
        for armed in self._armed:
            self._look(armed)
        reports = [(armed.fault, armed.report()) for armed in self._armed]
        return [
            {"fault": str(fault), "receipt": said.state} | ({"detail": said.detail} if said.detail else {})
            for fault, said in reports
        ]


def _resume(armed: Armed) -> None:
    """Its time is over: who still is stopped runs on."""
    ran_on = [process.thaw() for process in armed.hit]
    if any(ran_on) and armed.receipt.state == APPLIED:
        armed.receipt = Receipt(ACTIVATED)

"""The faults of a run: from arming to the receipt. What a fault does is its kind's affair (`inject.kind`).

A fault that waits for an event waits in the node that emits it. Where the node cannot do by itself what is
to be done, it waits until the supervisor has hit the target and seen it hit (dead, stopped, or slow by its
own word): a process goes on for a while after a signal was sent. The events of an adaptation are emitted by
the supervisor itself: see `at`.

A fault with a condition of the car is armed when the condition holds. In virtual time and in lockstep the
car waits with its next step until that is done; in real time it drives on, and the receipt has the delay.

Each fault ends with a receipt. A fault that has struck stays with its process, even if it lasts: it does
not move to the process that takes its place.
"""

import contextlib
import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import cast

import msgspec

from aftbed.core.errors import ConfigError, StepFailed
from aftbed.core.events import FIRST_FAULT, Event, event_named
from aftbed.core.journal import Record
from aftbed.inject import targets
from aftbed.inject.kind import Injection, Steps
from aftbed.inject.model import ArmedFault, Fault, FaultReport
from aftbed.inject.receipts import BusReport, RadarReport, Receipt, ReceiptState, records_about
from aftbed.inject.shared_state import SharedState, StateLayout
from aftbed.inject.targets import Roles, TargetProcess
from aftbed.runtime import control
from aftbed.runtime.deployment import Deployment, Keys
from aftbed.runtime.interface import Met, Process, SharedMemory
from aftbed.runtime.tasks import Key, Wait, death_of


class NoHost(StepFailed):
    """As the roles are now, nothing comes to the point of a fault."""


class RunInjection(Injection):
    """One fault of a run, with what the controller keeps of it."""

    def __init__(self, number: int, fault: Fault, draw: int, *, live: bool) -> None:
        super().__init__(number, fault, draw)
        self.fault: Fault = fault
        self.live = live
        self.left = fault.trigger.nth  # occurrences of its event until it strikes, since it came to its host
        self.waits = False  # for its event: in its host, or, while no node emits it, in none
        self.process: Process | None = None  # the host
        self.met: Met | None = None
        self._lag_ns = 0  # from there to the effect
        self._since_ns = 0  # in this host
        self._emitters = 1  # how many bricks of the host emit the event

    def move_in(self, host: Process, brick: str, emitters: int, now_ns: int, *, by_itself: bool) -> None:
        """Wait in `host` from now on."""
        assert host.journal, host.name
        self.host = self.process = host
        self.brick, self._emitters, self.by_itself = brick, emitters, by_itself
        self.journals.add(host.journal)
        self._since_ns = now_ns

    def move_out(self, records: Iterable[Record]) -> None:
        """The host has recorded the events that happened there: they stay counted.

        Messages are not recorded: their count begins anew.
        """
        if self.fault.event:
            event = event_named(self.fault.event)
            happened = sum(r.event is event and r.t_ns >= self._since_ns for r in records)
            self.left = max(1, self.left - happened // self._emitters)
        self.host = self.process = None

    def order(self, token: int, nth: int) -> control.Arm:
        """To the host; `nth` 0: wait no longer."""
        fault = self.fault
        armed = ArmedFault(
            self.number, self.brick, nth, fault.action, self.by_itself, self.draw, fault.persistence
        )
        return control.Arm(token, "" if fault.action.counts_messages else fault.event, (armed,))

    def begun(self, now_ns: int) -> None:
        """What followed its condition is done: the car goes on, if it waited."""
        assert self.met is not None
        self._lag_ns = now_ns - self.met.since_ns if self.met.since_ns else 0
        self.met.go_on()

    def report(self) -> FaultReport:
        """The receipt, with its condition. A condition that never held has a receipt of its own."""
        found = self.receipt
        if self.unmet is not None and found.state is ReceiptState.ARMED:
            found = Receipt(ReceiptState.NOT_ACTIVATED, f"{self.unmet} never held")
        elif self.met is not None:
            held = f"{self.fault.trigger.when} at {self.met.t_us / 1e6:.6f} s"
            held += f", {self._lag_ns / 1e6:.2f} ms before" if self._lag_ns else ""
            found = Receipt(found.state, "; ".join(filter(None, (found.detail, held))), found.bus)
        number = self.number - FIRST_FAULT
        return FaultReport(str(self.fault), found.state, found.detail, self.live, found.bus, number)


class FaultController:
    """All faults of a run. It is the `RunControl` of their kinds."""

    def __init__(self, deployment: Deployment) -> None:
        self._deployment, self._runtime = deployment, deployment.runtime
        self._loop, self._log = self._runtime.loop, self._runtime.log
        self._numbers = itertools.count(FIRST_FAULT)
        self._injections: list[RunInjection] = []
        self._shared: dict[Process, tuple[SharedState, SharedMemory]] = {}

    # -- arming -----------------------------------------------------------------------------------

    def arm(self, fault: Fault, *, live: bool = False) -> Keys:
        """Apply `fault` now, later, or have it wait for its event. If `live`, it came while the run ran.

        Raises StepFailed; NoHost is a refusal: nothing has been armed, and no run is judged by a live one.
        """
        number = next(self._numbers)
        injection = RunInjection(number, fault, self._runtime.draw(number), live=live)
        self._injections.append(injection)
        self._log("armed", str(fault))
        try:
            yield from self._arm(injection)
        except NoHost as refusal:
            if live:  # the user knows; of one that came with the run, the receipt says why
                self._injections.remove(injection)
            self._log("refused", str(refusal))
            raise

    def _arm(self, injection: RunInjection) -> Keys:
        fault, trigger = injection.fault, injection.fault.trigger
        if fault.action.shares_state:
            yield from self._share_early(injection)
        if trigger.when is not None:
            yield from self._runtime.watch(
                injection.number, trigger.when, lambda met: self._met(injection, met)
            )
        elif trigger.after_ms and not trigger.event:
            self._loop.after(trigger.after_ms / 1e3, lambda: self._run(injection, self._begin(injection)))
        else:
            yield from self._begin(injection)

    def _run(
        self, injection: RunInjection, steps: Keys, on_end: Callable[[str], None] = lambda failure: None
    ) -> None:
        self._loop.tasks.start(f"fault {injection.fault}", steps, on_end)

    def _met(self, injection: RunInjection, met: Met) -> None:
        """Its condition holds."""
        injection.met, injection.unmet = met, None
        self._log("met", f"{injection.fault}: at {met.t_us / 1e6:.6f} s")
        self._run(injection, self._begin(injection), lambda failure: injection.begun(self._loop.now_ns()))

    def _begin(self, injection: RunInjection) -> Keys:
        try:
            waits = injection.fault.action.waits(injection.fault)
            yield from self._place(injection) if waits else self._act(injection)
        except NoHost as failure:
            injection.receipt = Receipt(ReceiptState.NOT_ACTIVATED, str(failure))
            raise
        except StepFailed as failure:
            injection.receipt = Receipt(ReceiptState.INJECT_ERROR, str(failure))
            raise

    def _act(self, injection: RunInjection) -> Keys:
        action = injection.fault.action
        yield from action.act(injection, self)
        if action.lasts_ms and injection.struck:
            self._loop.after(action.lasts_ms / 1e3, lambda: action.undo(injection, self))

    # -- where a fault waits ----------------------------------------------------------------------

    def _place(self, injection: RunInjection) -> Keys:
        """Have the node that comes to its point wait for it. Raises NoHost, or StepFailed."""
        deployment, fault, roles = self._deployment, injection.fault, self._roles()
        injection.waits = True
        if fault.event and targets.emitting_node(roles, fault.event) == targets.SUPERVISOR:
            return
        brick = fault.action.waits_in(fault, roles)
        node = "" if brick is None else roles.graph.node_of(brick)
        if brick is None or not deployment.lives(node):
            does = f"emits {fault.event}" if fault.event else "sends there"
            raise NoHost(f"{fault}: no process {does} now")
        by_itself = fault.action.emitter_may_act and node in self._nodes_of(fault.target)
        emitters = targets.emitters_in(roles.graph, fault.event, node) if fault.event else 1
        injection.move_in(deployment.nodes[node], brick, emitters, self._loop.now_ns(), by_itself=by_itself)
        yield from deployment.ask(node, lambda token: injection.order(token, injection.left))

    def _is_in_place(self, injection: RunInjection) -> bool:
        """Whether its host still is the process that comes to its point."""
        host, roles = injection.process, self._roles()
        brick = injection.fault.action.waits_in(injection.fault, roles)
        if host is None or brick is None or brick != injection.brick:
            return False
        return host.alive and self._deployment.nodes.get(roles.graph.node_of(brick)) is host

    def _withdraw(self, injection: RunInjection, host: Process) -> Keys:
        """Its host no longer emits its event, was replaced, or is dead.

        One that was replaced serves again if the adaptation is undone. It reads this before any mail.
        """
        deployment = self._deployment
        injection.move_out(self._runtime.records(host.journal))
        if not host.alive:
            return
        sent = deployment.order(host, lambda token: injection.order(token, 0))
        if deployment.nodes.get(host.name) is host:
            yield from deployment.answers([sent])

    def rearm(self) -> Keys:
        """After a change of roles, or of the graph: move what waits in a node that no longer emits its
        event.
        """
        self._forget_dead()
        for injection in self._injections:
            if injection.receipt.state is not ReceiptState.ARMED or not injection.waits:
                continue
            self._look(injection)
            if injection.receipt.state is not ReceiptState.ARMED or self._is_in_place(injection):
                continue
            with contextlib.suppress(StepFailed):  # no node emits it now; the next change asks again
                if injection.process is not None:
                    yield from self._withdraw(injection, injection.process)
                yield from self._place(injection)

    # -- at its point -----------------------------------------------------------------------------

    def at(self, event: Event) -> Keys:
        """The executor has come to `event`: what is due strikes, and is seen to have struck when this ends.

        ADAPT_STEP_ACT is not waited for: there, the death and the answer to the step are on their way at
        once.
        """
        for injection in list(self._injections):
            armed = injection.receipt.state is ReceiptState.ARMED and injection.waits
            if armed and injection.fault.event == event.label:
                injection.left -= 1
                if injection.left == 0 and event is Event.ADAPT_STEP_ACT:
                    next(self._act(injection), None)
                elif injection.left == 0:
                    yield from self._act(injection)

    def fired(self, process: Process, number: int) -> None:
        """The host has come to the point and waits; or the agent in it has done what was to do."""
        injection = next((i for i in self._injections if i.number == number), None)
        if injection is None:
            return
        if injection.fault.action.acts_in_node:
            self._look(injection)
            self.log(injection)
            return

        def answer(failure: str) -> None:
            with contextlib.suppress(StepFailed):  # it may be among those that were hit
                self._deployment.pool.order(process, control.Ack(number))

        self._run(injection, self._act(injection), answer)

    def _look(self, injection: RunInjection) -> None:
        injection.receipt = injection.fault.action.receipt(injection, self)

    def reports(self) -> list[FaultReport]:
        """What became of each fault."""
        for injection in self._injections:
            self._look(injection)
        return [injection.report() for injection in self._injections]

    # -- what kinds may do: see `inject.kind.RunControl` --------------------------------------------

    def _roles(self) -> Roles:
        deployment = self._deployment
        return Roles(deployment.graph, deployment.leader, deployment.backup)

    def _nodes_of(self, target: str) -> list[str]:
        """The nodes that `target`, a role or a node, means now."""
        deployment = self._deployment
        if target in targets.ROLES:
            name = self._roles().replica(target)
            return list(deployment.slots[name].nodes) if name else []
        return [target] if target in deployment.graph.nodes else []

    def processes(self, injection: Injection) -> Sequence[Process]:
        """The living nodes that the target means; else other processes of that name."""
        deployment, target = self._deployment, injection.fault.target
        nodes = self._nodes_of(target)
        found = [p for n, p in deployment.nodes.items() if n in nodes and p.alive]
        return found or [p for p in deployment.pool.processes if p.name == target and p.pid]

    def now_ns(self) -> int:
        return self._loop.now_ns()

    def pause(self) -> None:
        self._loop.rest(0)

    def log(self, injection: Injection) -> None:
        line = ", ".join(filter(None, (injection.receipt.state.value, injection.receipt.detail)))
        self._log("fault", f"{injection.fault}: {line}")

    def record_strike(self, injection: Injection) -> None:
        self._runtime.journal.write(self._loop.now_ns(), Event.FAULT_APPLIED, 0, injection.number)

    def until_dead(self, processes: Iterable[TargetProcess]) -> Steps[None]:
        yield Wait(frozenset(death_of(p.pid) for p in processes))

    def slow_down(self, process: TargetProcess, number: int, by_ns: int, share: float) -> tuple[Key, str]:
        return self._deployment.order(
            cast("Process", process), lambda token: control.SlowDown(token, number, by_ns, share)
        )

    def until_answered(self, orders: Iterable[tuple[Key, str]]) -> Steps[None]:
        yield from self._deployment.answers(orders)

    def flip_memory(self, process: TargetProcess, bit: int | None, address: int | None, draw: int) -> str:
        return self._runtime.flip_memory(cast("Process", process), bit, address, draw)

    def disturb(self, injection: Injection) -> Steps[None]:
        yield from self._runtime.disturb(injection.number, injection.fault.action, injection.draw)

    def disturbance(self, injection: Injection) -> BusReport | RadarReport | None:
        return self._runtime.disturbance(injection.number)

    def records_about(self, injection: Injection) -> list[Record]:
        """Of its hosts and of what it struck."""
        return records_about(injection.number, self.records_of(injection))

    def records_of(self, injection: Injection, brick: str = "") -> list[Record]:
        """Of its hosts, of what it struck, and of the process that hosts `brick` now."""
        paths = injection.journals | {p.journal for p in injection.struck if p.journal}
        process = self._process_of(brick)
        if process is not None:
            paths.add(process.journal)
        return [record for path in paths for record in self._runtime.records(path)]

    def journal(self, path: str) -> Iterable[Record]:
        return self._runtime.records(path)

    def _process_of(self, brick: str) -> Process | None:
        node = next((n for n, hosted in self._deployment.graph.nodes.items() if brick in hosted), "")
        return self._deployment.nodes.get(node)

    # -- shared state -----------------------------------------------------------------------------

    def shared_state(self, injection: Injection) -> Steps[SharedState]:
        """One for each process that hosts the Server of a target.

        Raises StepFailed if there is no such process.
        """
        brick = f"{self._roles().replica(injection.fault.target)}/server"
        self._forget_dead()
        process = self._process_of(brick)
        if process is None or not process.alive:
            raise StepFailed("no process to hit")
        if process not in self._shared:
            memory = self._runtime.shared_memory()
            shared = SharedState(injection.number, brick, process.journal, memory.memory)
            self._shared[process] = shared, memory
        shared, memory = self._shared[process]
        if shared.layout is None:
            number, ends = shared.number, (memory.fileno(),)
            data = yield from self._deployment.ask(
                process.name, lambda token: control.ShareState(token, brick, number), ends
            )
            shared.layout = msgspec.msgpack.decode(data, type=StateLayout)
            memory.seal()
        return shared

    def _share_early(self, injection: RunInjection) -> Keys:
        """From the arming on, so that the fault strikes at once.

        Raises NoHost where the function has no such field.
        """
        try:
            shared = yield from self.shared_state(injection)
            injection.fault.action.check_state(shared)
        except StepFailed:
            return  # the node is gone: its successor is asked when it is time
        except ConfigError as error:
            injection.receipt = Receipt(ReceiptState.NOT_ACTIVATED, str(error))
            raise NoHost(str(error)) from None

    def _forget_dead(self) -> None:
        """Let go of what processes that are gone shared."""
        for dead in [process for process in self._shared if not process.alive]:
            self._shared.pop(dead)[1].close()

"""An adaptation on real processes: the phases of one script, and the way back (design 4, "Adaptation order").

What is new is *staged*: processes beside those that serve, with their ends of channels, fed by nobody. A
channel that both graphs have is kept, with the mail that is in it; a new brick gets a descriptor of the
same socket. What is replaced is kept too, suspended, until the script is finished; so at any moment
before that, `undo` needs nothing but to hand descriptors out as before.

Who dies meanwhile fails the step that waits for it; `undo` leaves out whoever is dead.
"""

import contextlib
import functools
from collections.abc import Callable, Generator, Iterable, Sequence
from typing import Final

from aftbed.adapt.plan import drains
from aftbed.core import script
from aftbed.core.errors import StepFailed
from aftbed.core.events import Event
from aftbed.core.graph import STAGED, Graph
from aftbed.core.script import Script, flat
from aftbed.ftm.compose import REPLICAS, replication_of
from aftbed.ftm.registry import KINDS
from aftbed.runtime import control
from aftbed.runtime.deployment import Deployment, Keys, Slot
from aftbed.runtime.interface import Channel, Process, ProcessKind
from aftbed.runtime.jobs import Key, Wait, amid
from aftbed.runtime.rewiring import (
    Changes,
    Wires,
    gone,
    replica_of,
    stop_replication,
    tell,
    tell_whoever_lives,
    way_back,
)
from aftbed.runtime.transfer import Seat, align, answered, ask, end, migrate, seen_dead, transfer
from aftbed.runtime.zygotes import LIGHT

PREPARE_SECONDS_MAX: Final = 5.0  # a stranger's module is imported and tested meanwhile
SUSPEND_SECONDS_MAX: Final = 0.25  # longer, and the client would rather have the old mechanism back


class Exchange:
    """One adaptation. `step` is called at each verb, before and after it."""

    def __init__(self, deployment: Deployment, todo: Script, step: Callable[[Event, int], Keys]) -> None:
        self._deployment, self._todo, self._step = deployment, todo, step
        self.old: Graph = deployment.graph
        self.new: Graph = script.after(self.old, todo, KINDS)
        self._staged: dict[str, Process] = {}  # by node
        self._replaced: dict[str, Process] = {}  # the old ones, by node
        self._removed: dict[str, Process] = {}  # those that only the old graph has
        self._fresh = deployment.channels.fresh
        self._wires = Wires(deployment, self.new, self._staged)
        self._let_go: dict[tuple[str, str, str], Channel] = {}  # of the old graph only
        self._suspended: list[tuple[str, Process]] = []  # brick, its node's process
        self._migrated: list[str] = []
        self._rewired = False
        self._committing = False
        self._opened = False  # the leader's Protocol has been let on
        self._one_way = False  # what is replaced cannot go on from the state of what is new
        self.committed = False
        self._born: list[str] = []
        self.lost: set[str] = set()  # replicas that are left to Recovery
        self._number = self.closed_ns = self.opened_ns = 0  # when no request was served, and when again
        self.turned_ns = self.undone_ns = 0  # requests after it are the new graph's; the old one's again

    # -- the phases ---------------------------------------------------------------------------

    def prepare(self) -> Keys:
        """Stage and bind what is new."""
        sent = []
        for verb in flat(self._todo.prepare):
            if isinstance(verb, script.Stage):
                yield from self._enter()
                sent.append((yield from self._stage(verb)))
                yield from self._step(Event.ADAPT_STEP_ACT, self._number)
        yield from answered(sent, PREPARE_SECONDS_MAX)
        for number in range(1, self._number + 1):
            yield from self._step(Event.ADAPT_STEP_EXIT, number)
        yield from self._rewire([v for v in flat(self._todo.prepare) if isinstance(v, script.Bind)])
        wiring = [v for v in self._todo.commit if _wires(v)]
        # The paper's recipe stages in the commit; of several, the later ones depend on the first.
        if self._todo.recipe == script.RECIPES[0] and len(wiring) == 1:
            self._wires.foresee(tuple(flat((wiring[0],))))
        yield from self._deployment.nursery.calm(LIGHT)

    def _stage(self, verb: script.Stage) -> Generator[Wait, dict[Key, bytes], tuple[Key, str]]:
        process, sent = yield from self._deployment.stage(verb.node, self.new, held=verb.held)
        self._staged[verb.node] = process
        return sent

    def commit(self) -> Keys:
        """All that the client waits for."""
        self._committing = True
        if self._todo.recipe != script.RECIPES[0]:
            for slot in self._deployment.slots.values():  # it kills what they watch
                yield from self._deployment.watch(slot, nobody=True)
        self.closed_ns = self._deployment.support.loop.now_ns()
        try:
            for verb in self._todo.commit:
                yield from self._enter()
                yield from amid(self._do(verb), self._step(Event.ADAPT_STEP_ACT, self._number))
                yield from self._step(Event.ADAPT_STEP_EXIT, self._number)
            self._assert_whole()
        except StepFailed:
            if self._opened:  # requests may have passed: the state that counts is in what is new
                self._adopt()
                yield from self._try_way_back()
            if not self._one_way:
                raise
        self.opened_ns = self._deployment.support.loop.now_ns()
        if not self.committed:
            self._adopt()
        yield from self._watch()
        if not self._one_way:
            yield from self._try_way_back()
        for slot in self._deployment.slots.values():
            if self._one_way:
                self._leave_if_dead(slot)
            else:
                self._deployment.assert_whole(slot)

    def _leave_if_dead(self, slot: Slot) -> None:
        """There is no way back, so it is Recovery's, as at any other time."""
        if not all(map(self._deployment.lives, self._deployment.nodes_of(slot))):
            self._deployment.lost.add(slot.name)

    def _assert_whole(self) -> None:
        """Raise StepFailed if a node of a replica is dead: not every step asks everybody."""
        for node in self.new.nodes:
            process = self._staged.get(node) or self._deployment.nodes.get(node)
            if replica_of(node) and (process is None or not process.alive):
                raise StepFailed(f"{node} died")

    def finish(self) -> Keys:
        """End what does not serve any more."""
        for process in (*self._replaced.values(), *self._removed.values()):
            end(process)
        for channel in self._let_go.values():
            channel.close()
        self._let_go, self._replaced, self._removed = {}, {}, {}
        yield Wait(frozenset())

    def _enter(self) -> Keys:
        self._number += 1
        yield from self._step(Event.ADAPT_STEP_ENTER, self._number)

    # -- the verbs ----------------------------------------------------------------------------

    def _do(self, verb: script.Step) -> Keys:
        match verb:
            case script.Suspend(brick):
                yield from self._suspend(brick, drain=False)
            case script.Drain(brick):
                yield from self._suspend(brick, drain=True)
            case script.Align(source, sink):
                yield from align(self._deployment, self._seat(source), self._seat(sink))
            case script.Transfer(source, sink):
                yield from transfer(self._deployment, self._seat(source), self._seat(sink))
            case script.Migrate(node):
                self._migrated.append(node)
                serving, staged = self._deployment.nodes[node], self._staged[node]
                yield from migrate(self._deployment, self.old, serving, self.new, staged, node)
            case _ if _wires(verb):
                yield from self._rewire(tuple(flat((verb,))))
            case script.Together(verbs):
                self._assert_whole()
                yield from self._resume([v.brick for v in verbs if isinstance(v, script.Resume)])
            case script.Resume(brick):
                yield from self._resume([brick])
            case script.Freeze(brick):
                self._wires.process(brick).freeze()
            case script.Thaw(brick):
                self.turned_ns = self._deployment.support.loop.now_ns()
                self._wires.process(brick).thaw()
            case script.Destroy(node):
                self._destroy(node)
            case script.Stage() as verb:
                yield from answered([(yield from self._stage(verb))], PREPARE_SECONDS_MAX)
            case _:
                raise StepFailed(f"{type(verb).__name__} has no place in the commit of an adaptation")

    def _seat(self, brick: str) -> Seat:
        return brick, self._wires.process(brick)

    def _destroy(self, node: str) -> None:
        """With whatever is inside."""
        process = self._deployment.nodes.get(node)
        if process is None:
            raise StepFailed(f"{node} is gone")
        end(process)
        if node not in self.new.nodes:
            del self._deployment.nodes[node]

    def _suspend(self, brick: str, *, drain: bool) -> Keys:
        process = self._wires.process(brick)
        self._suspended.append((brick, process))
        yield from ask(
            self._deployment, process, lambda token: control.Suspend(token, drain), SUSPEND_SECONDS_MAX
        )

    def _resume(self, bricks: Iterable[str]) -> Keys:
        sent = []
        for brick in bricks:
            before_ns = self._deployment.support.loop.now_ns()
            sent.append(self._deployment.order_to(self._wires.process(brick), control.Resume))
            if brick == f"{self._deployment.leader}/protocol":
                self._opened, self.turned_ns = True, before_ns
            self._suspended = [(b, p) for b, p in self._suspended if b != brick]
        yield from answered(sent)

    # -- channels -----------------------------------------------------------------------------

    def _rewire(self, verbs: Sequence[script.Step]) -> Keys:
        """Everybody hears of all that concerns him at once. In `prepare`, only what is staged."""
        bound = any(isinstance(verb, script.Bind | script.Unbind) for verb in verbs)
        self._rewired = self._rewired or (bound and self._committing)
        exchanged = [verb.node for verb in verbs if isinstance(verb, script.Exchange)]
        for node in exchanged:  # even if another one cannot be told
            self._suspended.append((node, self._wires.serving(node)))
        yield from tell(self._deployment, self._wires.told(verbs, committing=self._committing))
        for node in exchanged:
            self._take_place(node)

    def _take_place(self, node: str) -> None:
        """The staged process is the node from now on."""
        deployment = self._deployment
        old, new = deployment.nodes[node], self._staged.pop(node)
        self._replaced[node] = old
        old.name, old.kind = f"{node}{STAGED}", ProcessKind.STAGED
        new.name, new.kind = node, ProcessKind.NODE
        deployment.nodes[node] = new
        self._suspended = [(b, new if p is old else p) for b, p in self._suspended]

    def _adopt(self) -> None:
        """The new graph runs."""
        deployment = self._deployment
        for node, process in self._staged.items():
            process.name, process.kind = node, ProcessKind.NODE
            deployment.nodes[node] = process
        self._born = list(self._staged)
        self._staged.clear()
        for node in [n for n in deployment.nodes if n not in self.new.nodes]:
            process = self._removed[node] = deployment.nodes.pop(node)
            process.name, process.kind = f"{node}{STAGED}", ProcessKind.STAGED
        kept = {(k.source, k.source_port, k.sink) for k in self.new.links}
        for key, _ in deployment.channels.items():
            if key not in kept:
                self._let_go[key] = deployment.channels.take(key)
        for channel in self._fresh.values():
            deployment.channels.put(channel)
        self._fresh.clear()
        deployment.adopt(self.new)
        others = [r for r in REPLICAS if r != deployment.leader]
        alone = not replication_of(self.new.ftm) or others[0] not in deployment.slots
        deployment.backup = "" if alone else others[0]
        self.committed = True

    def _watch(self) -> Keys:
        for slot in self._deployment.slots.values():
            if slot.name not in self.lost:
                with contextlib.suppress(StepFailed):  # a Watchdog that is dead is replaced, and told then
                    yield from self._deployment.watch(slot)

    # -- the way back -------------------------------------------------------------------------

    def undo(self, lost: str = "") -> Keys:
        """What runs is the old graph again, whatever has been done; what is new dies.

        A replica that is `lost`, or has a dead node, is left to Recovery: nothing of it serves again.
        """
        deployment = self._deployment
        # Before requests are let on, it is the old processes that count: a new one may be dead.
        # Afterwards both count: it is the old ones that are to serve, with the state of the new ones.
        serving = list((deployment.nodes | self._replaced).items())
        serving += list(deployment.nodes.items()) if self.committed else []
        self.lost = {lost, *gone(serving, deployment.support.loop.now_ns())} - {""}
        if self.committed:  # else the Watchdogs have seen it
            deployment.lost |= self.lost
            yield from self._reverse_adoption()
        if self._rewired:
            yield from tell_whoever_lives(deployment, self._old_ends())
        for node, old in self._replaced.items():
            self._staged[node], deployment.nodes[node] = deployment.nodes[node], old
            old.name, old.kind = node, ProcessKind.NODE
        for node, process in self._removed.items():
            process.name, process.kind, deployment.nodes[node] = node, ProcessKind.NODE, process
        if self.committed:
            deployment.adopt(self.old, self.lost)
            yield from self._watch()  # before those die that are watched now
        yield from seen_dead(self._staged.values())
        for channel in self._fresh.values():
            channel.close()
        self.undone_ns = deployment.support.loop.now_ns()
        self._let_serve()
        self._replaced, self._removed, self._suspended = {}, {}, []
        self._staged.clear()
        self._fresh.clear()
        self.committed = False
        yield Wait(frozenset())

    def _let_serve(self) -> None:
        """Whoever was suspended goes on, but for a lost replica."""
        waiting = {id(p): p for p in (*(p for _, p in self._suspended), *self._replaced.values())}
        for process in waiting.values():
            if process.kind is not ProcessKind.KILLED and replica_of(process.name) not in self.lost:
                with contextlib.suppress(StepFailed):
                    self._deployment.order_to(process, control.Resume)

    def _old_ends(self) -> dict[int, Changes]:
        """What must be heard for the old graph to be wired as it was."""

        def serving(node: str) -> Process | None:
            process = self._replaced.get(node) or self._deployment.nodes.get(node)
            lost = process is None or not process.alive or replica_of(node) in self.lost
            return None if lost else process

        back = {b for node in self._replaced for b in self.old.nodes[node]}
        return way_back(self.old, self.new, back, serving, self._deployment.channels)

    def _reverse_adoption(self) -> Keys:
        """From a graph that serves: stop it, take the state back, and let its channels go."""
        deployment = self._deployment
        if deployment.leader in self.lost and not replication_of(self.new.ftm):
            self.lost |= set(REPLICAS)  # nobody else has its state
            deployment.lost |= self.lost
        for replica in sorted(self.lost & deployment.slots.keys()):  # it may live and serve: not any more
            deployment.shut_replication(deployment.slots[replica])
        if deployment.leader not in self.lost and self.lost:
            yield from stop_replication(deployment, self.new.ftm, self._wires.process)
        path = [(f"{deployment.leader}/protocol", False), *((b, True) for b in drains(self.new, self.old))]
        for brick, drain in path:
            if replica_of(brick) not in self.lost:
                yield from self._or_lost(brick, self._suspend(brick, drain=drain))
        for node in self._migrated:
            giver, taker = deployment.nodes[node], self._replaced[node]
            if replica_of(node) not in self.lost:
                yield from self._or_lost(node, migrate(deployment, self.new, giver, self.old, taker, node))
        for node in self._born:
            if node in deployment.nodes:
                self._staged[node] = deployment.nodes.pop(node)
        kept = {(k.source, k.source_port, k.sink) for k in self.old.links}
        for key, _ in deployment.channels.items():
            if key not in kept:
                self._fresh[key] = deployment.channels.take(key)
        for channel in self._let_go.values():
            deployment.channels.put(channel)
        self._let_go.clear()
        others = [r for r in REPLICAS if r != deployment.leader]
        deployment.backup = others[0] if replication_of(self.old.ftm) else ""

    def _or_lost(self, name: str, steps: Keys) -> Keys:
        """A replica that cannot be stopped, or gives its state back to nobody, must not serve."""
        try:
            yield from steps
        except StepFailed:
            self.lost.add(replica_of(name))
            self._deployment.lost.add(replica_of(name))

    def _try_way_back(self) -> Keys:
        """Whether a class of before takes the state of the one that has its place: it need not.

        Asked when requests have been let on, so that nobody waits for it; what is replaced rests meanwhile.
        """
        deployment = self._deployment
        for node, brick in self._another_class():
            capture = functools.partial(control.Capture, brick=brick)
            giver, taker = self._wires.serving(node), self._replaced[node]
            try:
                state = yield from ask(deployment, giver, capture)
                if state:
                    restore = functools.partial(control.Restore, brick=brick, state=state, migrate=True)
                    yield from ask(deployment, taker, restore)
            except StepFailed:
                self._one_way = self._one_way or (giver.alive and taker.alive)  # else it was a death

    def _another_class(self) -> list[tuple[str, str]]:
        """Where state was handed to a brick of another class, or with another function: nodes and bricks."""

        def written(graph: Graph, brick: str) -> tuple[str, str]:
            return graph.brick(brick).source, graph.brick(brick).application

        moved = [(n, b) for n in self._migrated for b in self.old.nodes[n] if b in self.new.nodes[n]]
        return [(n, b) for n, b in moved if written(self.old, b) != written(self.new, b)]

    def can_go_back(self, without: str) -> bool:
        """Whether what is replaced lives, but for that replica's, and can take the state."""
        return not self._one_way and all(
            p.alive for n, p in self._replaced.items() if replica_of(n) != without
        )


def _wires(verb: script.Step) -> bool:
    """Whether `verb` is about channels and places."""
    if isinstance(verb, script.Together):
        return not all(isinstance(inner, script.Resume) for inner in verb.steps)
    return isinstance(verb, script.Bind | script.Unbind | script.Exchange)

"""The script executor: carries out failovers, new backups and adaptations, and takes back what fails.

A step is a generator that waits for the answers of processes. Where one fails, the script stops, and the
executor runs the inverse of what was done (`core.script.inverse`), leaving out replicas that are lost.

*Rebinding* is which processes must be given which ends of channels on the way from one graph to another. A
channel that both graphs have is kept, with the mail that is in it; a brick that comes to it gets a descriptor
of the same socket. Each process gets all its changes in one order (`control.Rewire`). The orders of a commit
are worked out before the client waits for them (`Rebinding.prepare`), and are used if no process and no
channel has been replaced meanwhile.

An adaptation is a transaction of phases that the Engine orders one by one. Its new processes are *staged*
beside those that serve; what is replaced stands beside the new ones, suspended, until the script is finished.
"""

from collections.abc import Callable, Container, Generator, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cached_property, partial
from hashlib import blake2b
from typing import Final, NamedTuple, assert_never

from aftbed.adapt.planner import drains
from aftbed.adapt.script_check import problems
from aftbed.core import messages
from aftbed.core.errors import StepFailed
from aftbed.core.events import Event
from aftbed.core.graph import STAGED, End, Graph, Link
from aftbed.core.script import (
    RECIPES,
    Align,
    Attach,
    Bind,
    Destroy,
    Drain,
    Exchange,
    Fence,
    Freeze,
    Kill,
    Migrate,
    Promote,
    Resume,
    Retire,
    Script,
    ScriptKind,
    Spawn,
    Stage,
    Step,
    Suspend,
    Thaw,
    Together,
    Transfer,
    Unbind,
    flat,
    inverse,
    reversible,
)
from aftbed.ftm.compose import REPLICAS, STATEFUL, protected_by, replication_of
from aftbed.ftm.registry import KINDS
from aftbed.runtime import control
from aftbed.runtime.deployment import (
    BESIDE_LEADER,
    HANG_NS,
    ChannelKey,
    Deployment,
    Keys,
    Sent,
    key_of,
    replica_of,
)
from aftbed.runtime.interface import LIGHT, Channel, Process, ProcessKind, StateFile
from aftbed.runtime.tasks import Key, Wait, death_of, run_after_first_yield

Ends = dict[tuple[str, str], int]  # brick, port -> descriptor, or NOWHERE
PortOrder = tuple[tuple[control.Port, ...], tuple[control.Port, ...], tuple[int, ...]]  # in, out, descriptors
INPUT: Final = "in"
OUTPUT: Final = "out"


class PortChanges:
    """All that changes at the ports of one process."""

    def __init__(self, process: Process) -> None:
        self.process = process
        self.inputs: Ends = {}
        self.outputs: Ends = {}
        self.suspend = False

    def bind(self, brick: str, port: str, side: str, fd: int) -> None:
        """Have `port` lead to `fd`, or NOWHERE."""
        (self.inputs if side == INPUT else self.outputs)[brick, port] = fd

    @cached_property
    def order(self) -> PortOrder:
        """Once nothing more is to be bound."""
        fds: list[int] = []

        def ports(ends: Ends) -> tuple[control.Port, ...]:
            found = []
            for (brick, port), fd in ends.items():
                found.append(control.Port(brick, port, len(fds) if fd != control.NOWHERE else fd))
                if fd != control.NOWHERE:
                    fds.append(fd)
            return tuple(found)

        return ports(self.inputs), ports(self.outputs), tuple(fds)


Move = tuple[str, Process, Process, StateFile | None]  # a brick, which gives its state, which takes it
Changes = dict[int, PortChanges]  # by the identity of the process
Present = tuple[list[Process], list[Channel]]


class Rebinding:
    """From the links of `origin` to those of `target`. `origin` None: each link that is bound is a fresh one.

    `beside`: processes that take the place of a node, or take it again, by node. They are given all their
    ends; one that serves on is given those of links that `origin` does not have. `lost`: on the way back, the
    replicas that are left out, and all that is dead; None: a process that is missing fails the step.
    """

    def __init__(
        self,
        deployment: Deployment,
        origin: Graph | None,
        target: Graph,
        beside: Mapping[str, Process],
        lost: Container[str] | None = None,
    ) -> None:
        self._deployment, self._target, self._beside, self._lost = deployment, target, beside, lost
        self._origin = origin
        self._given: set[End] = set()
        self._prepared: tuple[Sequence[Step], Present, Changes] | None = None

    @cached_property
    def _bound(self) -> set[ChannelKey]:
        return {key_of(link) for link in self._origin.links} if self._origin is not None else set()

    @cached_property
    def _bricks(self) -> set[str]:
        return {b.name for b in self._origin.bricks} if self._origin is not None else set()

    def host(self, brick: str) -> Process:
        """The process that hosts `brick`: one that serves, else one that is to take its place."""
        nodes = self._deployment.nodes
        if self._origin is not None and brick in self._bricks:
            process = nodes.get(self._origin.node_of(brick))
            if process is not None:
                return process
        node = self._target.node_of(brick)
        process = self._beside.get(node) or nodes.get(node)
        if process is None:
            raise StepFailed(f"{node} is gone")
        return process

    def prepare(self, steps: Sequence[Step]) -> None:
        """Work out the orders of `steps`, which are to be committed later."""
        given = set(self._given)
        changes = self.changes(steps, committing=True)
        self._given = given
        for change in changes.values():
            _ = change.order
        self._prepared = steps, self._present(), changes

    def changes(self, steps: Sequence[Step], *, committing: bool) -> Changes:
        """What `steps` change at which processes. While not `committing`, only at those `beside`."""
        if self._prepared is not None and self._prepared[:2] == (steps, self._present()):
            return self._prepared[2]
        changes: Changes = {}
        for step in steps:
            match step:
                case Bind():
                    self._bind(changes, step.link, committing=committing)
                case Unbind(brick, port):
                    side = OUTPUT if port in KINDS[self._target.brick(brick).kind].outputs else INPUT
                    self._change(changes, brick, port, side, control.NOWHERE)
                case Exchange(node) if self._lost is None:
                    _of(changes, self._deployment.process(node)).suspend = True
                case Exchange():
                    pass  # what gives its place back is ended
                case _:
                    raise StepFailed(f"{type(step).__name__} among channels")
        return changes

    def _present(self) -> Present:
        """All that an order names; processes and channels are compared by identity."""
        deployment = self._deployment
        return [*deployment.nodes.values(), *self._beside.values()], list(deployment.channels)

    def _bind(self, changes: Changes, link: Link, *, committing: bool) -> None:
        target = self._target
        if target.node_of(link.source) == target.node_of(link.sink):
            return  # within one node, which knows of it
        channel = self._channel(link)
        known = key_of(link) in self._bound
        for brick, port, side, fd in (
            (link.sink, link.sink_port, INPUT, channel.read.fileno()),
            (link.source, link.source_port, OUTPUT, channel.write.fileno()),
        ):
            if target.node_of(brick) in self._beside:
                lacks = True
            elif self._lost is not None and brick not in self._bricks:
                lacks = False  # it has stood beside with its ends
            else:
                lacks = committing and not known and not (link.standby and "/" not in brick)
            if lacks and (brick, port, side) not in self._given:
                self._given.add((brick, port, side))
                self._change(changes, brick, port, side, fd)

    def _change(self, changes: Changes, brick: str, port: str, side: str, fd: int) -> None:
        node = self._target.node_of(brick)
        process = self._beside.get(node) or self._deployment.nodes.get(node)
        if self._lost is None and process is None:
            raise StepFailed(f"{node} is gone")
        serves = self._lost is None or (process and process.alive and replica_of(node) not in self._lost)
        if process is not None and serves:
            _of(changes, process).bind(brick, port, side, fd)

    def _channel(self, link: Link) -> Channel:
        channels = self._deployment.channels
        if self._origin is None:
            return channels.renew(link)
        return channels.get(*key_of(link)) or channels.make_beside(link)

    # -- sending ------------------------------------------------------------------------------

    def send(self, changes: Changes, seconds: float) -> Keys:
        """All at once. Raises StepFailed if a process is dead or dies; on the way back it is left out."""
        sent = []
        for change in changes.values():
            with suppress(*self._forgiven()):
                sent.append(self._order(change))
        for answers in [sent] if self._lost is None else [[pair] for pair in sent]:
            with suppress(*self._forgiven()):
                yield from self._deployment.answers(answers, seconds)

    def _forgiven(self) -> tuple[type[StepFailed], ...]:
        return () if self._lost is None else (StepFailed,)

    def _order(self, change: PortChanges) -> tuple[Key, str]:
        inputs, outputs, fds = change.order
        epoch, suspend = self._deployment.epoch, change.suspend
        return self._deployment.order(
            change.process, lambda token: control.Rewire(token, inputs, outputs, epoch, suspend), fds
        )


def _descriptors(file: StateFile | None) -> tuple[int, ...]:
    return () if file is None else (file.fileno(),)


def _migrated(step: Step) -> list[str]:
    """The nodes whose state `step` moves."""
    return [one.node for one in flat((step,)) if isinstance(one, Migrate)]


def _of(changes: Changes, process: Process) -> PortChanges:
    return changes.setdefault(id(process), PortChanges(process))


# How long a step may take. Birth has a limit of its own (`deployment`).
STAGE_SECONDS_MAX: Final = 5.0  # a module of the user is imported and tested meanwhile
SUSPEND_SECONDS_MAX: Final = 0.25  # for longer, the client is better off with the old graph
PROMOTE_SECONDS_MAX: Final = 2.0  # nothing else is left to serve
STEP_SECONDS_MAX: Final = 0.5  # all other steps
FIRST_REPLY_SECONDS: Final = 0.001

CATCH_UP_SECONDS: Final = 0.001  # between two looks whether a backup is behind
CATCH_UP_LOOKS: Final = 20

Observe = Callable[[Event, int], Keys]  # called before and after each step of an adaptation, with its number


class _Alignment(NamedTuple):
    """Two states that are asked for: of the leader, and of `sink` in `process`, which is to be the same."""

    asked: list[Sent]
    process: Process
    sink: str


class ScriptExecutor:
    """Carries out scripts, one at a time."""

    def __init__(self, deployment: Deployment) -> None:
        self._deployment = deployment
        self._running = False
        self.held = False  # an adaptation acts on what serves

    @property
    def busy(self) -> bool:
        """No other script may begin."""
        return self._running or self.held

    def execute(self, script: Script) -> Keys:
        """A whole script of Recovery. Raises StepFailed, after what was done has been taken back."""
        found = problems(script)
        if found:
            raise StepFailed("; ".join(found))
        self._running = True
        execution = Execution(self._deployment, script)
        try:
            for step in (*script.prepare, *script.commit):
                yield from execution.do(step)
        except StepFailed:
            yield from execution.take_back()
            raise
        finally:
            self._running = False

    def stale(self, script: Script) -> bool:
        """Whether `script` was ordered before Recovery knew of what has changed since.

        The situation that is on its way to it will make it decide anew.
        """
        deployment = self._deployment
        epochs = [step.epoch for step in script.commit if isinstance(step, Promote)]
        if any(epoch != deployment.epoch + 1 for epoch in epochs):
            return True
        match script.kind:
            case ScriptKind.FAILOVER:
                return script.replica != deployment.leader or not deployment.backup
            case ScriptKind.DROP_BACKUP:
                return script.replica != deployment.backup
            case ScriptKind.NEW_BACKUP | ScriptKind.ADAPTATION:
                return bool(deployment.backup) or not deployment.leader
            case _:
                assert_never(script.kind)

    def situation(self, *, failed: bool) -> messages.Situation:
        """What Recovery must know to order the next script."""
        deployment = self._deployment
        slots, leader, backup = deployment.slots, deployment.leader, deployment.backup
        return messages.Situation(
            leader,
            slots[leader].generation if leader else 0,
            backup,
            slots[backup].generation if backup else 0,
            deployment.epoch,
            tuple(s.name for s in slots.values() if not s.nodes),
            failed,
            replication_of(deployment.graph.ftm),
            STATEFUL,
            tuple(sorted(deployment.lost)),
        )


class Execution:
    """One script on its way: what of it was done, and what stands beside the nodes that serve.

    `new`: the graph that an adaptation leads to. `observe` is called at each of its steps.
    """

    def __init__(
        self,
        deployment: Deployment,
        script: Script,
        new: Graph | None = None,
        observe: Observe | None = None,
    ) -> None:
        self._deployment, self._runtime, self.script = deployment, deployment.runtime, script
        self._observe = observe
        adapts = script.kind is ScriptKind.ADAPTATION
        self.old: Graph = deployment.graph
        self.new: Graph = new or self.old
        self.done: list[Step] = []
        self._staged: dict[str, Process] = {}  # of the new graph, by node: they do not serve
        self._replaced: dict[str, Process] = {}  # of the old graph: they do not serve any more
        self._rebinding = Rebinding(deployment, self.old if adapts else None, self.new, self._staged)
        self._promoting: Wait | None = None  # Attach waits for it
        self._last_replies: Channel | None = None  # from a fenced leader to the Proxy
        self._aligning: _Alignment | None = None  # asked; the rebinding behind it waits for it
        self._number = 0  # of the step under way
        self._one_way = False  # what is replaced cannot go on from the state of what is new
        self.committed = False  # the new graph is the one that runs
        self.lost: set[str] = set()  # replicas that are left to Recovery
        self.closed_ns = self.opened_ns = 0  # when no request was served, and when again
        self.turned_ns = self.undone_ns = 0  # requests after it are the new graph's; the old one's again

    # -- the phases of an adaptation ----------------------------------------------------------

    def prepare(self) -> Keys:
        """Stage and bind what is new."""
        sent = []
        for step in flat(self.script.prepare):
            if isinstance(step, Stage):
                yield from self._enter()
                self.done.append(step)
                sent.append((yield from self._stage(step)))
                yield from self._note(Event.ADAPT_STEP_ACT, self._number)
        try:
            yield from self._deployment.answers(sent, STAGE_SECONDS_MAX)
        except StepFailed as failure:
            function = protected_by(self.new)
            if function != protected_by(self.old) and not all(p.alive for p in self._staged.values()):
                raise StepFailed(f"{failure} while it loaded and tried {function}") from failure
            raise
        for number in range(1, self._number + 1):
            yield from self._note(Event.ADAPT_STEP_EXIT, number)
        binds = [step for step in flat(self.script.prepare) if isinstance(step, Bind)]
        self.done += binds
        changes = self._rebinding.changes(binds, committing=False)
        yield from self._rebinding.send(changes, STEP_SECONDS_MAX)
        commit = self.script.commit
        rebinds = [at for at, step in enumerate(commit) if _rebinds(step)]
        # The paper's recipe stages in the commit; of several, the later ones depend on the first.
        if self.script.recipe == RECIPES[0] and len(rebinds) == 1:
            (at,) = rebinds
            self._rebinding.prepare(to_be_told(tuple(flat(commit[at : at + 1])), self.old, commit[:at]))
        yield from self._deployment.pool.wait_for_forks(LIGHT)
        yield from self._let_backup_catch_up()

    def _let_backup_catch_up(self) -> Keys:
        """Wait until the bricks that the commit drains are not behind; the client would wait for it there.

        A backup of a large state can be milliseconds behind. One that stays behind is waited for no longer.
        """
        drained = [step.brick for step in flat(self.script.commit) if isinstance(step, Drain)]
        channels, loop = self._deployment.channels, self._runtime.loop
        for number in range(CATCH_UP_LOOKS):
            if not any(one.mail_waits() for brick in drained for one in channels.into(brick)):
                return
            looked: Key = ("looked", "backup", number)
            loop.after(CATCH_UP_SECONDS, partial(loop.tasks.settle, looked))
            yield Wait(frozenset({looked}))

    def commit(self) -> Keys:
        """All that the client waits for."""
        deployment = self._deployment
        if self.script.recipe != RECIPES[0]:
            for slot in deployment.slots.values():  # it kills what they watch
                yield from deployment.watch(slot, none=True)
        self.closed_ns = self._runtime.loop.now_ns()
        try:
            for step in self.script.commit:
                if not _rebinds(step):
                    yield from self._finish_aligning()
                yield from self._enter()
                act = self._note(Event.ADAPT_STEP_ACT, self._number)
                yield from run_after_first_yield(self.do(step), act)
                yield from self._note(Event.ADAPT_STEP_EXIT, self._number)
            self._assert_whole()
        except StepFailed:
            if Resume(f"{deployment.leader}/protocol") in self.done:
                # Requests may have passed: the state that counts is in the new processes.
                self._adopt(self.new)
                yield from self._probe_way_back()
            if not self._one_way:
                raise
        self.opened_ns = self._runtime.loop.now_ns()
        if not self.committed:
            self._adopt(self.new)
        yield from self._watch()
        if not self._one_way:
            yield from self._probe_way_back()
        for slot in deployment.slots.values():
            if not self._one_way:
                deployment.assert_whole(slot)
            elif not all(map(deployment.lives, deployment.nodes_of(slot))):
                deployment.lost.add(slot.name)  # without a way back it is Recovery's, as at any other time

    def finish(self) -> Keys:
        """End what does not serve any more."""
        for process in self._replaced.values():
            end(process)
        self._replaced.clear()
        self._deployment.channels.close_beside()
        yield Wait(frozenset())

    def undo(self, lost: str = "") -> Keys:
        """Run the inverse of what was done. The replica that is `lost`, or has a dead node, is left out.

        Until requests are let on, the old processes count, since a new one may be dead. Afterwards both do:
        the old ones are to serve, with the state of the new ones.
        """
        deployment = self._deployment
        serving = list((deployment.nodes | self._replaced).items())
        serving += list(deployment.nodes.items()) if self.committed else []
        now_ns = self._runtime.loop.now_ns()
        self.lost = {replica_of(name) for name, p in serving if not p.alive or p.hangs(now_ns, HANG_NS)}
        self.lost = (self.lost | {lost}) - {""}
        if self.committed:  # else the Watchdogs have seen it
            deployment.lost |= self.lost
            yield from self._shut_lost()
        exchanged = {node: process for node, process in self._replaced.items() if node in self.new.nodes}
        self._rebinding = Rebinding(deployment, self.new, self.old, exchanged, self.lost)
        for step in inverse(self.old, self.done, KINDS, drains(self.new, self.old)):
            yield from self._do_back(step)
        yield from self._end_staged(list(self._staged))
        deployment.channels.close_beside()
        self.undone_ns = self.undone_ns or self._runtime.loop.now_ns()
        yield Wait(frozenset())

    def can_go_back(self, without: str) -> bool:
        """Whether the old graph has another replica, what is replaced of it lives, and can take the state."""
        others = any(b.part == "server" and b.replica != without for b in self.old.bricks)
        replaced = self._replaced.items()
        return others and not self._one_way and all(p.alive for n, p in replaced if replica_of(n) != without)

    def _enter(self) -> Keys:
        self._number += 1
        yield from self._note(Event.ADAPT_STEP_ENTER, self._number)

    def _note(self, event: Event, number: int) -> Keys:
        assert self._observe is not None
        return self._observe(event, number)

    def _assert_whole(self) -> None:
        """Raise StepFailed if a node of a replica is dead: not every step asks every node."""
        for node in self.new.nodes:
            process = self._staged.get(node) or self._deployment.nodes.get(node)
            if replica_of(node) and (process is None or not process.alive):
                raise StepFailed(f"{node} died")

    def _watch(self) -> Keys:
        for slot in self._deployment.slots.values():
            if slot.name not in self.lost:
                with suppress(StepFailed):  # a Watchdog that is dead is replaced, and gets it then
                    yield from self._deployment.watch(slot)

    def _probe_way_back(self) -> Keys:
        """Find out whether a class that was replaced takes the state of its successor: it need not.

        Done when requests have been let on, so that the client does not wait for it.
        """
        migrated = [node for step in self.done for node in _migrated(step)]
        for node, brick in [(n, b) for n in migrated for b in self.old.nodes[n] if b in self.new.nodes[n]]:
            before, after = self.old.brick(brick), self.new.brick(brick)
            if (before.source, before.application) == (after.source, after.application):
                continue
            giver, taker = self._deployment.process(node), self._replaced[node]
            try:
                state = yield from self._capture(giver, brick)
                if state:
                    yield from self._restore(taker, brick, state, migrate=True)
            except StepFailed:
                if giver.alive and taker.alive and not self._one_way:  # else it was a death
                    self._one_way = True
                    why = f"the version of {brick} before does not take the state of this one"
                    self._runtime.log("adapt", f"it cannot be undone any more: {why}")

    # -- steps --------------------------------------------------------------------------------

    def do(self, step: Step) -> Keys:  # noqa: PLR0912 - a case for each type of step
        """One step. Raises StepFailed."""
        resumes = [one for one in flat((step,)) if isinstance(one, Resume)]
        if not resumes:  # each of them is done when it is sent
            self.done.append(step)
        match step:
            case Spawn(replica):
                yield from self._deployment.spawn(self._deployment.slots[replica])
            case Fence(replica):
                self._fence(replica)
            case Kill(replica):
                self._kill(replica)
            case Promote(replica, epoch):
                self._promote(replica, epoch)
            case Attach(replica, epoch):
                yield from self._attach(replica, epoch)
            case Suspend(brick):
                yield from self._suspend(brick, drain=False)
            case Drain(brick):
                yield from self._suspend(brick, drain=True)
            case Resume():
                yield from self._resume(resumes)
            case Transfer(source, sink):
                yield from self._transfer(source, sink)
            case Align(source, sink):
                self._align(source, sink)
            case Migrate() | Together((Migrate(), *_)):
                yield from self._migrate(self.old, self.new, _migrated(step), self._staged)
            case Bind() | Unbind() | Exchange():
                yield from self._rebind((step,))
            case Together(steps) if len(resumes) == len(steps):
                self._assert_whole()
                yield from self._resume(resumes)
            case Together():
                yield from self._rebind(tuple(flat((step,))))
            case Stage():
                yield from self._deployment.answers([(yield from self._stage(step))], STAGE_SECONDS_MAX)
            case Retire(node):
                end(self._replaced.pop(node))
            case Freeze(brick):
                self._rebinding.host(brick).freeze()
            case Thaw(brick):
                self.turned_ns = self._runtime.loop.now_ns()
                self._rebinding.host(brick).thaw()
            case Destroy(node):
                process = self._deployment.process(node)
                del self._deployment.nodes[node]
                end(process)
            case _:
                assert_never(step)

    def _stage(self, step: Stage) -> Generator[Wait, dict[Key, bytes], tuple[Key, str]]:
        process, sent = yield from self._deployment.stage(step.node, self.new, held=step.held)
        self._staged[step.node] = process
        return sent

    def _suspend(self, brick: str, *, drain: bool) -> Keys:
        order = partial(control.SuspendNode, drain=drain)
        yield from self._deployment.ask(self._rebinding.host(brick), order, seconds=SUSPEND_SECONDS_MAX)

    def _resume(self, steps: Iterable[Resume]) -> Keys:
        sent = []
        for step in steps:
            before_ns = self._runtime.loop.now_ns()
            host = self._rebinding.host(step.brick)
            sent.append(self._deployment.order(host, control.ResumeNode, suspended=True))
            self.done.append(step)
            if step.brick == f"{self._deployment.leader}/protocol":
                self.turned_ns = before_ns
        yield from self._deployment.answers(sent, STEP_SECONDS_MAX)

    # -- steps that move state ----------------------------------------------------------------

    def _capture(self, process: Process, brick: str) -> Generator[Wait, dict[Key, bytes], bytes]:
        order = partial(control.Capture, brick=brick)
        return (yield from self._deployment.ask(process, order, seconds=STEP_SECONDS_MAX))

    def _restore(self, process: Process, brick: str, state: bytes, *, migrate: bool = False) -> Keys:
        order = partial(control.Restore, brick=brick, state=state, migrate=migrate)
        yield from self._deployment.ask(process, order, seconds=STEP_SECONDS_MAX)

    def _transfer(self, source: str, sink: str) -> Keys:
        state = yield from self._capture(self._rebinding.host(source), source)
        yield from self._restore(self._rebinding.host(sink), sink, state)

    def _align(self, source: str, sink: str) -> None:
        """Ask both, and go on: a step that rebinds is carried out meanwhile, any other one waits for it."""
        host = self._rebinding.host
        asked = [
            self._deployment.order(host(brick), partial(control.Capture, brick=brick))
            for brick in (source, sink)
        ]
        self._aligning = _Alignment(asked, host(sink), sink)

    def _finish_aligning(self) -> Keys:
        if self._aligning is not None:
            (asked, process, sink), self._aligning = self._aligning, None
            got = yield from self._deployment.answers(asked, STEP_SECONDS_MAX)
            wanted, found = (got[key] for key, _ in asked)
            if blake2b(wanted).digest() != blake2b(found).digest():
                yield from self._restore(process, sink, wanted)

    def _migrate(self, given: Graph, taken: Graph, nodes: Iterable[str], takers: dict[str, Process]) -> Keys:
        """The state of every brick that a node has in both graphs. One that has no state needs no taker.

        All are asked at once, and each state goes on as soon as it is there.
        """
        moves = [
            (brick, self._deployment.process(node), takers[node], self._runtime.state_file())
            for node in nodes
            for brick in given.nodes[node]
            if brick in taken.nodes[node]
        ]
        try:
            yield from self._moved(given, taken, moves)
        finally:
            for *_, file in moves:
                if file is not None:
                    file.close()

    def _moved(self, given: Graph, taken: Graph, moves: Sequence[Move]) -> Keys:
        order = self._deployment.order
        asked = [
            order(giver, partial(control.Capture, brick=brick), _descriptors(file))
            for brick, giver, _, file in moves
        ]
        involved = frozenset(name for _, name in asked)
        restored: list[tuple[str, Sent]] = []
        for (brick, _, taker, file), (key, _) in zip(moves, asked, strict=True):
            state = (yield Wait(frozenset({key}), involved, STEP_SECONDS_MAX))[key]
            in_file = file is not None and file.used()
            if state or in_file:
                migrate = given.brick(brick) != taken.brick(brick)
                restore = partial(control.Restore, brick=brick, state=state, migrate=migrate)
                sent = order(taker, restore, _descriptors(file) if in_file else ())
                restored.append((brick, sent))
                involved |= {sent[1]}
        involved = frozenset(name for _, (_, name) in restored)
        for brick, (key, _) in restored:
            before, after = given.brick(brick), taken.brick(brick)
            try:
                yield Wait(frozenset({key}), involved, STEP_SECONDS_MAX)
            except StepFailed as failure:
                if before.application == after.application:
                    raise
                names = (one.application or "the built-in function" for one in (after, before))
                raise StepFailed("{} takes no state of {}: {}".format(*names, failure)) from failure

    # -- steps of a failover ------------------------------------------------------------------

    def _fence(self, replica: str) -> None:
        deployment = self._deployment
        slot = deployment.slots[replica]
        leads = replica == deployment.leader
        self._last_replies = None
        if leads:
            # Move Proxy and Client while they sleep: the fence wakes them, and a core that takes dead
            # processes down neither runs them nor lets them go for some milliseconds.
            deployment.leader = ""
            deployment.pin(BESIDE_LEADER)
        for channel in deployment.channels.touching(slot.bricks):
            link = channel.link
            if leads and link.source in slot.bricks and link.sink == "proxy":
                self._last_replies = channel
            elif link.source in slot.bricks and link.sink not in slot.bricks:
                channel.fence()
            elif "/" in link.source and link.source not in slot.bricks:
                channel.refuse()  # a leader that waits for a dead backup to read must not wait on
        # A reply is on its way to the Proxy only if its checkpoint was on its way to the backup before,
        # so the shut checkpoint channel is what counts. The other one is shut as soon as the Proxy
        # follows the new leader: to wake it twice costs 0.1 ms of the blackout.
        detail = slot.generation << 8 | slot.number
        self._runtime.journal.write(self._runtime.loop.now_ns(), Event.REPLICA_FENCED, 0, detail)

    def _kill(self, replica: str) -> None:
        """The nodes of the slot die; their deaths are reaped later, the slot is free at once."""
        deployment = self._deployment
        slot = deployment.slots[replica]
        for node in slot.nodes:
            process = deployment.nodes.pop(node, None)
            if process is not None:
                end(process)
        for channel in deployment.channels.touching(slot.bricks):
            deployment.channels.drop(channel)
        slot.nodes = []
        deployment.lost.discard(replica)
        if deployment.backup == replica:
            deployment.backup = ""

    def _promote(self, replica: str, epoch: int) -> None:
        """Send it, and go on: until it leads, its Protocol takes no request. Attach waits for it."""
        deployment = self._deployment
        slot = deployment.slots[replica]
        part, _ = replication_of(deployment.graph.ftm)[0]  # the first that receives from the leader
        brick = f"{replica}/{part}"
        # The end of the channel from the leader, which the fence made, wakes it.
        promote = control.Deliver(control.UNANSWERED, brick, messages.Promotion(epoch))
        deployment.leave(deployment.graph.node_of(brick), promote)
        promoted = ("promoted", f"{replica}/protocol", epoch)
        self._promoting = Wait(frozenset({promoted}), frozenset(slot.nodes), PROMOTE_SECONDS_MAX)

    def _attach(self, replica: str, epoch: int) -> Keys:
        """A Proxy that is being replaced needs nothing: the new one is bound to the leader."""
        deployment = self._deployment
        deployment.leader, deployment.backup, deployment.epoch = replica, "", epoch
        into = deployment.channels.get("proxy", "pxy2pro", f"{replica}/protocol")
        back = deployment.channels.get(f"{replica}/protocol", "pro2pxy", "proxy")
        assert into is not None and back is not None, replica
        with suppress(StepFailed):
            deployment.leave(
                "proxy",
                control.Follow(control.UNANSWERED, "proxy", "pro2pxy", "pxy2pro", epoch),
                (back.read.fileno(), into.write.fileno()),
            )
        if self._last_replies is not None:
            self._last_replies.fence()  # wakes a Proxy that waits for a reply
        for channel in deployment.channels.into("proxy"):
            if channel.link.source == "client":
                channel.nudge()  # wakes one that waits for a request
        # The new leader's core is for the first reply now: nothing is urgent here, and to wake up for
        # each report from there would take it 0.1 ms.
        self._runtime.loop.rest(FIRST_REPLY_SECONDS)
        promoting, self._promoting = self._promoting, None
        if promoting is not None:
            deployment.assert_whole(deployment.slots[replica])
            yield promoting
        deployment.graph = deployment.graph.led_by(replica)
        deployment.pin_watchers()

    # -- channels and places ------------------------------------------------------------------

    def _rebind(self, steps: tuple[Step, ...]) -> Keys:
        """Each process gets all its changes at once; then the staged one takes its place."""
        if self.script.kind is not ScriptKind.ADAPTATION:
            self._note_backup(steps)
        told = to_be_told(steps, self.old, self.done)
        yield from self._rebinding.send(self._rebinding.changes(told, committing=True), STEP_SECONDS_MAX)
        yield from self._finish_aligning()
        for step in steps:
            if isinstance(step, Exchange):
                self._put_beside(step.node, self._replaced)
                self._put_in_place(step.node, self._staged.pop(step.node))

    def _note_backup(self, steps: tuple[Step, ...]) -> None:
        """Once a new backup is bound, it holds all that the leader holds; unbound, no more."""
        deployment = self._deployment
        for step in steps:
            match step:
                case Bind(brick, _, target) if replica_of(brick) == deployment.leader != replica_of(target):
                    deployment.backup = replica_of(target)
                case Unbind(brick, port):
                    if (brick.partition("/")[2], port) in replication_of(deployment.graph.ftm):
                        deployment.backup = ""
                case _:
                    pass

    def _put_beside(self, node: str, others: dict[str, Process]) -> None:
        """The process that is `node` stands beside what serves from now on."""
        process = others[node] = self._deployment.nodes.pop(node)
        process.name, process.kind = f"{node}{STAGED}", ProcessKind.STAGED

    def _put_in_place(self, node: str, process: Process) -> None:
        """`process` is `node` from now on."""
        process.name, process.kind = node, ProcessKind.NODE
        self._deployment.nodes[node] = process

    def _adopt(self, graph: Graph) -> None:
        """The old or the new graph runs from now on; what only the other one has stands beside it."""
        deployment = self._deployment
        self.committed = graph is self.new
        coming, leaving = self._staged, self._replaced
        if not self.committed:
            coming, leaving = leaving, coming
        for node, process in list(coming.items()):
            if node in deployment.nodes:
                self._put_beside(node, leaving)
            self._put_in_place(node, process)
        coming.clear()
        for node in [n for n in deployment.nodes if n not in graph.nodes]:
            self._put_beside(node, leaving)
        deployment.channels.adopt(graph.links)
        deployment.adopt(graph, self.lost)
        other = next(r for r in REPLICAS if r != deployment.leader)
        deployment.backup = other if replication_of(graph.ftm) and other in deployment.slots else ""

    # -- the way back -------------------------------------------------------------------------

    def take_back(self) -> Keys:
        """After a script of Recovery has failed. A failover cannot be: there is no replica left."""
        deployment, done = self._deployment, self.done
        if self.script.kind is ScriptKind.FAILOVER:
            for slot in deployment.slots.values():
                self._kill(slot.name)
            deployment.leader = deployment.backup = ""
        elif reversible(done):
            if deployment.backup == self.script.replica:  # it can lead already
                done = [step for step in done if isinstance(step, Suspend)]
            for step in inverse(self.old, done, KINDS):
                yield from self._do_back(step)

    def _do_back(self, step: Step) -> Keys:
        """A step of an inverse. What is dead is left out."""
        match step:
            case Suspend(brick):
                yield from self._unless_lost(brick, self._suspend(brick, drain=False))
            case Drain(brick):
                yield from self._unless_lost(brick, self._suspend(brick, drain=True))
            case Together((Migrate(), *_)):
                for node in _migrated(step):
                    yield from self._unless_lost(
                        node, self._migrate(self.new, self.old, [node], self._replaced)
                    )
            case Kill(replica):
                self._kill(replica)
            case Together(steps) if isinstance(steps[0], Retire):
                yield from self._end_staged([one.node for one in steps if isinstance(one, Retire)])
            case Together(steps) if isinstance(steps[0], Resume):
                self._resume_living([one.brick for one in steps if isinstance(one, Resume)])
            case Together(steps):
                yield from self._rebind_back(steps)
            case _:
                raise AssertionError(f"{step} in an inverse")

    def _unless_lost(self, name: str, task: Keys) -> Keys:
        """A replica that cannot be stopped, or gives its state back to no process, must not serve."""
        if replica_of(name) in self.lost:
            return
        try:
            yield from task
        except StepFailed:
            self.lost.add(replica_of(name))
            self._deployment.lost.add(replica_of(name))

    def _rebind_back(self, steps: tuple[Step, ...]) -> Keys:
        committed = self.committed
        if committed:
            self._adopt(self.old)
        else:
            for node, process in list(self._replaced.items()):
                self._put_beside(node, self._staged)
                self._put_in_place(node, process)
            self._replaced.clear()
        yield from self._rebinding.send(self._rebinding.changes(steps, committing=True), STEP_SECONDS_MAX)
        if committed:
            yield from self._watch()  # before those die that are watched now

    def _shut_lost(self) -> Keys:
        """Before the way back from a graph that serves: what is lost may live and serve, and must not."""
        deployment = self._deployment
        if deployment.leader in self.lost and not replication_of(self.new.ftm):
            self.lost |= set(REPLICAS)  # no other replica has its state
            deployment.lost |= self.lost
        for replica in sorted(self.lost & deployment.slots.keys()):
            deployment.shut_replication(deployment.slots[replica])
        if deployment.leader not in self.lost and self.lost:
            # A leader that waits for a lost backup to read must not wait on.
            unbinds = [Unbind(f"{deployment.leader}/{p}", port) for p, port in replication_of(self.new.ftm)]
            rebinding = Rebinding(deployment, None, self.new, {}, self.lost)
            yield from rebinding.send(rebinding.changes(unbinds, committing=True), STEP_SECONDS_MAX)

    def _end_staged(self, nodes: Iterable[str]) -> Keys:
        """End them, and wait: one that lived a moment longer would take mail that is for others.

        One that does not die within the time is let be.
        """
        processes = [self._staged.pop(node) for node in nodes if node in self._staged]
        living = [process for process in processes if process.alive]
        for process in living:
            end(process)
        with suppress(StepFailed):
            yield Wait(frozenset(death_of(p.pid) for p in living), seconds=STEP_SECONDS_MAX)

    def _resume_living(self, bricks: Iterable[str]) -> None:
        """What was suspended goes on, but for a lost replica."""
        self.undone_ns = self._runtime.loop.now_ns()
        for brick in bricks:
            if replica_of(brick) not in self.lost:
                with suppress(StepFailed):
                    self._deployment.order(self._rebinding.host(brick), control.ResumeNode)


def end(process: Process) -> None:
    """It dies, and its death is no news."""
    process.kind = ProcessKind.KILLED
    process.kill()


def _rebinds(step: Step) -> bool:
    """Whether `step` is about channels and places."""
    return all(isinstance(one, Bind | Unbind | Exchange) for one in flat((step,)))


def to_be_told(steps: tuple[Step, ...], graph: Graph, done: Iterable[Step]) -> tuple[Step, ...]:
    """Of `steps` that rebind `graph`, those that a process has to be told: not of an Exchange, which suspends
    the old node, where a step of `done` has suspended it and none has resumed any since.
    """
    suspended: set[str] = set()  # nodes
    for step in flat(done):
        match step:
            case Suspend(brick) | Drain(brick):
                suspended |= {node for node, hosted in graph.nodes.items() if brick in hosted}
            case Resume():
                suspended.clear()
            case _:
                pass
    return tuple(step for step in steps if not (isinstance(step, Exchange) and step.node in suspended))

"""What each process must hear for a graph to be wired: the ends of channels, one order for each process.

`Wires` knows which ends the bricks of a graph to be have been given. What is said while the client waits is
worked out before (`Wires.foresee`), and holds as long as nobody and nothing has been replaced meanwhile.
"""

import contextlib
import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Final

from aftbed.core import script
from aftbed.core.errors import StepFailed
from aftbed.core.graph import Graph, Link, ends
from aftbed.ftm.compose import REPLICAS, replication_of
from aftbed.ftm.registry import KINDS
from aftbed.runtime import control
from aftbed.runtime.channels import Channels
from aftbed.runtime.deployment import Deployment, Keys
from aftbed.runtime.interface import Channel, Process
from aftbed.runtime.transfer import answered, ask

Ends = dict[tuple[str, str], int]  # brick, port -> descriptor, or NOWHERE
Ports = tuple[control.Port, ...]
Written = tuple[Ports, Ports, tuple[int, ...]]  # inputs, outputs, the descriptors that go with them
INPUT: Final = "in"
HANG_NS: Final = 150_000_000


class Changes:
    """What one process is told at once."""

    def __init__(self, process: Process) -> None:
        self.process = process
        self.inputs: Ends = {}
        self.outputs: Ends = {}
        self.suspend = False
        self._written: Written | None = None

    def bind(self, brick: str, port: str, side: str, fd: int) -> None:
        """Have `port` lead to `fd`, or NOWHERE."""
        (self.inputs if side == INPUT else self.outputs)[brick, port] = fd

    def order(self, epoch: int) -> tuple[Callable[[int], control.ToNode], tuple[int, ...]]:
        """The order, but for its token, and the descriptors that go with it."""
        inputs, outputs, fds = self._written or self.write()
        return lambda token: control.Rewire(token, inputs, outputs, epoch, self.suspend), fds

    def write(self) -> Written:
        """Once nothing more is to be bound."""
        fds: list[int] = []

        def ports(ends: Ends) -> Ports:
            found = []
            for (brick, port), fd in ends.items():
                found.append(control.Port(brick, port, len(fds) if fd != control.NOWHERE else fd))
                if fd != control.NOWHERE:
                    fds.append(fd)
            return tuple(found)

        self._written = ports(self.inputs), ports(self.outputs), tuple(fds)
        return self._written


Told = dict[int, Changes]  # by the identity of the process
Present = tuple[list[Process], list[Channel]]


class Wires:
    """The ends of channels on the way from one graph to another. `staged`: processes, by their node."""

    def __init__(self, deployment: Deployment, new: Graph, staged: dict[str, Process]) -> None:
        self._deployment, self._staged = deployment, staged
        self.old: Graph = deployment.graph
        self.new = new
        self._fresh = deployment.channels.fresh
        self._given: set[script.End] = set()  # ends that their bricks have
        self._foreseen: tuple[Sequence[script.Step], Present, Told] | None = None

    def process(self, brick: str) -> Process:
        """Who hosts `brick`: what is staged under the name of a node that is new, else what serves."""
        if brick in {b.name for b in self.old.bricks}:
            node = self.old.node_of(brick)
            if node in self._deployment.nodes:
                return self._deployment.nodes[node]
        node = self.new.node_of(brick)
        process = self._staged.get(node) or self._deployment.nodes.get(node)
        if process is None:
            raise StepFailed(f"{node} is gone")
        return process

    def serving(self, node: str) -> Process:
        """The process that is `node` now."""
        process = self._deployment.nodes.get(node)
        if process is None:
            raise StepFailed(f"{node} is gone")
        return process

    def foresee(self, verbs: Sequence[script.Step]) -> None:
        """Work out now what is to be told later, if nothing is bound and nobody replaced before."""
        given = set(self._given)
        told = self.told(verbs, committing=True)
        self._given = given
        for change in told.values():
            change.write()
        self._foreseen = verbs, self._present(), told

    def told(self, verbs: Sequence[script.Step], *, committing: bool) -> Told:
        """What everybody must hear. While not yet `committing`, only what is staged hears anything."""
        if self._foreseen is not None and self._foreseen[:2] == (verbs, self._present()):
            return self._foreseen[2]
        changes: Told = {}

        def of(process: Process) -> Changes:
            return changes.setdefault(id(process), Changes(process))

        for verb in verbs:
            match verb:
                case script.Bind():
                    self._bind(verb.link, of, committing=committing)
                case script.Unbind(brick, port):
                    self._unbind(brick, port, of)
                case script.Exchange(node):
                    of(self.serving(node)).suspend = True
                case _:
                    raise StepFailed(f"{type(verb).__name__} among channels")
        return changes

    def _present(self) -> Present:
        """All that an order names; processes and channels are compared by identity."""
        deployment = self._deployment
        channels = [channel for _, channel in deployment.channels.items()]
        return [*deployment.nodes.values(), *self._staged.values()], channels

    def _bind(self, link: Link, of: Callable[[Process], Changes], *, committing: bool) -> None:
        if self.new.node_of(link.source) == self.new.node_of(link.sink):
            return  # within one node: it knows
        channel = self._channel(link)
        shared = (link.source, link.source_port, link.sink) not in self._fresh
        for brick, port, fd, side in (
            (link.sink, link.sink_port, channel.read.fileno(), INPUT),
            (link.source, link.source_port, channel.write.fileno(), "out"),
        ):
            staged = self._staged.get(self.new.node_of(brick))
            given = (brick, port, side) in self._given or (staged is None and shared)
            if not given and (committing or staged is not None):
                self._given.add((brick, port, side))
                of(staged or self.process(brick)).bind(brick, port, side, fd)

    def _unbind(self, brick: str, port: str, of: Callable[[Process], Changes]) -> None:
        change = of(self.process(brick))
        outputs = KINDS[self.old.brick(brick).kind].outputs
        (change.outputs if port in outputs else change.inputs)[brick, port] = control.NOWHERE

    def _channel(self, link: Link) -> Channel:
        """The channel of `link`: the one that serves already, or a fresh one."""
        key = (link.source, link.source_port, link.sink)
        standing = self._deployment.channels.get(*key)
        if standing is not None:
            return standing
        if key not in self._fresh:
            self._fresh[key] = self._deployment.channels.make(link)
        return self._fresh[key]


def tell(deployment: Deployment, changes: dict[int, Changes]) -> Keys:
    """Everybody, at once. Raises StepFailed if one of them is dead, or dies."""
    sent = []
    for change in changes.values():
        order, fds = change.order(deployment.epoch)
        sent.append(deployment.order_to(change.process, order, fds))
    yield from answered(sent)


def tell_whoever_lives(deployment: Deployment, changes: dict[int, Changes]) -> Keys:
    """The same, where some may be dead or die meanwhile: they are left to Recovery."""
    sent = []
    for change in changes.values():
        order, fds = change.order(deployment.epoch)
        with contextlib.suppress(StepFailed):
            sent.append(deployment.order_to(change.process, order, fds))
    for pair in sent:
        with contextlib.suppress(StepFailed):
            yield from answered([pair])


def stop_replication(deployment: Deployment, ftm: str, host: Callable[[str], Process]) -> Keys:
    """A leader that waits for a lost backup to read waits no more."""
    for part, port in replication_of(ftm):
        brick = f"{deployment.leader}/{part}"
        unbind = functools.partial(control.BindOutput, brick=brick, port=port, epoch=deployment.epoch)
        with contextlib.suppress(StepFailed):
            yield from ask(deployment, host(brick), unbind)


def way_back(
    old: Graph, new: Graph, back: set[str], serving: Callable[[str], Process | None], channels: Channels
) -> dict[int, Changes]:
    """From `new` to `old`: by those that stay, what has changed; by those that come `back`, everything,
    since a neighbour may have been replaced meanwhile. `serving`: the process of a node, if it may serve.
    """
    changes: dict[int, Changes] = {}
    stay = {b.name for b in old.bricks} & {b.name for b in new.bricks} - back
    old_keys, new_keys = ({_key(k) for k in g.links} for g in (old, new))

    def tell(brick: str, port: str, side: str, fd: int) -> None:
        process = serving(old.node_of(brick))
        if process is not None:
            changes.setdefault(id(process), Changes(process)).bind(brick, port, side, fd)

    for link in new.links:
        inside = new.node_of(link.source) == new.node_of(link.sink)  # nobody else was told of it
        if _key(link) not in old_keys and not link.standby and not inside:
            for brick, port, side in ends(link):
                if brick in stay:
                    tell(brick, port, side, control.NOWHERE)
    for link in old.links:
        channel = channels.get(*_key(link))
        if channel is None or old.node_of(link.source) == old.node_of(link.sink):
            continue
        changed = _key(link) not in new_keys and not link.standby
        for brick, port, side in ends(link):
            if brick in back or (brick in stay and changed):
                tell(brick, port, side, (channel.read if side == INPUT else channel.write).fileno())
    return changes


def _key(link: Link) -> tuple[str, str, str]:
    return link.source, link.source_port, link.sink


def gone(nodes: Iterable[tuple[str, Process]], now_ns: int) -> set[str]:
    """The replicas that have a node that is dead, or hangs while the Watchdogs look elsewhere."""
    return {replica_of(name) for name, p in nodes if not p.alive or p.hangs(now_ns, HANG_NS)}


def replica_of(name: str) -> str:
    """The replica that is lost with a node or brick, `""` for one of none, such as a Watchdog."""
    head, _, part = name.partition("/")
    return head if head in REPLICAS and part != "watchdog" else ""

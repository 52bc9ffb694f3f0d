"""What each process must hear for a graph to be wired: the ends of channels, one order for each process."""

import contextlib
import functools
from collections.abc import Callable, Iterable
from typing import Final

from aftbed.core.graph import Graph, Link, ends
from aftbed.ftm.mechanism import REPLICAS, replication_of
from aftbed.runtime import control
from aftbed.runtime.channels import Channels
from aftbed.runtime.deployment import Deployment, Keys
from aftbed.runtime.interface import Process
from aftbed.runtime.jobs import StepFailed
from aftbed.runtime.transfer import answered, ask

Ends = dict[tuple[str, str], int]  # brick, port -> descriptor, or NOWHERE
INPUT: Final = "in"
HANG_NS: Final = 150_000_000


class Changes:
    """What one process is told at once."""

    def __init__(self, process: Process) -> None:
        self.process = process
        self.inputs: Ends = {}
        self.outputs: Ends = {}
        self.suspend = False

    def bind(self, brick: str, port: str, side: str, fd: int) -> None:
        """Have `port` lead to `fd`, or NOWHERE."""
        (self.inputs if side == INPUT else self.outputs)[brick, port] = fd

    def order(self, epoch: int) -> tuple[Callable[[int], control.ToNode], tuple[int, ...]]:
        """The order, but for its token, and the descriptors that go with it."""
        fds: list[int] = []

        def ports(ends: Ends) -> tuple[control.Port, ...]:
            found = []
            for (brick, port), fd in ends.items():
                found.append(control.Port(brick, port, len(fds) if fd != control.NOWHERE else fd))
                if fd != control.NOWHERE:
                    fds.append(fd)
            return tuple(found)

        inputs, outputs = ports(self.inputs), ports(self.outputs)
        return lambda token: control.Rewire(token, inputs, outputs, epoch, self.suspend), tuple(fds)


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

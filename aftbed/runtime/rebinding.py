"""Rebinding: which processes must be given which ends of channels on the way from one graph to another.

A channel that both graphs have is kept, with the mail that is in it; a brick that comes to it gets a
descriptor of the same socket. Each process gets all its changes in one order (`control.Rewire`). The
orders of a commit are worked out before the client waits for them (`Rebinding.prepare`), and are used if no
process and no channel has been replaced meanwhile.
"""

import contextlib
from collections.abc import Container, Mapping, Sequence
from functools import cached_property
from typing import Final

from aftbed.core.errors import StepFailed
from aftbed.core.graph import End, Graph, Link
from aftbed.core.script import Bind, Exchange, Step, Unbind
from aftbed.ftm.registry import KINDS
from aftbed.runtime import control
from aftbed.runtime.deployment import ChannelKey, Deployment, Keys, key_of, replica_of
from aftbed.runtime.interface import Channel, Process
from aftbed.runtime.tasks import Key

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
            with contextlib.suppress(*self._forgiven()):
                sent.append(self._order(change))
        for answers in [sent] if self._lost is None else [[pair] for pair in sent]:
            with contextlib.suppress(*self._forgiven()):
                yield from self._deployment.answers(answers, seconds)

    def _forgiven(self) -> tuple[type[StepFailed], ...]:
        return () if self._lost is None else (StepFailed,)

    def _order(self, change: PortChanges) -> tuple[Key, str]:
        inputs, outputs, fds = change.order
        epoch, suspend = self._deployment.epoch, change.suspend
        return self._deployment.order(
            change.process, lambda token: control.Rewire(token, inputs, outputs, epoch, suspend), fds
        )


def _of(changes: Changes, process: Process) -> PortChanges:
    return changes.setdefault(id(process), PortChanges(process))

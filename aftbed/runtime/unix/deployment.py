"""The deployed graph: which process hosts which bricks, which channels there are, and who leads.

It knows how to give a new process its ends of the channels, which is all that "binding" means here,
and how to replace a process that belongs to no replica.
"""

import os
from collections.abc import Callable, Generator, Iterable
from pathlib import Path
from typing import Final

from aftbed.core.graph import Graph
from aftbed.ftm.mechanism import REPLICAS
from aftbed.runtime.unix import control
from aftbed.runtime.unix.channels import Channel, Channels
from aftbed.runtime.unix.jobs import Key, StepFailed, Wait
from aftbed.runtime.unix.journal import Header
from aftbed.runtime.unix.processes import Nursery, Process
from aftbed.runtime.unix.spawn import BUS, LIGHT

BESIDE_LEADER: Final = ("client", "proxy")
WATCHED_KINDS: Final = ("client", "proxy", "watchdog", "recovery", "engine")

Keys = Generator[Wait, dict[Key, bytes], None]
DeviceOf = Callable[[str, int], tuple[str, bytes]]  # brick kind, incarnation -> device, its options


class Slot:
    """One place for a replica; `generation` counts the replicas that were in it."""

    def __init__(self, name: str, bricks: frozenset[str], cpu: int | None) -> None:
        self.name, self.bricks, self.cpu = name, bricks, cpu
        self.number = REPLICAS.index(name) + 1
        self.generation = 0
        self.nodes: list[str] = []


class Deployment:
    """`leader` and `backup` are names of slots, or `""`."""

    def __init__(
        self, graph: Graph, nursery: Nursery, record: Path, device_of: DeviceOf, cpus: list[int] | None
    ) -> None:
        self.graph, self.nursery, self.record = graph, nursery, record
        self._device_of = device_of
        self.channels = Channels()
        self.nodes: dict[str, Process] = {}
        self.incarnations: dict[str, int] = {}
        self.epoch, self.leader, self.backup = 1, REPLICAS[0], ""
        self._tokens = 0
        self.slots: dict[str, Slot] = {}
        for index, name in enumerate(REPLICAS):
            bricks = frozenset(
                b.name for b in graph.bricks if b.replica == name and b.kind not in WATCHED_KINDS
            )
            if bricks:
                self.slots[name] = Slot(name, bricks, cpus[index % len(cpus)] if cpus else None)

    # -- orders -------------------------------------------------------------------------------

    def order(
        self, node: str, make: Callable[[int], control.ToNode], fds: tuple[int, ...] = ()
    ) -> tuple[Key, str]:
        """Send an order to `node`, waking it; the key of its Ack. Raises StepFailed if it is gone."""
        process = self.nodes.get(node)
        if process is None or not process.alive:
            raise StepFailed(f"{node} is gone")
        self._tokens += 1
        token = self._tokens
        self._announce(process, make(token), fds)
        self._nudge(node)
        return ("ack", node, token), node

    def leave(self, node: str, order: control.ToNode, fds: tuple[int, ...] = ()) -> None:
        """Leave an order, unanswered, for when `node` wakes up next. Raises StepFailed if it is gone."""
        process = self.nodes.get(node)
        if process is None or not process.alive:
            raise StepFailed(f"{node} is gone")
        assert order.token == control.UNANSWERED
        self._announce(process, order, fds)

    def _announce(self, process: Process, order: control.ToNode, fds: tuple[int, ...]) -> None:
        self.nursery.order(process, order, fds)
        if process.header is not None:
            process.header.announce()

    def _nudge(self, node: str) -> None:
        for brick in self.graph.nodes[node]:
            for channel in self.channels.into(brick):
                channel.nudge()

    def nudge_late(self) -> None:
        """Nudge again whoever has not looked at its control mail: it may have changed its inputs since."""
        for node, process in self.nodes.items():
            if process.alive and process.header is not None and process.header.announced():
                self._nudge(node)

    def ask(
        self, node: str, make: Callable[[int], control.ToNode], fds: tuple[int, ...] = ()
    ) -> Generator[Wait, dict[Key, bytes], bytes]:
        """Send an order and wait for its answer."""
        key, name = self.order(node, make, fds)
        got = yield Wait(frozenset({key}), frozenset({name}))
        return got[key]

    def all_of(self, sent: Iterable[tuple[Key, str]]) -> Keys:
        """Wait for the answers to several orders. Raises StepFailed if a process has died before."""
        pairs = list(sent)
        for _, node in pairs:
            if not self.lives(node):
                raise StepFailed(f"{node} died")
        yield Wait(frozenset(k for k, _ in pairs), frozenset(n for _, n in pairs))

    # -- processes ----------------------------------------------------------------------------

    def launch(self) -> Keys:
        """The whole graph, from spares; the first replica leads, the second backs it up."""
        for link in self.graph.links:
            self.channels.renew(link)
        for slot in self.slots.values():
            slot.generation = 1
        sent = []
        for node in self.graph.nodes:
            sent.append((yield from self._assign(node)))
        yield from self.all_of(sent)
        if len(self.slots) > 1:
            self.backup = REPLICAS[1]
        self.pin_watchers()
        for slot in self.slots.values():
            slot.nodes = [n for n in self.graph.nodes if set(self.graph.nodes[n]) <= slot.bricks]
            yield from self.watch(slot)

    def spawn(self, slot: Slot) -> Keys:
        """A new generation of nodes in `slot`, its channels fresh, not leading."""
        slot.generation += 1
        slot.nodes = [n for n in self.graph.nodes if set(self.graph.nodes[n]) <= slot.bricks]
        for link in self.graph.links:
            inside = link.source in slot.bricks and link.sink in slot.bricks
            if inside or ("proxy" in (link.source, link.sink) and {link.source, link.sink} & slot.bricks):
                self.channels.renew(link)
        sent = []
        for node in slot.nodes:
            sent.append((yield from self._assign(node)))
        yield from self.all_of(sent)
        yield from self.watch(slot)

    def watch(self, slot: Slot) -> Keys:
        """Have the Watchdog of `slot` watch its present nodes. Without a Watchdog: nothing."""
        watchdog = f"{slot.name}/watchdog"
        process = self.nodes.get(watchdog)
        if process is None or not process.alive or not slot.nodes:
            return  # a Watchdog that is being replaced is told when it is there
        hosts = [self.nodes[n] for n in slot.nodes]
        if not all(host.alive for host in hosts):
            raise StepFailed(f"a node of replica {slot.name} died before it was watched")
        yield from self.ask(
            watchdog,
            lambda token: control.WatchNodes(
                token,
                slot.name,
                slot.generation,
                tuple(slot.nodes),
                tuple(str(host.journal) for host in hosts),
                tuple(host.pid for host in hosts),
            ),
            tuple(host.pidfd for host in hosts),
        )

    def respawn(self, node: str) -> Keys:
        """Replace a dead node of no replica: fresh channels, and its neighbours are told."""
        (brick,) = self.graph.nodes[node]
        touching = [c.link for c in self.channels.touching(frozenset({brick})) if not self._held(c)]
        for link in touching:
            self.channels.renew(link)
        yield from self.all_of([(yield from self._assign(node))])
        channels = [c for c in self.channels.touching(frozenset({brick})) if not self._held(c)]
        # Inputs first, and the client's output last: once it asks again, the way back stands.
        sent = [self._rebind_input(c) for c in channels if c.link.source == brick]
        outputs = [c for c in channels if c.link.sink == brick]
        outputs.sort(key=lambda c: c.link.source == "client")
        sent += [self._rebind_output(c) for c in outputs]
        yield from self.all_of(pair for pair in sent if pair is not None)
        for slot in self.slots.values():
            if node == f"{slot.name}/watchdog":
                yield from self.watch(slot)

    def _assign(self, node: str) -> Generator[Wait, dict[Key, bytes], tuple[Key, str]]:
        """Make a spare this node. Returns the key of its Ack."""
        specs = [self.graph.brick(name) for name in self.graph.nodes[node]]
        incarnation = self.incarnations[node] = self.incarnations.get(node, 0) + 1
        device, options = self._device_of(specs[0].kind, incarnation)
        process = yield from self.nursery.spare(BUS if device == "gateway" else LIGHT)
        process.name, process.kind, process.incarnation = node, "node", incarnation
        process.journal = self.record / "journal" / f"{node.replace('/', '.')}.{incarnation}.journal"
        self.nodes[node] = process
        slot = next((s for s in self.slots.values() if specs[0].name in s.bricks), None)
        inputs, outputs, fds = self._ends(frozenset(s.name for s in specs))
        leads = slot is not None and slot.name == self.leader
        locals_ = tuple(
            control.Local(k.source, k.source_port, k.sink, k.sink_port)
            for k in self.graph.links
            if {k.source, k.sink} <= {s.name for s in specs}
        )
        return self.order(
            node,
            lambda token: control.Assign(
                token,
                node,
                str(process.journal),
                tuple((s.name, s.kind) for s in specs),
                slot.number if slot else 0,
                self.epoch,
                leads,
                tuple(inputs),
                tuple(outputs),
                locals_,
                self.cpu_of(node),
                device,
                options,
            ),
            tuple(fds),
        )

    def assigned(self, process: Process) -> None:
        """The Ack of an Assign is here: its journal exists."""
        if process.header is None and process.journal is not None and process.journal.exists():
            process.header = Header(process.journal)

    def cpu_of(self, node: str) -> int | None:
        """A replica's chain stays on its core; Client and Proxy stay beside the leader.

        A Watchdog is on another core than the replica that it watches, and Recovery on another than
        the leader: a core on which a replica has just died is busy for a while with taking it down.
        """
        leads = self.slots.get(self.leader or self.backup)
        for slot in self.slots.values():
            if set(self.graph.nodes.get(node, ("",))) <= slot.bricks:
                return slot.cpu
        watched = self.slots.get(node.removesuffix("/watchdog"))
        if watched is not None:
            return next((s.cpu for s in self.slots.values() if s is not watched), None)
        if node in BESIDE_LEADER:
            return leads.cpu if leads else None
        return next((s.cpu for s in self.slots.values() if s is not leads), None)

    def pin(self, nodes: Iterable[str]) -> None:
        """Move `nodes` to where they belong now that another replica leads."""
        for node in nodes:
            cpu, process = self.cpu_of(node), self.nodes.get(node)
            if cpu is not None and process is not None and process.alive:
                os.sched_setaffinity(process.pid, {cpu})

    def pin_watchers(self) -> None:
        """Move who watches and recovers, this process included, to the core that does not lead."""
        cpu = self.cpu_of("recovery")
        if cpu is not None:
            os.sched_setaffinity(0, {cpu})
        self.pin(b.name for b in self.graph.bricks if b.kind in WATCHED_KINDS)

    # -- channels -----------------------------------------------------------------------------

    def _held(self, channel: Channel) -> bool:
        """Whether the Proxy's end of `channel` is kept here: it leads to a replica that does not lead."""
        link = channel.link
        if "proxy" not in (link.source, link.sink):
            return False
        other = link.sink if link.source == "proxy" else link.source
        slot = next((s for s in self.slots.values() if other in s.bricks), None)
        return slot is not None and slot.name != self.leader

    def _ends(self, bricks: frozenset[str]) -> tuple[list[control.Port], list[control.Port], list[int]]:
        """The ends of all channels between `bricks` and others, as ports and descriptors."""
        inputs: list[control.Port] = []
        outputs: list[control.Port] = []
        fds: list[int] = []
        for channel in self.channels.touching(bricks):
            link = channel.link
            if {link.source, link.sink} <= bricks or ("proxy" in bricks and self._held(channel)):
                continue
            if link.sink in bricks:
                inputs.append(control.Port(link.sink, link.sink_port, len(fds)))
                fds.append(channel.read.fileno())
            else:
                outputs.append(control.Port(link.source, link.source_port, len(fds)))
                fds.append(channel.write.fileno())
        return inputs, outputs, fds

    def _rebind_input(self, channel: Channel) -> tuple[Key, str] | None:
        """Hand the reading end to its brick, if that lives."""
        link = channel.link
        node = self.graph.node_of(link.sink)
        if not self.lives(node):
            return None
        return self.order(
            node,
            lambda token: control.BindInput(token, link.sink, link.sink_port),
            (channel.read.fileno(),),
        )

    def _rebind_output(self, channel: Channel) -> tuple[Key, str] | None:
        """Hand the writing end to its brick, if that lives."""
        link = channel.link
        node = self.graph.node_of(link.source)
        if not self.lives(node):
            return None
        return self.order(
            node,
            lambda token: control.BindOutput(token, link.source, link.source_port, self.epoch),
            (channel.write.fileno(),),
        )

    def rebind(self, channel: Channel) -> list[tuple[Key, str]]:
        """Both ends, the reading one first."""
        return [p for p in (self._rebind_input(channel), self._rebind_output(channel)) if p is not None]

    def lives(self, node: str) -> bool:
        """Whether the process of `node` is there."""
        process = self.nodes.get(node)
        return process is not None and process.alive

    def role_of(self, node: str) -> str:
        """What `aftbed ps` shows."""
        for slot in self.slots.values():
            if set(self.graph.nodes[node]) <= slot.bricks:
                if slot.name == self.leader:
                    return "primary" if len(self.slots) > 1 else "server"
                return "backup" if slot.name == self.backup else "joining"
        return node.rpartition("/")[2]

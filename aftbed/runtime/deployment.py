"""The deployed graph: which process hosts which bricks, which channels there are, which replica leads.

The executive owns both ends of every channel and hands them out, so channels outlive nodes: what is queued
while a node is suspended, killed or replaced stays queued. To bind a process is to give it its ends. A
process that belongs to no replica (Client, Proxy, Watchdogs, Recovery, Engine) is replaced in its place.

A chain is sequential, so the nodes of a replica share a core; the other replica has another one. Client and
Proxy are pinned beside the leader, a Watchdog to another core than the replica that it watches, and Recovery
to another one than the leader: a core on which a replica has died is busy with taking it down for a while.
"""

import contextlib
import functools
import hashlib
import itertools
from collections.abc import Callable, Container, Generator, Iterable, Iterator
from typing import Final

import msgspec

from aftbed.core.errors import StepFailed
from aftbed.core.graph import STAGED, Graph, Link
from aftbed.ftm.compose import REPLICAS
from aftbed.runtime import control
from aftbed.runtime.interface import BUS, LIGHT, Channel, Process, ProcessKind, Runtime
from aftbed.runtime.tasks import STEP_SECONDS_MAX, Key, Wait

ChannelKey = tuple[str, str, str]  # source, its port, sink


def key_of(link: Link) -> ChannelKey:
    """The key of its channel."""
    return link.source, link.source_port, link.sink


class Channels:
    """All channels between nodes, found by their ends."""

    def __init__(self, make: Callable[[Link], Channel]) -> None:
        self._make = make
        self.beside: dict[ChannelKey, Channel] = {}  # of the graph to be, or of the one before
        self._all: dict[ChannelKey, Channel] = {}

    def renew(self, link: Link) -> Channel:
        """Make a new channel for `link`; the old one is closed."""
        key = key_of(link)
        old = self._all.pop(key, None)
        if old is not None:
            old.close()
        channel = self._all[key] = self._make(link)
        return channel

    def make_beside(self, link: Link) -> Channel:
        """The channel of `link`, which the graph that runs does not have; a fresh one, if need be."""
        key = key_of(link)
        if key not in self.beside:
            self.beside[key] = self._make(link)
        return self.beside[key]

    def adopt(self, links: Iterable[Link]) -> None:
        """Make `links` those of the graph that runs; the other channels stay open beside it."""
        kept = set(map(key_of, links))
        known = self._all | self.beside
        self._all = {key: channel for key, channel in known.items() if key in kept}
        self.beside = {key: channel for key, channel in known.items() if key not in kept}

    def close_beside(self) -> None:
        """Close all channels beside the graph that runs."""
        for channel in self.beside.values():
            channel.close()
        self.beside = {}

    def touching(self, bricks: frozenset[str]) -> list[Channel]:
        """Those with an end at one of `bricks`."""
        return [c for c in self._all.values() if c.link.source in bricks or c.link.sink in bricks]

    def into(self, brick: str) -> list[Channel]:
        """Those that lead to `brick`, in the graph that runs or beside it."""
        return [c for c in (*self._all.values(), *self.beside.values()) if c.link.sink == brick]

    def get(self, source: str, port: str, sink: str) -> Channel | None:
        """The channel from `port` of `source` to `sink`."""
        return self._all.get((source, port, sink))

    def __iter__(self) -> Iterator[Channel]:
        return iter(self._all.values())

    def drop(self, channel: Channel) -> None:
        """Close and remove `channel`."""
        self._all.pop(key_of(channel.link), None)
        channel.close()

    def __len__(self) -> int:
        return len(self._all)


BESIDE_LEADER: Final = ("client", "proxy")


class Cores:
    """`cpus` are those that may be used; None leaves it all to the kernel."""

    def __init__(self, cpus: list[int] | None) -> None:
        self._of_replica = dict(zip(REPLICAS, itertools.cycle(cpus), strict=False)) if cpus else {}

    def of(self, node: str, hosted: tuple[str, ...], leader: str) -> int | None:
        """The core of `node`, which hosts `hosted`, while `leader` leads."""
        if not self._of_replica:
            return None
        if node.endswith("/watchdog"):
            return self._other_than(node.partition("/")[0])
        if hosted and all("/" in brick for brick in hosted):
            return self._of_replica.get(hosted[0].partition("/")[0])
        if node in BESIDE_LEADER:
            return self._of_replica.get(leader)
        return self._other_than(leader)

    def _other_than(self, replica: str) -> int | None:
        return next((cpu for name, cpu in self._of_replica.items() if name != replica), None)


WATCHED_KINDS: Final = ("client", "proxy", "watchdog", "recovery", "engine")

NUDGE_SECONDS: Final = 0.02  # until a node that has not read its orders is nudged again
HANG_NS: Final = 150_000_000  # where no Watchdog watches: a process that is not seen alive for so long hangs
BIRTH_SECONDS_MAX: Final = 10.0  # each makes its journal first, and a disk may be busy

DIGEST_DIGITS: Final = 16

Keys = Generator[Wait, dict[Key, bytes], None]
Sent = tuple[Key, str]  # an order: the key of its Ack, the name of its process
Staged = tuple[Process, Sent]


def replica_of(name: str) -> str:
    """The replica that is lost with a node or brick, `""` for one of none, such as a Watchdog."""
    head, _, part = name.partition("/")
    return head if head in REPLICAS and part != "watchdog" else ""


class Slot:
    """One place for a replica; `generation` counts the replicas that were in it.

    `complete`: all nodes of the present one have become what they are, so it can be watched.
    """

    def __init__(self, name: str, bricks: frozenset[str]) -> None:
        self.name, self.bricks = name, bricks
        self.number = REPLICAS.index(name) + 1
        self.generation = 0
        self.nodes: list[str] = []
        self.complete = False


class Hosted(msgspec.Struct, frozen=True):
    """What lives of a graph. `leader` and `backup`: replicas, or `""`; `bricks`: names with their kinds."""

    ftm: str
    placement: str
    leader: str
    backup: str
    bricks: tuple[tuple[str, str], ...]


def digest(state: bytes) -> str:
    """The first digits of the SHA-256 of `state`."""
    return hashlib.sha256(state).hexdigest()[:DIGEST_DIGITS]


class Deployment:
    """`leader` and `backup` are names of slots, or `""`; `singles`: the nodes that belong to no replica."""

    def __init__(self, graph: Graph, runtime: Runtime, cpus: list[int] | None) -> None:
        self.runtime, self.pool = runtime, runtime.pool
        self.channels = Channels(runtime.channel)
        self.nodes: dict[str, Process] = {}
        self.incarnations: dict[str, int] = {}
        self.epoch, self.leader, self.backup = 1, REPLICAS[0], ""
        self.lost: set[str] = set()  # replicas that an adaptation has left to Recovery
        self._tokens = 0
        self._nudges_late = False  # a timer runs for that
        self._cores = Cores(cpus)
        self._generations: dict[str, int] = {}
        self.slots: dict[str, Slot] = {}
        self.adopt(graph)

    def adopt(self, graph: Graph, lost: Container[str] = ()) -> None:
        """From now on, this is the graph that runs. A replica of other nodes is another generation of it:
        what was suspected of its predecessor means nothing. What is suspected of a `lost` one stands.
        """
        self.graph = graph
        self._generations |= {slot.name: slot.generation for slot in self.slots.values()}
        self.slots = {}
        of_replicas = {b.name: b.replica for b in graph.bricks if b.replica and b.kind not in WATCHED_KINDS}
        watched = {b.name for b in graph.bricks if b.kind in WATCHED_KINDS}
        self.singles = {n for n, hosted in graph.nodes.items() if watched & set(hosted[:1])}
        for name in REPLICAS:
            if graph.placement == "single":  # one node, so one fate: that of the replica that leads in it
                bricks = frozenset(of_replicas if name == self.leader else ())
            else:
                bricks = frozenset(brick for brick, replica in of_replicas.items() if replica == name)
            if bricks:
                slot = self.slots[name] = Slot(name, bricks)
                slot.nodes, slot.complete = [n for n in self.nodes_of(slot) if self.lives(n)], True
                slot.generation = self._generations.get(name, 0) + (name not in lost)

    def nodes_of(self, slot: Slot) -> list[str]:
        """The nodes of the graph that make up a replica."""
        return [n for n, hosted in self.graph.nodes.items() if slot.bricks.issuperset(hosted)]

    # -- orders -------------------------------------------------------------------------------

    def process(self, node: str) -> Process:
        """The process that is `node` now. Raises StepFailed if it is gone."""
        process = self.nodes.get(node)
        if process is None:
            raise StepFailed(f"{node} is gone")
        return process

    def order(
        self,
        host: str | Process,
        make: Callable[[int], control.ToNode],
        fds: tuple[int, ...] = (),
        *,
        suspended: bool = False,
    ) -> Sent:
        """Send an order to a node, or to a process that is staged or was exchanged, and wake it.

        One that is `suspended` waits for orders: no channel has to wake it. Raises StepFailed if it is gone.
        """
        process = self.process(host) if isinstance(host, str) else host
        self._tokens += 1
        self._send(process, make(self._tokens), fds)
        if not suspended:
            self._nudge(process.name)
        return ("ack", process.name, self._tokens), process.name

    def leave(self, node: str, order: control.ToNode, fds: tuple[int, ...] = ()) -> None:
        """Send an order without an answer, read at the next wake-up. Raises StepFailed if it is gone."""
        assert order.token == control.UNANSWERED
        self._send(self.process(node), order, fds)

    def _send(self, process: Process, order: control.ToNode, fds: tuple[int, ...]) -> None:
        if not process.alive:
            raise StepFailed(f"{process.name} is gone")
        self.pool.order(process, order, fds)
        process.announce()
        if process.announced() and not self._nudges_late:
            self._nudges_late = True
            self.runtime.loop.after(NUDGE_SECONDS, self._nudge_late)

    def _nudge(self, node: str) -> None:
        for brick in self.graph.nodes.get(node, ()):
            for channel in self.channels.into(brick):
                channel.nudge()

    def _nudge_late(self) -> None:
        """Nudge again each node that has not read its orders: it may have changed its inputs since."""
        late = [node for node, process in self.nodes.items() if process.alive and process.announced()]
        for node in late:
            self._nudge(node)
        self._nudges_late = bool(late)
        if late:
            self.runtime.loop.after(NUDGE_SECONDS, self._nudge_late)

    def ask(
        self,
        host: str | Process,
        make: Callable[[int], control.ToNode],
        fds: tuple[int, ...] = (),
        seconds: float = STEP_SECONDS_MAX,
    ) -> Generator[Wait, dict[Key, bytes], bytes]:
        """Send an order and wait for its answer.

        Raises StepFailed if the process is gone, dies, refuses, or takes too long.
        """
        key, name = self.order(host, make, fds)
        got = yield Wait(frozenset({key}), frozenset({name}), seconds)
        return got[key]

    def answers(
        self, sent: Iterable[Sent], seconds: float = STEP_SECONDS_MAX
    ) -> Generator[Wait, dict[Key, bytes], dict[Key, bytes]]:
        """Wait for the answers to several orders. Raises StepFailed, also if a node has died before."""
        pairs = list(sent)
        for _, name in pairs:
            if name in self.nodes and not self.lives(name):
                raise StepFailed(f"{name} died")
        if not pairs:
            return {}
        return (yield Wait(frozenset(k for k, _ in pairs), frozenset(n for _, n in pairs), seconds))

    # -- processes ----------------------------------------------------------------------------

    def launch(self, held: Container[str] = ()) -> Keys:
        """The whole graph, from spares; the first replica leads. A node that is `held` waits for a Resume."""
        for link in self.graph.links:
            self.channels.renew(link)
        sent = []
        for node in self.graph.nodes:
            waits = node == "proxy" or replica_of(node) not in ("", self.leader)
            sent.append((yield from self._assign(node, held=node in held, rehearse=waits)))
        yield from self.answers(sent, BIRTH_SECONDS_MAX)
        if len(self.slots) > 1:
            self.backup = REPLICAS[1]
        self.pin_watchers()
        for slot in self.slots.values():
            slot.nodes, slot.complete = self.nodes_of(slot), True
            yield from self.watch(slot, seconds=BIRTH_SECONDS_MAX)  # nothing serves yet

    def spawn(self, slot: Slot) -> Keys:
        """A new generation of nodes in `slot`, its channels fresh, not leading."""
        slot.generation += 1
        slot.nodes, slot.complete = self.nodes_of(slot), False
        for link in self.graph.links:
            inside = link.source in slot.bricks and link.sink in slot.bricks
            if inside or ("proxy" in (link.source, link.sink) and {link.source, link.sink} & slot.bricks):
                self.channels.renew(link)
        sent = []
        for node in slot.nodes:
            sent.append((yield from self._assign(node)))
        yield from self.answers(sent, BIRTH_SECONDS_MAX)
        self.assert_whole(slot)
        slot.complete = True
        yield from self.watch(slot)

    def rehearse(self, replica: str) -> None:
        """Have the nodes of a new backup rehearse. They do not before it is ready: until then a crash of the
        leader ends the service.
        """
        slot = self.slots.get(replica)  # none if the run has been adapted to a single replica since
        for node in slot.nodes if slot is not None else ():
            with contextlib.suppress(StepFailed):  # it is dead, and its replica lost
                kinds = tuple(kind for _, kind in self.process(node).bricks)
                self.leave(node, control.Rehearse(control.UNANSWERED, kinds))
                self._nudge(node)

    def assert_whole(self, slot: Slot) -> None:
        """Raise StepFailed if a node of `slot` is dead."""
        dead = [node for node in slot.nodes if not self.lives(node)]
        if dead:
            raise StepFailed(f"{dead[0]} died")

    def shut_replication(self, slot: Slot) -> None:
        """What `slot` sends to the other replica ends after what was sent."""
        for channel in self.channels.touching(slot.bricks):
            source, sink = channel.link.source, channel.link.sink
            if source in slot.bricks and "/" in sink and sink not in slot.bricks:
                channel.fence()

    def watch(self, slot: Slot, *, none: bool = False, seconds: float = STEP_SECONDS_MAX) -> Keys:
        """Have the Watchdog of `slot` watch its present nodes, or none. Without a Watchdog: nothing.

        If one of them is dead already, the replica is `lost`: the next situation informs Recovery.
        """
        watchdog = f"{slot.name}/watchdog"
        process = self.nodes.get(watchdog)
        if process is None or not process.alive or not slot.nodes or not slot.complete:
            return  # a Watchdog that is being replaced gets it later, as does that of a replica being made
        nodes = () if none else tuple(slot.nodes)
        if not all(self.lives(n) for n in nodes):
            self.lost.add(slot.name)  # its Watchdog died before it could report that
            return
        hosts = [self.nodes[n] for n in nodes]
        yield from self.ask(
            watchdog,
            lambda token: control.WatchNodes(
                token,
                slot.name,
                slot.generation,
                nodes,
                tuple(host.journal for host in hosts),
                tuple(host.pid for host in hosts),
            ),
            tuple(host.pidfd for host in hosts),
            seconds,
        )

    def respawn(self, node: str, *, held: bool = False) -> Keys:
        """Replace a dead node of no replica: fresh channels, and new ends for its neighbours."""
        (brick,) = self.graph.nodes[node]
        for channel in self.channels.touching(frozenset({brick})):
            if not self._held(channel):
                self.channels.renew(channel.link)
        yield from self.answers([(yield from self._assign(node, held=held))])
        channels = [c for c in self.channels.touching(frozenset({brick})) if not self._held(c)]
        # The way back stands before anything is asked on the way there: a new Client asks as soon as it is
        # read, an old one asks again as soon as it may write.
        into = [c for c in channels if c.link.sink == brick]
        sent = [one for c in into if c.link.source != "client" for one in self._hand(c, reading=False)]
        sent += [one for c in channels if c.link.source == brick for one in self._hand(c, reading=True)]
        sent += [one for c in into if c.link.source == "client" for one in self._hand(c, reading=False)]
        yield from self.answers(sent)
        for slot in self.slots.values():
            if node == f"{slot.name}/watchdog":
                yield from self.watch(slot)

    def _assign(
        self, node: str, *, held: bool = False, rehearse: bool = False
    ) -> Generator[Wait, dict[Key, bytes], Sent]:
        """Make a spare this node, with its ends of channels."""
        process, sent = yield from self._make(node, self.graph, staged=False, held=held, rehearse=rehearse)
        process.kind = ProcessKind.NODE
        self.nodes[node] = process
        return sent

    def stage(self, node: str, graph: Graph, *, held: bool) -> Generator[Wait, dict[Key, bytes], Staged]:
        """Make a spare this node of `graph`, beside the nodes that serve, without any channel."""
        return (yield from self._make(node, graph, staged=True, held=held, rehearse=True))

    def _make(
        self, node: str, graph: Graph, *, staged: bool, held: bool, rehearse: bool
    ) -> Generator[Wait, dict[Key, bytes], Staged]:
        names = frozenset(graph.nodes[node])
        specs = tuple(map(graph.brick, graph.nodes[node]))
        inputs, outputs, fds = ([], [], []) if staged else self._ends(names)
        incarnation = self.incarnations[node] = self.incarnations.get(node, 0) + 1
        device, options = self.runtime.device(specs[0].kind, incarnation)
        process = yield from self.pool.spare(BUS if device == "gateway" else LIGHT)
        process.name = f"{node}{STAGED}" if staged else node
        process.kind, process.incarnation = ProcessKind.STAGED, incarnation
        process.journal = self.runtime.journal_of(node, incarnation)
        process.bricks = tuple((spec.name, spec.kind) for spec in specs)
        trial = None
        if staged and any(spec.source or spec.application for spec in specs):
            trial = control.SelfTest(graph, self.runtime.recorded_requests())
        sent = self.order(
            process,
            lambda token: control.Assign(
                token,
                node,
                process.journal,
                specs,
                self.epoch,
                self.leader,
                tuple(inputs),
                tuple(outputs),
                tuple(
                    control.Local(k.source, k.source_port, k.sink, k.sink_port)
                    for k in graph.links
                    if k.source in names and k.sink in names
                ),
                self.cpu_of(node, graph),
                held,
                staged,
                self.cpu_of("recovery"),
                rehearse,
                trial,
                device,
                options,
            ),
            tuple(fds),
        )
        return process, sent

    def cpu_of(self, node: str, graph: Graph | None = None) -> int | None:
        """The core of `node`."""
        hosted = (graph or self.graph).nodes.get(node, ())
        return self._cores.of(node, hosted, self.leader or self.backup)

    def pin(self, nodes: Iterable[str]) -> None:
        """Move `nodes` to their cores after another replica has become leader."""
        for node in nodes:
            cpu, process = self.cpu_of(node), self.nodes.get(node)
            if cpu is not None and process is not None and process.alive:
                self.runtime.pin(process.pid, cpu)

    def pin_watchers(self) -> None:
        """Move Watchdogs, Recovery, zygotes and this process to the core that does not lead."""
        cpu = self.cpu_of("recovery")
        if cpu is not None:
            for pid in (0, *(zygote.pid for zygote in self.pool.zygotes.values() if zygote.alive)):
                self.runtime.pin(pid, cpu)
        self.pin(b.name for b in self.graph.bricks if b.kind in WATCHED_KINDS)

    # -- channels -----------------------------------------------------------------------------

    def _held(self, channel: Channel) -> bool:
        """Whether the executive keeps the Proxy's end of `channel`: it leads to a replica that does not
        lead.
        """
        link = channel.link
        if "proxy" not in (link.source, link.sink):
            return False
        other = link.sink if link.source == "proxy" else link.source
        return "/" in other and other.partition("/")[0] != self.leader

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

    def _hand(self, channel: Channel, *, reading: bool) -> list[Sent]:
        """Hand an end of `channel` to its brick, if that lives."""
        link = channel.link
        node = self.graph.node_of(link.sink if reading else link.source)
        if not self.lives(node):
            return []

        def order(token: int) -> control.BindInput | control.BindOutput:
            if reading:
                return control.BindInput(token, link.sink, link.sink_port)
            return control.BindOutput(token, link.source, link.source_port, self.epoch)

        return [self.order(node, order, ((channel.read if reading else channel.write).fileno(),))]

    # -- what there is ------------------------------------------------------------------------

    def hosted(self) -> Hosted:
        """What lives now, as far as is known: a death that is not yet noticed does not count."""
        living = [p for p in self.pool.processes if p.alive and p.kind is not ProcessKind.KILLED]
        bricks = tuple(sorted(brick for process in living for brick in process.bricks))
        return Hosted(self.graph.ftm, self.graph.placement, self.leader, self.backup, bricks)

    def ask_states(self, found: dict[str, str]) -> Keys:
        """Put the digest of each Server's state into `found`, by replica; a function may hand out none."""
        for replica in (self.leader, self.backup):
            server = f"{replica}/server"
            if any(brick.name == server for brick in self.graph.bricks):
                order = functools.partial(control.Capture, brick=server, look=True)
                with contextlib.suppress(StepFailed):
                    state = yield from self.ask(self.graph.node_of(server), order)
                    found |= {replica: digest(state)} if state else {}

    def lives(self, node: str) -> bool:
        """Whether the process of `node` is there."""
        process = self.nodes.get(node)
        return process is not None and process.alive

    def cause_of_loss(self, replica: str) -> str:
        """What the Watchdog of `replica` saw: a node that died, or else one that hangs."""
        nodes = [self.nodes[node] for node in self.slots[replica].nodes if node in self.nodes]
        return "crash" if any(node.dying() for node in nodes) else "hang"

    def role_of(self, node: str) -> str:
        """The role that `aftbed ps` shows."""
        for slot in self.slots.values():
            if set(self.graph.nodes[node]) <= slot.bricks:
                if slot.name == self.leader:
                    return "primary" if len(self.slots) > 1 else "server"
                return "backup" if slot.name == self.backup else "joining"
        return node.rpartition("/")[2]

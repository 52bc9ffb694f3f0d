"""The bricks of a graph, run in memory: a queue per channel, one micro-step after the other.

A micro-step is one effect of one brick, one message handed to one brick, or one stage of a script; so a crash
can be put between any two of them, also between two effects of one step. What may happen next is a list
of moves; `choose` picks one (the first, for a dialogue that a person reads; a random one, for the rest).

What the runtime does is done too (scripts: see `executive`), in its order: a fenced channel ends after what
was sent, a brick that writes to it dies, what is suspended takes no mail, mail for a closed port waits. So
are value faults (see `spoiling`).
"""

from collections import deque
from collections.abc import Callable
from typing import Final

from counting import Counting
from executive import Executive
from hosts import Channel, Host, Sent
from spoiling import Spoil, spoiled

from aftbed.core import wire
from aftbed.core.brick import CONTROL, Halt, Note, Order, Send
from aftbed.core.check import History
from aftbed.core.errors import PeerError
from aftbed.core.event import Event
from aftbed.core.graph import Link
from aftbed.core.journal import Entry, EntryKind, Record
from aftbed.core.message import (
    AnyMessage,
    ChannelEnded,
    Message,
    NodeDied,
    Promoted,
    Rebound,
    Reply,
    Situation,
    Submit,
    Watch,
)
from aftbed.ftm.catalog import Setting, make
from aftbed.ftm.client import Client
from aftbed.ftm.mechanism import REPLICAS, STATEFUL, build, chain, replication_of
from aftbed.ftm.server import Server

STEPS_MAX: Final = 60_000
SUPERVISOR: Final = "supervisor"
SAID: Final = (  # events that no message shows
    Event.DEDUPE_HIT,
    Event.REPLY_REFUSED,
    Event.FOLLOWER_DIVERGED,
    Event.VOTE_COMPARED,
    Event.DETECTED_STOP,
)


Move = tuple[str, str]  # what, of which brick
Choose = Callable[[list[Move]], Move]


def first(moves: list[Move]) -> Move:
    """The order of a quiet machine."""
    return moves[0]


class World:
    """The deployed graph of an expression with its client, in the state after the launch."""

    def __init__(self, choose: Choose = first, expression: str = "pbr") -> None:
        self.graph = build(expression, "process")
        self.replication = replication_of(expression)
        replicas = REPLICAS if self.replication else REPLICAS[:1]
        self.parts = {replica: chain(self.graph, replica) for replica in replicas}
        self.choose = choose
        self.hosts: dict[str, Host] = {}
        self.channels: dict[tuple[str, str, str], Channel] = {}
        self.leader, self.backup, self.epoch = "a", "b" if self.replication else "", 1
        self.generation = dict.fromkeys(replicas, 1)
        self.vacant: list[str] = []
        self.now_ns = 0
        self.journals: dict[str, list[Record]] = {}
        self.dialogue: list[Entry] = []
        self.replies: list[Reply] = []
        self.saying: Callable[[str], None] = lambda what: None  # told of all that happens
        self.promoted: set[tuple[str, int]] = set()
        self.dead: deque[str] = deque()  # nodes whose Watchdog does not know yet
        self.spoil: Spoil = lambda replica, request_id: None
        self.executive = Executive(self)
        self._accused: set[tuple[str, int]] = set()
        self._lives: dict[str, int] = {}
        self._looked = False  # the script that waits has looked, and nothing has happened since
        self._steps = 0
        self._launch()

    # -- deployment ---------------------------------------------------------------------------

    def _launch(self) -> None:
        for link in self.graph.links:
            self.renew(link)
        for spec in self.graph.bricks:
            if spec.kind != "engine":  # what it would do is not done here
                self.host(spec.name, leads=spec.replica == "a")
        for link in self.graph.links:
            self.connect(link)
        for replica in self.parts:
            self.watch(replica)
        self.inform(failed=False)
        self.run()

    def host(self, name: str, *, leads: bool) -> Host:
        spec = self.graph.brick(name)
        number = REPLICAS.index(spec.replica) + 1 if spec.replica else 0
        self._lives[name] = life = self._lives.get(name, 0) + 1
        brick = make(spec.kind, Setting(number, self.epoch, leads, Counting))
        host = self.hosts[name] = Host(name, brick, f"{name}.{life}")
        self.journals[host.journal] = []
        return host

    def renew(self, link: Link) -> Channel:
        channel = self.channels[link.source, link.source_port, link.sink] = Channel(link)
        return channel

    def channel(self, source: str, port: str, sink: str) -> Channel:
        return self.channels[source, port, sink]

    def _is_held(self, link: Link) -> bool:
        """Whether the Proxy's end leads to a replica that does not lead: the runtime keeps it."""
        ends = (link.source, link.sink)
        others = [e for e in ends if e != "proxy"]
        return "proxy" in ends and "/" in others[0] and others[0].partition("/")[0] != self.leader

    def connect(self, link: Link) -> None:
        """Give both bricks their ends, the reading one first; the writer is told."""
        channel = self.channel(link.source, link.source_port, link.sink)
        if link.sink in self.hosts and not (self._is_held(link) and link.sink == "proxy"):
            self.bind_input(channel)
        if link.source in self.hosts and not (self._is_held(link) and link.source == "proxy"):
            self.bind_output(channel, link.source, link.source_port)

    def bind_input(self, channel: Channel) -> None:
        host = self.between_steps(channel.link.sink)
        if host is not None:
            host.inputs[channel.link.sink_port] = channel

    def bind_output(self, channel: Channel | None, name: str, port: str) -> None:
        """Bind or unbind, and say so to the brick."""
        host = self.between_steps(name)
        if host is None:
            return
        if channel is None:
            host.outputs.pop(port, None)
        else:
            host.outputs[port] = channel
        self.tell(name, Rebound(port, channel is not None, self.epoch))

    def between_steps(self, name: str) -> Host | None:
        """`name` with its effects performed: control mail is served between two steps. None if it is gone."""
        while name in self.hosts and self.hosts[name].todo:
            self._perform(self.hosts[name])
        return self.hosts.get(name)

    def chain(self, replica: str) -> list[str]:
        """The bricks of `replica` that are there."""
        return [name for name in self.parts[replica] if name in self.hosts]

    def watch(self, replica: str) -> None:
        watchdog = f"{replica}/watchdog"
        if watchdog in self.hosts:
            nodes = self.parts[replica]
            self.tell(watchdog, Watch(replica, self.generation[replica], nodes))
            of_others = [node for node in self.dead if node not in nodes]
            gone = [] if replica in self.vacant else [node for node in nodes if not self.seems_alive(node)]
            self.dead = deque(of_others + gone)

    def inform(self, *, failed: bool) -> None:
        if "recovery" in self.hosts:
            leads = self.generation.get(self.leader, 0)
            backs = self.generation.get(self.backup, 0)
            situation = Situation(
                self.leader,
                leads,
                self.backup,
                backs,
                self.epoch,
                tuple(self.vacant),
                failed,
                self.replication,
                STATEFUL,
            )
            self.tell("recovery", situation)

    # -- what happens to it -------------------------------------------------------------------

    def submit(self, payload: bytes) -> None:
        """The source of requests hands one in; it is there whether or not the Client takes it now."""
        client = self.hosts["client"].brick
        assert isinstance(client, Client) and "submit" in client.open_ports()
        self._write_down(client.next_id, 0, EntryKind.SENT, payload)
        self.tell("client", Submit(payload), "submit")

    def crash(self, target: str) -> None:
        """A brick, or a whole replica, is gone, with what it had still to do."""
        for name in self.chain(target) if target in self.parts else [target]:
            if name in self.hosts:
                del self.hosts[name]
                self.dead.append(name)

    def accuse(self, node: str) -> None:
        """To its Watchdog, also to the next one, `node` seems to be dead; it lives, and goes on."""
        self._accused.add((node, self.generation[node[0]]))
        self.dead.append(node)

    def seems_alive(self, node: str) -> bool:
        """What a Watchdog believes of a node of a replica."""
        return node in self.hosts and (node, self.generation[node[0]]) not in self._accused

    def replace(self, name: str) -> None:
        """A brick of no replica is dead, and another is in its place: fresh channels, no memory."""
        self.hosts.pop(name, None)
        links = [c.link for c in self.channels.values() if name in (c.link.source, c.link.sink)]
        links = [link for link in links if not self._is_held(link)]
        links.sort(key=lambda link: link.source == "client")  # it asks again: the way back stands
        for link in links:
            self.renew(link)
        self.host(name, leads=False)
        for link in links:
            self.connect(link)
        if name.endswith("/watchdog"):
            self.watch(name.partition("/")[0])
        if name == "recovery" and not self.executive.busy:
            self.inform(failed=False)

    def tell(self, name: str, message: AnyMessage, port: str = CONTROL) -> None:
        """Have `name` step; its effects are performed later, one by one."""
        host = self.between_steps(name)
        if host is None:
            return
        try:
            effects = host.brick.step(port, message, self.now_ns)
            if isinstance(host.brick, Server):
                effects = spoiled(self.spoil, name, host.brick, effects, self.saying)
            host.todo.extend(effects)
        except PeerError as error:
            self.record(host.journal, Event.PEER_REFUSED, getattr(message, "request_id", 0), 0)
            if not isinstance(message, Rebound | ChannelEnded):  # told to all, of interest to some
                self.saying(f"{name} refuses {type(message).__name__}: {error}")

    # -- running ------------------------------------------------------------------------------

    def run(self, stop_after: str = "") -> None:
        """Step until nothing is left to do, or until the message `stop_after` was put into its channel."""
        seen: list[str] = []
        saying = self.saying

        def watch(what: str) -> None:
            seen.append(what)
            saying(what)

        self.saying = watch
        while self.step():
            if stop_after in seen:
                break
        self.saying = saying
        assert not stop_after or stop_after in seen, f"never happened: {stop_after}"

    def step(self) -> bool:
        """One micro-step; False if there is none."""
        self._steps += 1
        assert self._steps < STEPS_MAX, "no end in sight"
        self.now_ns += 1000
        moves = self.moves()
        if not moves:
            return self._pass_time()
        what, name = self.choose(moves)
        self._looked = what == "script"
        if what == "effect":
            self._perform(self.hosts[name])
        elif what == "script":
            self.executive.go_on(alone=len(moves) == 1)
        elif what == "death":
            self._report_death()
        else:
            self._deliver(self.hosts[name], what)
        return True

    def moves(self) -> list[Move]:
        """All that may happen next: effects, the script, deaths, mail by its age.

        A script that waits comes last, and looks again only after something else, if there is anything else.
        """
        found: list[Move] = [("effect", h.name) for h in self.hosts.values() if h.todo]
        script: list[Move] = [("script", SUPERVISOR)] if self.executive.busy else []
        if not self.executive.waits:
            found += script
        if self.dead:
            found.append(("death", SUPERVISOR))
        ready = [
            (channel.mail[0][0] if channel.mail else self.now_ns, port, host.name)
            for host in self.hosts.values()
            if not host.todo
            for port, channel in host.inputs.items()
            if (channel.mail or channel.ended) and host.takes(port)
        ]
        found += [(port, name) for _, port, name in sorted(ready)]
        return found + script if self.executive.waits and not (self._looked and found) else found

    def _pass_time(self) -> bool:
        """Nothing else to do: the earliest deadline comes."""
        due = [(at, h.name) for h in self.hosts.values() if (at := h.brick.deadline_ns()) is not None]
        if not due:
            return False
        self.now_ns, name = max(self.now_ns, min(due)[0]), min(due)[1]
        host = self.hosts[name]
        host.todo.extend(host.brick.wake(self.now_ns))
        return True

    def _deliver(self, host: Host, port: str) -> None:
        channel = host.inputs[port]
        if channel.mail:
            _, message = channel.mail.popleft()
            self.tell(host.name, wire.decode(wire.encode(message)), port)
        else:
            del host.inputs[port]
            self.tell(host.name, ChannelEnded(), port)

    def _report_death(self) -> None:
        node = self.dead.popleft()
        watchdog = f"{node.partition('/')[0]}/watchdog"
        if watchdog in self.hosts:
            self.tell(watchdog, NodeDied(node), "sense")

    def _perform(self, host: Host) -> None:
        effect = host.todo.popleft()
        match effect:
            case Note(event, request_id, detail):
                self.record(host.journal, event, request_id, detail)
            case Order(ordered):
                self.executive.order(ordered)
            case Halt(reason):
                assert not host.todo, "a detected stop is the last effect"
                del self.hosts[host.name]
                self.dead.append(host.name)
                self.saying(f"{host.name} stops: {reason}")
            case Send(port, message) if port == CONTROL:
                assert isinstance(message, Promoted)
                self.promoted.add((host.name, message.epoch))
                self.saying(f"{host.name} leads, epoch={message.epoch}")
            case Send("deliver", message):
                assert isinstance(message, Reply)
                self.replies.append(message)
                self._write_down(message.request_id, message.epoch, EntryKind.ANSWERED, message.payload)
                said = message.payload.decode(errors="replace")
                self.saying(f"deliver Reply({message.request_id})={said}")
            case Send(port, message):
                self._send(host, port, message)

    def _send(self, host: Host, port: str, message: Message) -> None:
        channel = host.outputs.get(port)
        if channel is None:
            return
        if channel.ended:  # EPIPE: a fenced brick dies
            self.hosts.pop(host.name)
            self.saying(f"{host.name} meets its fence and dies")
            return
        channel.mail.append((self.now_ns, message))
        self.saying(str(Sent(port, message)))

    def record(self, journal: str, event: Event, request_id: int, detail: int) -> None:
        node = journal.rpartition(".")[0]
        self.journals[journal].append(Record(self.now_ns, event, request_id, detail, node))
        if event in SAID:
            self.saying(f"{event}({request_id})" + (f"={detail}" if event is Event.VOTE_COMPARED else ""))

    def _write_down(self, request_id: int, epoch: int, kind: EntryKind, payload: bytes) -> None:
        self.dialogue.append(Entry(self.now_ns, request_id, epoch, kind, payload))

    def history(self) -> History:
        """What a run of real processes would have recorded."""
        return History(self.journals, self.dialogue)

"""Scripts on the bricks in memory: what the runtime does with real processes, stage by stage.

Each verb is a generator of stages, so that anything may happen between two of them: a crash as well.
"""

from collections.abc import Iterator
from enum import Enum, auto
from typing import TYPE_CHECKING, Final

from aftbed.core import script
from aftbed.core.event import Event
from aftbed.core.graph import Link
from aftbed.core.message import Promote
from aftbed.ftm.mechanism import REPLICAS

if TYPE_CHECKING:
    from harness import World

JOURNAL: Final = "supervisor.1"


class Stage(Enum):
    """How a script stands."""

    GO = auto()
    WAIT = auto()  # something else must happen first
    FAILED = auto()
    DONE = auto()


Stages = Iterator[Stage]


class Executive:
    """One script at a time; `waits`: it can go on only after something else has happened."""

    def __init__(self, world: "World") -> None:
        self._world = world
        self._ordered: script.Script | None = None
        self._stages: Stages = iter(())
        self.waits = False

    @property
    def busy(self) -> bool:
        """A script is under way."""
        return self._ordered is not None

    def order(self, ordered: script.Script) -> None:
        """Begin, unless another one is under way: whoever ordered this one hears how that one ended."""
        assert script.problems(ordered) == []
        if not self.busy:
            self._ordered, self._stages, self.waits = ordered, self._execute(ordered), False

    def go_on(self, *, alone: bool) -> None:
        """One stage more. What waits while nothing else can happen has passed its deadline."""
        assert self._ordered is not None
        stage = next(self._stages, Stage.DONE)
        stuck = stage is Stage.WAIT and self.waits and alone
        self.waits = stage is Stage.WAIT
        if stage is Stage.FAILED or stuck:
            self._undo(self._ordered)
        if stage in (Stage.FAILED, Stage.DONE) or stuck:
            failed = stage is not Stage.DONE
            self._ordered, self.waits = None, False
            self._world.inform(failed=failed)

    def _execute(self, ordered: script.Script) -> Stages:
        for verb in (*ordered.prepare, *ordered.commit):
            yield from self._do(verb)
            yield Stage.GO

    def _undo(self, ordered: script.Script) -> None:
        world = self._world
        world.saying(f"{ordered.purpose} fails")
        if ordered.purpose == "failover":  # nobody is left
            for replica in REPLICAS:
                self._kill(replica)
            world.leader = world.backup = ""
        if ordered.purpose == "new backup" and world.backup != ordered.replica:
            self._kill(ordered.replica)
        for host in world.hosts.values():
            host.suspended = False

    def _do(self, verb: script.AnyVerb) -> Stages:
        match verb:
            case script.Spawn(replica):
                self._spawn(replica)
            case script.Fence(replica):
                self._fence(replica)
            case script.Kill(replica):
                self._kill(replica)
            case script.Promote(replica, epoch):
                yield from self._promote(replica, epoch)
            case script.Attach(replica, epoch):
                yield from self._attach(replica, epoch)
            case script.Suspend(brick):
                yield from self._suspend(brick)
            case script.Resume(brick):
                yield from self._resume(brick)
            case script.Transfer(source, sink):
                yield from self._transfer(source, sink)
            case script.Bind():
                yield from self._bind(verb.link)
            case script.Unbind(brick, port):
                yield from self._unbind(brick, port)
            case _:
                raise AssertionError(f"{verb} belongs into an adaptation")

    def _spawn(self, replica: str) -> None:
        world = self._world
        world.saying(f"spawn {replica}")
        world.generation[replica] += 1
        world.vacant.remove(replica)
        names = set(world.parts[replica])
        links = [k for k in world.graph.links if {k.source, k.sink} <= names | {"proxy"}]
        links = [k for k in links if {k.source, k.sink} & names]
        for link in links:
            world.renew(link)
        for name in world.parts[replica]:
            world.host(name, leads=False)
        for link in links:
            world.connect(link)
        world.watch(replica)

    def _fence(self, replica: str) -> None:
        world = self._world
        world.saying(f"fence {replica}")
        for channel in world.channels.values():
            channel.ended = channel.ended or channel.link.source in world.parts[replica]
        if replica == world.leader:
            world.leader = ""
        detail = world.generation[replica] << 8 | REPLICAS.index(replica) + 1
        world.journals.setdefault(JOURNAL, [])
        world.record(JOURNAL, Event.REPLICA_FENCED, 0, detail)

    def _kill(self, replica: str) -> None:
        world = self._world
        world.saying(f"kill {replica}")
        for name in world.chain(replica):
            del world.hosts[name]
        if replica not in world.vacant:
            world.vacant.append(replica)
        if world.backup == replica:
            world.backup = ""

    def _promote(self, replica: str, epoch: int) -> Stages:
        world = self._world
        world.saying(f"promote {replica} epoch={epoch}")
        first, _ = world.replication[0]  # the one that a request meets first of those that hear of the leader
        if f"{replica}/{first}" not in world.hosts:
            yield Stage.FAILED
        world.tell(f"{replica}/{first}", Promote(epoch))
        while (f"{replica}/protocol", epoch) not in world.promoted:
            whole = len(world.chain(replica)) == len(world.parts[replica])
            yield Stage.WAIT if whole else Stage.FAILED

    def _attach(self, replica: str, epoch: int) -> Stages:
        world = self._world
        world.saying(f"attach proxy to {replica} epoch={epoch}")
        world.leader, world.backup, world.epoch = replica, "", epoch
        world.bind_input(world.channel(f"{replica}/protocol", "pro2pxy", "proxy"))
        yield Stage.GO
        if f"{replica}/protocol" == world.hosts["proxy"].inputs["pro2pxy"].link.source:
            world.bind_output(world.channel("proxy", "pxy2pro", f"{replica}/protocol"), "proxy", "pxy2pro")

    def _suspend(self, brick: str) -> Stages:
        """The brick takes no new request; what is inside it is finished."""
        world = self._world
        world.saying(f"suspend {brick}")
        if brick in world.hosts:
            world.hosts[brick].suspended = True
        while True:
            host = world.hosts.get(brick)
            if host is not None and host.brick.quiescent() and not host.todo:
                return
            yield Stage.WAIT if host is not None else Stage.FAILED

    def _resume(self, brick: str) -> Stages:
        self._world.saying(f"resume {brick}")
        if brick not in self._world.hosts:
            yield Stage.FAILED
        self._world.hosts[brick].suspended = False

    def _transfer(self, source: str, sink: str) -> Stages:
        hosts = self._world.hosts
        self._world.saying(f"transfer {source} to {sink}")
        if source not in hosts or sink not in hosts:
            yield Stage.FAILED
        hosts[sink].brick.restore(hosts[source].brick.capture())

    def _bind(self, link: Link) -> Stages:
        world = self._world
        world.saying(f"bind {link.source_port} of {link.source} to {link.sink}")
        if link.source.partition("/")[0] == world.leader != link.sink.partition("/")[0]:
            world.backup = link.sink.partition("/")[0]  # from here on it holds all that the leader holds
        if link.sink not in world.hosts:
            yield Stage.FAILED
        channel = world.renew(link)
        world.bind_input(channel)
        yield Stage.GO
        if link.source not in world.hosts:
            yield Stage.FAILED
        world.bind_output(channel, link.source, link.source_port)

    def _unbind(self, brick: str, port: str) -> Stages:
        world = self._world
        world.saying(f"unbind {port} of {brick}")
        if (brick.partition("/")[2], port) in world.replication:
            world.backup = ""
        if brick not in world.hosts:
            yield Stage.FAILED
        world.bind_output(None, brick, port)

"""Watchdog and Recovery: a replica that is dead or hangs is found, and redundancy is restored.

Paper, III-A: the Watchdog's alarm makes Recovery promote the backup. Recovery's decision is a function of
the situation that the runtime reports and of the suspicions against it. So a Recovery that died in the middle
of a failover is replaced by one that knows as much.

| leader             | backup            | script                        |
|--------------------|-------------------|-------------------------------|
| suspected          | sound             | failover: the backup leads    |
| crashed            | has hung          | failover: the backup leads    |
| any other          | suspected         | drop backup: the leader alone |
| sound, or has hung | none, slot vacant | new backup, by state transfer |

A replica that has hung may serve again by now. If a leader that has hung answers the script for a new backup,
the failover to that backup follows, since the suspicion stands; if it does not, the script fails.

By which ports a leader sends to its backup, and whose state a new backup needs, depends on the mechanism:
the situation has both. Without such a port there is one replica, and nothing to be done about its death.
"""

from collections.abc import Mapping
from typing import Final

from aftbed.core.brick import Brick, Effect, Note, Order, Send
from aftbed.core.errors import PeerError
from aftbed.core.events import Event
from aftbed.core.messages import AnyMessage, Loss, NodeDied, Rebound, SeenAlive, Situation, Suspect, Watch
from aftbed.core.script import (
    Attach,
    Bind,
    Fence,
    Kill,
    Promote,
    Resume,
    Script,
    ScriptKind,
    Spawn,
    Step,
    Suspend,
    Transfer,
    Unbind,
)
from aftbed.ftm.declaration import BrickKind, Emits

HANG_DEADLINE_NS: Final = 50_000_000
LATE_NS_MAX: Final = 10_000_000
_OPEN: Final = ("sense",)


class Watchdog(Brick):
    """Reports to Recovery that a node of its replica is dead or hangs. One per replica.

    A death comes as a message (the host holds the pidfds). A hang is a node that was not seen alive for
    `HANG_DEADLINE_NS` when the host looked. The deadline only counts while this Watchdog itself runs on time:
    if its host looked late, the machine was stalled, and every node gets the whole deadline again; and what
    passes between a look and this step, in which the host may be preempted, does not count at all. That keeps
    a busy machine from a false failover. One suspicion per generation is enough.
    """

    def __init__(self) -> None:
        self.replica, self.generation = "", 0
        self.nodes: tuple[str, ...] = ()
        self.suspect: Suspect | None = None
        self._grace_until_ns = 0

    def open_ports(self) -> tuple[str, ...]:
        return _OPEN

    def quiescent(self) -> bool:
        return True

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        match msg:
            case Watch():
                self.replica, self.generation, self.nodes = msg.replica, msg.generation, msg.nodes
                self.suspect = None
                self._grace_until_ns = now_ns + HANG_DEADLINE_NS
                return []
            case NodeDied():
                return self._suspect(msg.node, Loss.CRASH, now_ns) if msg.node in self.nodes else []
            case SeenAlive():
                return self._judge(msg, now_ns)
            case Rebound():  # a new Recovery, which knows of no suspicion yet
                return [Send("wdg2rec", self.suspect)] if self.suspect and msg.bound else []
            case _:
                raise PeerError(f"{type(msg).__name__} on {port}")

    def _judge(self, seen: SeenAlive, now_ns: int) -> list[Effect]:
        at_ns = seen.at_ns
        if seen.late_ns > LATE_NS_MAX:
            self._grace_until_ns = at_ns + HANG_DEADLINE_NS
        if at_ns < self._grace_until_ns:
            return []
        for node in self.nodes:
            if at_ns - seen.seen_ns.get(node, at_ns) >= HANG_DEADLINE_NS:
                return self._suspect(node, Loss.HANG, now_ns)
        return []

    def _suspect(self, node: str, cause: Loss, now_ns: int) -> list[Effect]:
        if self.suspect is not None:
            return []
        self.suspect = Suspect(self.replica, self.generation, node, cause, now_ns)
        return [
            Send("wdg2rec", self.suspect),
            Note(Event.WATCHDOG_SUSPECT, detail=self.generation),
        ]


_ALARM_PORTS: Final = ("wdg2rec", "wdg2rec.b")
FAILURES_MAX: Final = 5  # scripts for a new backup that may fail in a row before Recovery gives up
RETRY_NS: Final = 50_000_000

Suspicions = Mapping[tuple[str, int], Loss]  # of a generation of a replica
Ports = tuple[tuple[str, str], ...]  # parts of the leader, each with its port to the same part of the backup


def failover(dead: str, backup: str, epoch: int) -> Script:
    """Fence, drain, promote, attach; the kill comes last, since a fenced replica can do no harm."""
    commit = (Fence(dead), Promote(backup, epoch), Attach(backup, epoch), Kill(dead))
    return Script("failover", dead, (), commit, kind=ScriptKind.FAILOVER)


def drop_backup(leader: str, backup: str, replication: Ports) -> Script:
    """The leader goes on alone."""
    unbinds = [Unbind(f"{leader}/{part}", port) for part, port in replication]
    commit: tuple[Step, ...] = (Fence(backup), *unbinds, Kill(backup))
    return Script("drop backup", backup, (), commit, kind=ScriptKind.DROP_BACKUP)


def new_backup(leader: str, replica: str, replication: Ports, stateful: tuple[str, ...]) -> Script:
    """State transfer at a quiescent point; all that is slow happens in `prepare`."""
    return Script(
        "new backup",
        replica,
        (Spawn(replica),),
        (
            Suspend(f"{leader}/protocol"),
            *(Transfer(f"{leader}/{part}", f"{replica}/{part}") for part in stateful),
            *(Bind(f"{leader}/{part}", port, f"{replica}/{part}") for part, port in replication),
            Resume(f"{leader}/protocol"),
        ),
        kind=ScriptKind.NEW_BACKUP,
    )


def decide(now: Situation, suspects: Suspicions) -> Script | None:
    """The script that the table of the module asks for, or None."""
    if not now.leader or not now.replication:
        return None
    of_leader = suspects.get((now.leader, now.leader_generation))
    of_backup = suspects.get((now.backup, now.backup_generation))
    if now.backup:
        last_hope = of_leader is Loss.CRASH and of_backup is Loss.HANG
        if of_backup and not last_hope:
            return drop_backup(now.leader, now.backup, now.replication)
        return failover(now.leader, now.backup, now.epoch + 1) if of_leader else None
    if now.vacant and of_leader is not Loss.CRASH:
        return new_backup(now.leader, now.vacant[0], now.replication, now.stateful)
    return None


class Recovery(Brick):
    """`ordered` is the script that the runtime is executing."""

    def __init__(self) -> None:
        self.situation: Situation | None = None
        self.suspects: dict[tuple[str, int], Loss] = {}
        self.ordered: Script | None = None
        self._failures = 0
        self._retry_ns: int | None = None

    def open_ports(self) -> tuple[str, ...]:
        return _ALARM_PORTS

    def quiescent(self) -> bool:
        return self.ordered is None

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        match msg:
            case Suspect():
                self.suspects[msg.replica, msg.generation] = msg.cause
                return self._order(now_ns)
            case Situation():
                return self._update(msg, now_ns)
            case Rebound():
                return []
            case _:
                raise PeerError(f"{type(msg).__name__} on {port}")

    def _update(self, msg: Situation, now_ns: int) -> list[Effect]:
        done, self.ordered, self.situation = self.ordered, None, msg
        present = ((msg.leader, msg.leader_generation), (msg.backup, msg.backup_generation))
        dead = {one: Loss.CRASH for one in present if one[0] in msg.lost}
        self.suspects = {one: self.suspects[one] for one in present if one in self.suspects} | dead
        self._failures = self._failures + 1 if msg.failed else 0
        notes: list[Effect] = []
        if done is not None and not msg.failed:
            event = Event.BACKUP_READY if done.kind is ScriptKind.NEW_BACKUP else Event.RECOVERY_EXIT
            notes.append(Note(event, detail=msg.epoch))
        if msg.failed and self._failures < FAILURES_MAX:
            self._retry_ns = now_ns + RETRY_NS
        return notes + self._order(now_ns)

    def _order(self, now_ns: int) -> list[Effect]:
        if self.ordered is not None or self.situation is None:
            return []
        script = decide(self.situation, self.suspects)
        if script is None:
            return []
        if script.kind is ScriptKind.NEW_BACKUP:
            if self._failures >= FAILURES_MAX or (self._retry_ns is not None and now_ns < self._retry_ns):
                return []
            self._retry_ns = None
            self.ordered = script
            return [Order(script)]
        self.ordered = script
        return [Order(script), Note(Event.RECOVERY_ENTER, detail=self.situation.epoch)]

    def deadline_ns(self) -> int | None:
        """When to try again after a script that failed."""
        return self._retry_ns if self.ordered is None else None

    def wake(self, now_ns: int) -> list[Effect]:
        self._retry_ns = None
        return self._order(now_ns)


WATCHDOG: Final = BrickKind(
    "watchdog",
    (),
    ("wdg2rec",),
    make=lambda setting: Watchdog(),
    events=(Emits(Event.WATCHDOG_SUSPECT),),
)
RECOVERY: Final = BrickKind(
    "recovery",
    ("wdg2rec", "wdg2rec.b"),
    (),
    ("wdg2rec", "wdg2rec.b"),
    make=lambda setting: Recovery(),
    events=(Emits(Event.RECOVERY_ENTER), Emits(Event.RECOVERY_EXIT), Emits(Event.BACKUP_READY)),
)

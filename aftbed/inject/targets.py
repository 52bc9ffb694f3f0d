"""What a fault can be aimed at in a given graph. Pure: used before a run starts, and in it.

Several bricks of a composed graph may emit the same event (each mechanism has a Before that passes on). The
outermost is meant.
"""

from typing import Final, NamedTuple, Protocol

from aftbed.core.errors import ConfigError, unknown
from aftbed.core.events import STEP_EVENTS, Event, event_named
from aftbed.core.graph import STAGED, BrickSpec, Graph
from aftbed.ftm.compose import build, expressions
from aftbed.ftm.registry import EMITTERS, Emitter, server_emits

PRIMARY, BACKUP = "primary", "backup"
ROLES: Final = (PRIMARY, BACKUP)
DEFAULT: Final = PRIMARY  # where a fault does not name its replica
OTHERS: Final = ("zygote", "zygote.bus", "hub", "vehicle", "player")
SUPERVISOR: Final = "supervisor"  # emits the events of the steps of an adaptation
ENGINE: Final = "engine"  # emits its other events
ADAPTATION: Final = tuple(event for event in Event if event.label.startswith("adapt."))
_OF_ENGINE: Final = dict.fromkeys(
    (event for event in ADAPTATION if event not in STEP_EVENTS), Emitter(ENGINE, of_backup=False)
)


class TargetProcess(Protocol):
    """A process of the run, as a fault finds it: see `runtime.interface.Process`."""

    name: str
    pid: int
    journal: str  # where it writes its records, "" for nowhere
    alive: bool

    def kill(self) -> bool:
        """SIGKILL."""
        ...

    def freeze(self, for_ms: int = 0) -> bool:
        """SIGSTOP; the cleanup process thaws it after `for_ms` if the supervisor does not."""
        ...

    def thaw(self) -> bool:
        """SIGCONT; whether it runs on."""
        ...

    def stopped(self) -> bool:
        """Whether it is seen stopped."""
        ...


class Roles(NamedTuple):
    """Which replica leads in `graph` and which one backs it up; "" for none."""

    graph: Graph
    leader: str
    backup: str

    def replica(self, target: str) -> str:
        """The replica that `target`, a role or a replica, means; "" where there is none now."""
        return {PRIMARY: self.leader, BACKUP: self.backup}.get(target, target)


def roles_in(graph: Graph) -> tuple[str, ...]:
    """The roles that there are: a single replica has no backup."""
    return ROLES if len(replicas(graph)) > 1 else ROLES[:1]


def replicas(graph: Graph) -> tuple[str, ...]:
    """The replicas that have a Server."""
    return tuple(b.replica for b in graph.bricks if b.replica is not None and b.part == "server")


def role_assignments(graph: Graph) -> list[Roles]:
    """The roles during a run: each replica may come to lead."""
    names = replicas(graph)
    return [Roles(graph, leader, next((r for r in names if r != leader), "")) for leader in names]


def possible_roles(target: str, graph: Graph) -> list[str]:
    """The roles that a replica can have during a run.

    Raises ConfigError where `target` is no replica or role.
    """
    allowed = (*roles_in(graph), *replicas(graph))
    if target not in allowed:
        raise unknown("replica", target, allowed)
    return [role for role in roles_in(graph) if target in (role, *replicas(graph))]


# -- checks ---------------------------------------------------------------------------------------


def check_process(target: str, event: str, graph: Graph) -> None:
    """Raise ConfigError unless `target` is a role, a node, or a process beside the graph, and `event` can
    happen.
    """
    if target not in (here := (*roles_in(graph), *graph.nodes, *OTHERS)):
        allowed = (*here, *_nodes(event, graph))
        if target not in allowed:
            raise unknown("target", target, allowed)
    check_event(event, graph)


def check_node(target: str, event: str, graph: Graph) -> None:
    """Raise ConfigError unless `target` is a role or a node, and `event` can happen."""
    allowed = (*roles_in(graph), *graph.nodes)
    if target not in allowed:
        raise unknown("target", target, allowed)
    check_event(event, graph)


def check_event(event: str, graph: Graph) -> None:
    """Raise ConfigError unless `event`, if there is one, is emitted in `graph`."""
    if not event:
        return
    label, emitted = event_named(event).label, events_in(graph)
    if label not in emitted:
        found = ", ".join(emitted)
        raise ConfigError(f"event {label!r} cannot trigger a fault under --ftm {graph.ftm} (one of: {found})")


def events_in(graph: Graph) -> list[str]:
    """The labels of the events that are emitted in `graph`, sorted."""
    roles = Roles(graph, "a", "b")
    found = {e.label for e in (*EMITTERS, *ADAPTATION) if emitting_node(roles, e.label) is not None}
    return sorted(found)


def _nodes(event: str, graph: Graph) -> tuple[str, ...]:
    """The nodes that can be named: during an adaptation, those of any mechanism, and those being prepared."""
    if not event or event_named(event) not in ADAPTATION:
        return ()
    others = (build(expression, graph.placement) for expression in expressions())
    nodes = dict.fromkeys(node for one in (graph, *others) for node in one.nodes)
    return (*nodes, *(f"{node}{STAGED}" for node in nodes))


# -- which brick emits an event, or sends on a channel --------------------------------------------


def emitting_node(roles: Roles, event: str) -> str | None:
    """The node that emits `event`, SUPERVISOR, or None where none does."""
    if event_named(event) in STEP_EVENTS:
        return SUPERVISOR if any(b.kind == ENGINE for b in roles.graph.bricks) else None
    brick = emitting_brick(roles, event)
    return None if brick is None else roles.graph.node_of(brick)


def emitting_brick(roles: Roles, event: str) -> str | None:
    """The brick that emits `event`; None where none does, or the supervisor."""
    found = _emitter_of(event_named(event))
    if found is None:
        return None
    part, of_backup = found
    role = BACKUP if of_backup else PRIMARY
    if part == "server" and not server_emits(roles.graph, event_named(event), backs_up=of_backup):
        return None
    replica = roles.replica(role)
    bricks = [b for b in roles.graph.bricks if _is(b, part) and b.replica in (None, replica)]
    outermost = min(bricks, key=_depth, default=None)
    return None if outermost is None else outermost.name


def emitting_brick_of(roles: Roles, event: str, replica: str) -> str | None:
    """The brick of `replica` that emits `event`; None where none does."""
    named = event_named(event)
    if replica not in replicas(roles.graph):
        return None
    if emitting_part(named) == "server":
        emits_it = server_emits(roles.graph, named, backs_up=replica != roles.leader)
        return f"{replica}/server" if emits_it else None
    brick = emitting_brick(roles, event)
    return brick if brick is not None and roles.graph.brick(brick).replica == replica else None


def emitting_part(event: Event) -> str:
    emitter = _emitter_of(event)
    assert emitter is not None, event
    return emitter.part


def _emitter_of(event: Event) -> Emitter | None:
    return EMITTERS.get(event) or _OF_ENGINE.get(event)


def emits(graph: Graph, event: Event, role: str) -> bool:
    """Whether a brick of the replica in `role` emits `event`."""
    emitter = _emitter_of(event)
    assert emitter is not None, event
    part, of_backup = emitter
    if part == "server":
        return server_emits(graph, event, backs_up=role == BACKUP)
    return (role == BACKUP) is of_backup and any(_is(brick, part) for brick in graph.bricks)


def emitters_in(graph: Graph, event: str, node: str) -> int:
    """How many bricks of `node` emit `event`, each for itself."""
    part = emitting_part(event_named(event))
    return sum(_is(graph.brick(name), part) for name in graph.nodes[node])


def sender(roles: Roles, channel: str, replica: str) -> str | None:
    """The brick of `replica` that sends on `channel`. A brick of no replica counts as the leader's."""
    graph = roles.graph
    replica_of = {brick.name: brick.replica or roles.leader for brick in graph.bricks}
    links = [k for k in graph.led_by(roles.leader).links if k.name == channel and not k.standby]
    found = [graph.brick(k.source) for k in links if replica_of[k.source] == replica]
    outermost = min(found, key=_depth, default=None)
    return None if outermost is None else outermost.name


def _is(brick: BrickSpec, part: str) -> bool:
    """Whether `part`, the name of a part or of a kind, means `brick`: `a/tr.before` is a Before."""
    return part in (brick.kind, brick.part.rpartition(".")[2])


def _depth(brick: BrickSpec) -> int:
    """The bricks of an inner mechanism carry its name before their own."""
    return brick.part.count(".")

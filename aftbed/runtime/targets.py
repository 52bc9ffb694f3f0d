"""Whom a fault can be aimed at, in a given graph. Pure: checked before a run starts, and in it.

The same event may be emitted by several bricks of a composed graph (each mechanism in it has a Before
that passes on): the outermost is meant.
"""

from typing import Final

from aftbed.core.errors import ConfigError, unknown
from aftbed.core.event import Event, event_named
from aftbed.core.fault import BIT_MAX, FLIPPED_AT, Fault
from aftbed.core.graph import BrickSpec, Graph
from aftbed.ftm.catalog import EMITTERS
from aftbed.ftm.mechanism import EXPRESSIONS, build

ROLES: Final = ("primary", "backup")
OTHERS: Final = ("zygote", "zygote.bus", "hub", "vehicle", "player")
STAGED: Final = "'"  # behind the name of a process that is to become that node, or was it before
SUPERVISOR: Final = "supervisor"  # emits what an adaptation comes through
ADAPTATION: Final = tuple(event for event in Event if event.label.startswith("adapt."))


def check(fault: Fault, graph: Graph) -> None:
    """Raise ConfigError, naming what is allowed, if `fault` cannot happen in `graph`."""
    if fault.trigger.nth < 1:
        raise ConfigError(f"nth {fault.trigger.nth}: the first occurrence is nth 1")
    if fault.flip is not None:
        _check_flip(fault, graph)
        return
    allowed = (*roles(graph), *_nodes(fault, graph), *OTHERS)
    if fault.target not in allowed:
        raise unknown("target", fault.target, allowed)
    if not fault.event:
        return
    event = event_named(fault.event)
    emitted = {e.label for e in (*EMITTERS, *ADAPTATION) if emitter(graph, e.label, "a", "b") is not None}
    if event.label not in emitted:
        found = ", ".join(sorted(emitted))
        raise ConfigError(
            f"event {event.label!r} cannot trigger a fault under --ftm {graph.ftm} (one of: {found})"
        )


def roles(graph: Graph) -> tuple[str, ...]:
    """The roles that there are: with one replica, nobody backs it up."""
    return ROLES if len(replicas(graph)) > 1 else ROLES[:1]


def replicas(graph: Graph) -> tuple[str, ...]:
    """The replicas that have a Server."""
    return tuple(b.replica for b in graph.bricks if b.replica is not None and b.part == "server")


def _nodes(fault: Fault, graph: Graph) -> tuple[str, ...]:
    """The nodes that can be named: while an adaptation is under way, those of any mechanism."""
    if not fault.event or event_named(fault.event) not in ADAPTATION:
        return tuple(graph.nodes)
    others = (build(expression, graph.placement) for expression in EXPRESSIONS)
    nodes = dict.fromkeys(node for one in (graph, *others) for node in one.nodes)
    return (*nodes, *(f"{node}{STAGED}" for node in nodes))


def _check_flip(fault: Fault, graph: Graph) -> None:
    assert fault.flip is not None
    place, bit = fault.flip.place, fault.flip.bit
    if bit is not None and not 0 <= bit <= BIT_MAX:
        raise ConfigError(f"bit {bit}: 0 to {BIT_MAX} are allowed")
    allowed = (*roles(graph), *replicas(graph))
    if fault.target not in allowed:
        raise unknown("replica", fault.target, allowed)
    event = event_named(fault.event).label
    standings = [role == "backup" for role in roles(graph) if fault.target in (role, *replicas(graph))]
    emitted = [e.label for e in FLIPPED_AT[place] for b in standings if _server_emits(graph, e, backs_up=b)]
    if not emitted:
        raise ConfigError(f"{fault}: under --ftm {graph.ftm} the Server of a {fault.target} executes nothing")
    if event not in emitted:
        raise unknown(f"event for a bit of the {place.value} in {fault.target}:", event, set(emitted))


def _server_emits(graph: Graph, event: Event, *, backs_up: bool) -> bool:
    """Whether the Server of a replica that leads, or `backs_up`, comes to `event`."""
    ports = {link.source_port for link in graph.links}
    executes = not backs_up or "bfr2bfr" in ports  # its Before gets what the leader's Before gets
    if event is Event.STATE_CAPTURED:
        return executes and bool(ports & {"aft2srv", "bfr2srv"})
    if event is Event.STATE_RESTORED:
        return backs_up and "aft2srv" in ports
    return executes


def emitter(graph: Graph, event: str, leader: str, backup: str) -> str | None:
    """The node that emits `event` while `leader` leads, SUPERVISOR, or None where nobody does."""
    named = event_named(event)
    if named in ADAPTATION:
        return SUPERVISOR if any(b.kind == "engine" for b in graph.bricks) else None
    brick = _emitting(graph, named, leader, backup)
    return None if brick is None else graph.node_of(brick.name)


def waits_in(fault: Fault, graph: Graph, leader: str, backup: str) -> str | None:
    """The brick in which `fault` waits for its event; None where nobody emits it, or the supervisor does."""
    event = event_named(fault.event)
    if fault.flip is None:
        brick = _emitting(graph, event, leader, backup)
        return None if brick is None else brick.name
    replica = {"primary": leader, "backup": backup}.get(fault.target, fault.target)
    if replica not in replicas(graph) or not _server_emits(graph, event, backs_up=replica != leader):
        return None
    return f"{replica}/server"


def emitters_in(graph: Graph, event: str, node: str) -> int:
    """How many bricks of `node` emit `event`, each for itself."""
    part, _ = EMITTERS[event_named(event)]
    return sum(_is(graph.brick(name), part) for name in graph.nodes[node])


def _emitting(graph: Graph, event: Event, leader: str, backup: str) -> BrickSpec | None:
    found = EMITTERS.get(event)
    if found is None:
        return None
    part, of_backup = found
    if part == "server" and not _server_emits(graph, event, backs_up=of_backup):
        return None
    replica = backup if of_backup else leader
    bricks = [b for b in graph.bricks if _is(b, part) and b.replica in (None, replica)]
    return min(bricks, key=_depth, default=None)


def _is(brick: BrickSpec, part: str) -> bool:
    """Whether `part`, the name of a part or of a kind, means `brick`: `a/tr.before` is a Before."""
    return part in (brick.kind, brick.part.rpartition(".")[2])


def _depth(brick: BrickSpec) -> int:
    """The bricks of an inner mechanism carry its name before their own."""
    return brick.part.count(".")

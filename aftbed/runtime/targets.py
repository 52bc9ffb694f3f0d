"""Whom a fault can be aimed at, in a given graph. Pure: checked before a run starts, and in it.

The same event may be emitted by several bricks of a composed graph (each mechanism in it has a Before
that passes on): the outermost is meant.
"""

from typing import Final

from aftbed.core.application import fields_of
from aftbed.core.busfault import BusFault
from aftbed.core.errors import ConfigError, unknown
from aftbed.core.events import Event, event_named
from aftbed.core.fault import SHARE_MAX, SHARE_MIN, SLOW_MS_MAX, Disturb, Fault, FlipMemory, Slow
from aftbed.core.graph import BrickSpec, Graph
from aftbed.core.units import DURATION_MS_MAX
from aftbed.core.valuefault import (
    BIT_MAX,
    BITS_MAX,
    FLIPPED_AT,
    Bit,
    Bits,
    Burst,
    Byte,
    Flip,
    Pattern,
    Stuck,
)
from aftbed.ftm.compose import EXPRESSIONS, build
from aftbed.ftm.registry import EMITTERS, server_emits
from aftbed.runtime.cell import check_field
from aftbed.vehicle.aeb.function import AebFunction

ROLES: Final = ("primary", "backup")
OTHERS: Final = ("zygote", "zygote.bus", "hub", "vehicle", "player")
STAGED: Final = "'"  # behind the name of a process that is to become that node, or was it before
SUPERVISOR: Final = "supervisor"  # emits what an adaptation comes through
ADAPTATION: Final = tuple(event for event in Event if event.label.startswith("adapt."))


def check(fault: Fault, graph: Graph) -> None:
    """Raise ConfigError, naming what is allowed, if `fault` cannot happen in `graph`."""
    if fault.trigger.nth < 1:
        raise ConfigError(f"nth {fault.trigger.nth}: the first occurrence is nth 1")
    if isinstance(fault.action, BusFault):  # it names what is on the bus, not in the graph
        return
    if isinstance(fault.action, Flip):
        if fault.action.field:
            _check_field(fault, fault.action, graph)
        else:
            _check_flip(fault, fault.action, graph)
        return
    if isinstance(fault.action, Disturb):
        _check_channel(fault, fault.action, graph)
        return
    allowed: tuple[str, ...] = (*roles(graph), *_nodes(fault, graph), *OTHERS)
    if isinstance(fault.action, Slow):
        allowed = (*roles(graph), *graph.nodes)  # it is their bricks' steps that are slow
        _check_slow(fault.action)
    if isinstance(fault.action, FlipMemory):
        allowed = (*roles(graph), *graph.nodes)
    if fault.target not in allowed:
        raise unknown("target", fault.target, allowed)
    _check_event(fault, graph)


def _check_slow(slow: Slow) -> None:
    if slow.share is not None:
        if not SHARE_MIN <= slow.share <= SHARE_MAX:
            limits = f"{SHARE_MIN:.0%} to {SHARE_MAX:.0%} of a CPU are allowed"
            raise ConfigError(f"share {slow.share:.3%}: {limits}")
    elif not 0 < slow.by_ms <= SLOW_MS_MAX:
        raise ConfigError(f"by {slow.by_ms:g}ms: up to {SLOW_MS_MAX:g}ms are allowed")


def _check_event(fault: Fault, graph: Graph) -> None:
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


def _check_flip(fault: Fault, flip: Flip, graph: Graph) -> None:
    _check_pattern(flip.pattern)
    place = flip.place
    event = event_named(fault.event).label
    emitted = {
        e.label for e in FLIPPED_AT[place] for b in _standings(fault, graph) if _emits(graph, e, backs_up=b)
    }
    if not emitted:
        executes = f"the Server of a {fault.target} executes nothing"
        nothing = (
            executes if all(_part(e) == "server" for e in FLIPPED_AT[place]) else f"{fault.target} has none"
        )
        raise ConfigError(f"{fault}: under --ftm {graph.ftm} {nothing}")
    if event not in emitted:
        raise unknown(f"event for a bit of the {place.value} in {fault.target}:", event, emitted)


def _check_field(fault: Fault, flip: Flip, graph: Graph) -> None:
    """What a function that was written off line declares is known in its node."""
    _check_pattern(flip.pattern)
    _standings(fault, graph)
    _check_event(fault, graph)
    if not any(brick.application for brick in graph.bricks):
        check_field(flip, fields_of(AebFunction))


def _check_pattern(pattern: Pattern) -> None:
    match pattern:
        case Bit(at) | Burst(_, at) if at is not None and not 0 <= at <= BIT_MAX:
            raise ConfigError(f"bit {at}: 0 to {BIT_MAX} are allowed")
        case Byte(at) if at is not None and not 0 <= at <= BIT_MAX // 8:
            raise ConfigError(f"byte {at}: 0 to {BIT_MAX // 8} are allowed")
        case Bits(count) | Burst(count, _) if not 1 <= count <= BITS_MAX:
            raise ConfigError(f"{count} bits: 1 to {BITS_MAX} are allowed")
        case Stuck(at, value) if not 0 <= at <= BIT_MAX or value not in (0, 1):
            raise ConfigError(f"stuck {at}={value}: a bit from 0 to {BIT_MAX}, and 0 or 1, are allowed")
        case _:
            return


def _check_channel(fault: Fault, action: Disturb, graph: Graph) -> None:
    channels = {link.name for link in graph.links}
    if action.channel not in channels:
        raise unknown("channel", action.channel, channels)
    if not 0 < action.by_ms <= DURATION_MS_MAX:
        raise ConfigError(f"by {action.by_ms:g}ms: up to {DURATION_MS_MAX}ms are allowed")
    _standings(fault, graph)
    leads = [(leader, _meant(fault.target, leader, _other(graph, leader))) for leader in replicas(graph)]
    if all(sender(graph, action.channel, meant, leader) is None for leader, meant in leads):
        raise ConfigError(
            f"{fault}: under --ftm {graph.ftm} {fault.target} sends nothing on {action.channel}"
        )


def _standings(fault: Fault, graph: Graph) -> list[bool]:
    """Whether the replica that is meant backs up: over a run, it may do both. Raises ConfigError."""
    allowed = (*roles(graph), *replicas(graph))
    if fault.target not in allowed:
        raise unknown("replica", fault.target, allowed)
    return [role == "backup" for role in roles(graph) if fault.target in (role, *replicas(graph))]


def _meant(target: str, leader: str, backup: str) -> str:
    """The replica that `target` means, or `""` if there is none now."""
    return {"primary": leader, "backup": backup}.get(target, target)


def _other(graph: Graph, replica: str) -> str:
    return next((r for r in replicas(graph) if r != replica), "")


def _part(event: Event) -> str:
    return EMITTERS[event][0]


def _emits(graph: Graph, event: Event, *, backs_up: bool) -> bool:
    """Whether a replica that leads, or `backs_up`, comes to `event`."""
    part, of_backup = EMITTERS[event]
    if part == "server":
        return server_emits(graph, event, backs_up=backs_up)
    return backs_up is of_backup and any(_is(brick, part) for brick in graph.bricks)


def sender(graph: Graph, channel: str, replica: str, leader: str) -> str | None:
    """The brick of `replica` that sends on `channel` while `leader` leads; who is of none is the leader's."""
    kin = {brick.name: brick.replica or leader for brick in graph.bricks}
    links = [k for k in graph.led_by(leader).links if k.name == channel and not k.standby]
    found = [graph.brick(k.source) for k in links if kin[k.source] == replica]
    first = min(found, key=_depth, default=None)
    return None if first is None else first.name


def emitter(graph: Graph, event: str, leader: str, backup: str) -> str | None:
    """The node that emits `event` while `leader` leads, SUPERVISOR, or None where nobody does."""
    named = event_named(event)
    if named in ADAPTATION:
        return SUPERVISOR if any(b.kind == "engine" for b in graph.bricks) else None
    brick = _emitting(graph, named, leader, backup)
    return None if brick is None else graph.node_of(brick.name)


def waits_in(fault: Fault, graph: Graph, leader: str, backup: str) -> str | None:
    """The brick in which `fault` waits; None where nobody comes to its point, or the supervisor does."""
    replica = _meant(fault.target, leader, backup)
    if isinstance(fault.action, Disturb):
        return sender(graph, fault.action.channel, replica, leader)
    event = event_named(fault.event)
    if not isinstance(fault.action, Flip) or fault.action.field:
        brick = _emitting(graph, event, leader, backup)
        return None if brick is None else brick.name
    if replica not in replicas(graph):
        return None
    if _part(event) == "server":
        return f"{replica}/server" if server_emits(graph, event, backs_up=replica != leader) else None
    brick = _emitting(graph, event, leader, backup)
    return brick.name if brick is not None and brick.replica == replica else None


def emitters_in(graph: Graph, event: str, node: str) -> int:
    """How many bricks of `node` emit `event`, each for itself."""
    part, _ = EMITTERS[event_named(event)]
    return sum(_is(graph.brick(name), part) for name in graph.nodes[node])


def _emitting(graph: Graph, event: Event, leader: str, backup: str) -> BrickSpec | None:
    found = EMITTERS.get(event)
    if found is None:
        return None
    part, of_backup = found
    if part == "server" and not server_emits(graph, event, backs_up=of_backup):
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

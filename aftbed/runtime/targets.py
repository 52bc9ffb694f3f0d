"""Whom a fault can be aimed at, in a given graph. Pure: checked before a run starts, and in it."""

from typing import Final

from aftbed.core.errors import ConfigError, unknown
from aftbed.core.event import Event, event_named
from aftbed.core.fault import Fault
from aftbed.core.graph import Graph
from aftbed.ftm.catalog import EMITTERS

ROLES: Final = ("primary", "backup")
STATE_ACCESS: Final = (Event.STATE_CAPTURED, Event.STATE_RESTORED)
OTHERS: Final = ("zygote", "zygote.bus", "hub", "vehicle", "player")


def check(fault: Fault, graph: Graph) -> None:
    """Raise ConfigError, naming what is allowed, if `fault` cannot happen in `graph`."""
    roles = ROLES if "b/after" in {b.name for b in graph.bricks} else ROLES[:1]
    if fault.target not in (*roles, *graph.nodes, *OTHERS):
        raise unknown("target", fault.target, (*roles, *graph.nodes, *OTHERS))
    trigger = fault.trigger
    if trigger.nth < 1:
        raise ConfigError(f"nth {trigger.nth}: the first occurrence is nth 1")
    if not trigger.event:
        return
    event = event_named(trigger.event)
    emitted = {e.label for e in EMITTERS if emitter(graph, e.label, "a", "b") is not None}
    if event.label not in emitted:
        allowed = ", ".join(sorted(emitted))
        raise ConfigError(
            f"event {event.label!r} cannot trigger a fault under --ftm {graph.ftm} (one of: {allowed})"
        )


def emitter(graph: Graph, event: str, leader: str, backup: str) -> str | None:
    """The node that emits `event` while `leader` leads, or None where nobody does."""
    found = EMITTERS.get(event_named(event))
    if found is None:
        return None
    part, of_backup = found
    if event_named(event) in STATE_ACCESS and not any(k.source_port == "aft2srv" for k in graph.links):
        return None  # nobody asks this Server for its state
    for brick in graph.bricks:
        if brick.part == part and brick.replica in (None, backup if of_backup else leader):
            return graph.node_of(brick.name)
    return None

"""How long a mechanism may take to handle a fault, at most: a bound of the FHTI.

The bound is a sum over what happens between the fault and the next good reply. Its terms are deadlines of
the code (`HANG_DEADLINE_NS`, `LOOK_NS`), the steps of the scripts that Recovery orders (`ftm.failover`), the
channels that a request passes (`ftm.compose.path`), and the greatest delay of each of these as it was
measured (`runtime.latencies`). So a script with one step more, or a mechanism with one brick more, has
another bound.

| fault | detection | reaction |
|---|---|---|
| crash of the leader | the signal, the notice of the death | failover, then a whole request |
| hang of the leader | the hang deadline, and a look | failover, then a whole request |
| hang that ends before | none | its length, then a whole request |
| crash or hang of the backup | as of the leader | the backup is fenced, then a whole request |
| crash of a Watchdog, Recovery, the Engine | the notice of the death at the supervisor | a whole request |
| value that is outvoted | within the request | the rest of the request, and one execution more |
| value that stops the replica | within the request | as of a crash |
| supervised step that is skipped | the deadline of the supervision | as of a crash |
| supervised step that is done twice | the reply to the next request | as of a crash |

In reality the machine stops a process now and then, for longer than any step takes. One such stop of
`STALL_NS` is allowed for each handling; the harness calls a machine quiet whose wakes are later by no more.

Limits: one fault of any kind in a run without adaptations, in a graph with its redundancy, aimed at a replica
in the role that it begins with; the built-in function, whose execution is part of the hop to it. There is no
bound where the injector holds a node that serves until it has struck another one (an event of the leader, a
crash of the backup), for the replacement of Client and Proxy, whose births take what the machine lets them,
nor for faults that the mechanism does not handle. A fault of the bus has a bound of its own (`bus_bound`).
"""

import itertools
from collections.abc import Iterable
from functools import lru_cache
from typing import Final

from aftbed.core import script
from aftbed.core.events import Event
from aftbed.core.graph import Graph
from aftbed.core.script import Script
from aftbed.ftm.compose import REPLICAS, build, parse, path, replication_of
from aftbed.ftm.failover import HANG_DEADLINE_NS, failover
from aftbed.ftm.registry import MECHANISMS
from aftbed.ftm.supervision import DEADLINE_NS, SUP
from aftbed.inject.channel import ChannelFault, Disturbance
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import ONCE
from aftbed.inject.hang import Hang
from aftbed.inject.kind import AnyFault, FaultKind
from aftbed.inject.targets import PRIMARY, Roles, emitting_brick, sender
from aftbed.inject.value import EXECUTED, ValueFlip, ValuePlace
from aftbed.runtime.deployment import replica_of
from aftbed.runtime.devices import LOOK_IDLE_NS, LOOK_NS
from aftbed.runtime.latencies import (
    COLD_PENALTY_NS,
    FIRST_NS,
    HOP_QUANTILES_NS,
    LIFELINE_NS,
    LINE_NS,
    PIDFD_NS,
    ROUSED_NS,
    SIGNAL_NS,
)

STALL_NS: Final = 5_000_000  # of a quiet machine, once: a process that could run does not
HOP_NS: Final = HOP_QUANTILES_NS[-2] + COLD_PENALTY_NS[1]  # to an idle brick; the last is the machine's
ORDER_NS: Final = LINE_NS[1] + FIRST_NS[1]  # from the supervisor to a process
REPORT_NS: Final = LINE_NS[1] + ROUSED_NS[1]  # from a process to the supervisor, which sleeps
SUPPORT: Final = ("recovery", "engine", *(f"{replica}/watchdog" for replica in REPLICAS))  # none serves
LEADER, FOLLOWER = REPLICAS
TRIAL: Final = "tr.after"  # asks for one execution more
SUPERVISION: Final = (SUP.before.name, SUP.after.name)
WAKE_NS: Final = 1_000_000  # a host that polls wakes a brick at the next whole millisecond


def fhti_bound(ftm: str, kind: type[FaultKind], placement: str = "process") -> float | None:
    """In ms, of a fault of `kind` that strikes the leader while a request waits, on real processes.

    None: the mechanism does not handle it, or there is no bound for it.
    """
    if issubclass(kind, ValueFlip):
        return bound_ms(ftm, placement, AnyFault(kind(ValuePlace.RESULT), PRIMARY))
    return bound_ms(ftm, placement, AnyFault(kind(), PRIMARY)) if issubclass(kind, Crash | Hang) else None


def bound_ms(
    ftm: str, placement: str, fault: AnyFault, *, period_ms: float = 0.0, simulated: bool = False
) -> float | None:
    """In ms, of `fault` in a run of `ftm`. `period_ms`: until the next request, where none waits.

    None: the mechanism does not handle it, or there is no bound for it.
    """
    graph = build(ftm, placement)
    stall_ns = 0 if simulated else STALL_NS
    match fault.action:
        case Crash() | Hang():
            found = _of_stop(graph, fault, round(period_ms * 1e6), stall_ns)
        case ValueFlip(place) if place in EXECUTED and fault.event == Event.SERVER_EXIT.label:
            found = _of_value(graph, fault)
        case ChannelFault(how, channel) if fault.persistence == ONCE:
            found = _of_step(graph, how, channel, fault.target, round(period_ms * 1e6))
        case _:
            found = None
    return None if found is None else (found + stall_ns) / 1e6


# -- faults that stop a process -------------------------------------------------------------------


def _of_stop(graph: Graph, fault: AnyFault, period_ns: int, stall_ns: int) -> int | None:
    """Of a crash or a hang; a stop of the machine may make a hang longer."""
    target, action = fault.target, fault.action
    if target in SUPPORT and not fault.event:
        seen_ns = SIGNAL_NS[1] + PIDFD_NS[1]
        return seen_ns + period_ns + request_ns(graph) if isinstance(action, Crash) else None
    roles = Roles(graph, LEADER, FOLLOWER)
    replica = replica_of(target) or roles.replica(target)
    emitter = emitting_brick(roles, fault.event) if fault.event else None
    if emitter is not None and replica_of(emitter) != replica:
        return None
    if replica not in REPLICAS or not replication_of(graph.ftm) or graph.placement == "single":
        return None
    ends_ns = action.lasts_ms * 1_000_000
    if ends_ns and ends_ns < HANG_DEADLINE_NS - LOOK_NS:  # no Watchdog sees it
        noticed = _supervised(graph) and ends_ns + stall_ns >= DEADLINE_NS
        stop_ns = detection_ns(Crash()) + failover_ns(graph) if noticed else 0
        return ends_ns + stop_ns + period_ns + request_ns(graph)
    reaction_ns = failover_ns(graph) if replica == LEADER else _fence_ns(failover(FOLLOWER, LEADER, 0))
    return detection_ns(action, period_ns) + reaction_ns + period_ns + request_ns(graph)


def detection_ns(action: FaultKind, period_ns: int = 0) -> int:
    """From a stop of a replica to the suspicion. A Watchdog looks less often at a replica without work."""
    if isinstance(action, Hang):
        return HANG_DEADLINE_NS + (LOOK_NS if period_ns <= LOOK_NS else LOOK_IDLE_NS)
    return SIGNAL_NS[1] + LIFELINE_NS[1]


def failover_ns(graph: Graph) -> int:
    """From the suspicion until the backup leads and the Proxy follows it."""
    takes_over = replication_of(graph.ftm)[0][0]  # the part that receives from the leader
    chain = path(graph, FOLLOWER)
    begin = chain.index(f"{FOLLOWER}/{takes_over}")
    end = chain.index(f"{FOLLOWER}/protocol", begin)
    handed_on = [name for name in chain[begin : end + 1] if name != f"{FOLLOWER}/server"]
    last_checkpoint = 2  # hops, to the Server and back, before the end of the channel is seen
    return _fence_ns(failover(LEADER, FOLLOWER, 2)) + (_hops(graph, handed_on) + last_checkpoint) * HOP_NS


def _fence_ns(ordered: Script) -> int:
    """From the suspicion to the end of the steps that the service waits for."""
    return HOP_NS + REPORT_NS + sum(_orders(step) for step in _waited_for(ordered)) * ORDER_NS


def _waited_for(ordered: Script) -> Iterable[script.Step]:
    """Up to Attach: what comes behind it is done while the new leader serves."""
    for step in (*ordered.prepare, *ordered.commit):
        yield step
        if isinstance(step, script.Attach):
            return


def _orders(step: script.Step) -> int:
    """How many orders, one after the other, the step is."""
    match step:
        case script.Fence() | script.Kill() | script.Unbind():
            return 0  # done by the supervisor, or while requests are served
        case script.Promote() | script.Attach():
            return 1
        case _:
            raise AssertionError(f"{type(step).__name__} in a failover: how long does it take?")


# -- faults that supervision sees -----------------------------------------------------------------


def _supervised(graph: Graph) -> list[str]:
    """The bricks of the leader between which steps are supervised, in the order of a request; [] for none,
    and where no other replica can take over.
    """
    if graph.placement == "single" or not replication_of(graph.ftm):
        return []
    way = path(graph, LEADER)
    ends = [way.index(b.name) for b in graph.bricks if b.replica == LEADER and b.kind in SUPERVISION]
    return way[min(ends) : max(ends) + 1] if ends else []


def _of_step(graph: Graph, how: Disturbance, channel: str, target: str, period_ns: int) -> int | None:
    """Of a message that is lost or doubled between two supervised bricks."""
    roles, inside = Roles(graph, LEADER, FOLLOWER), _supervised(graph)
    source = sender(roles, channel, LEADER)
    sinks = [link.sink for link in graph.links if (link.source, link.name) == (source, channel)]
    if roles.replica(target) != LEADER or not {source, *sinks} <= {*inside}:
        return None
    replaced_ns = detection_ns(Crash()) + failover_ns(graph) + request_ns(graph)
    match how:
        case Disturbance.OMISSION:
            return HOP_NS + DEADLINE_NS + WAKE_NS + replaced_ns
        case Disturbance.DUPLICATE:
            return request_ns(graph) + period_ns + request_ns(graph) + replaced_ns
        case _:
            return None


# -- faults of a value ----------------------------------------------------------------------------


def _of_value(graph: Graph, fault: AnyFault) -> int | None:
    """Of a result or a state that one execution has left wrong.

    One that lasts may be the same in each execution, so that no vote sees it.
    """
    suits = [MECHANISMS[name].suitability for name in parse(graph.ftm)]
    whole_ns = request_ns(graph)
    if fault.persistence != ONCE:
        return None
    if any("value" in one.tolerates for one in suits):
        return whole_ns + _third_ns(graph)
    stops = any("implausible" in one.detects for one in suits)
    if stops and replication_of(graph.ftm) and graph.placement != "single":
        return whole_ns + detection_ns(Crash()) + failover_ns(graph) + whole_ns
    return None


def _third_ns(graph: Graph) -> int:
    """One execution more, where a mechanism asks for it: to Proceed, the Server, and back."""
    voters = [b.name for b in graph.bricks if b.replica == LEADER and b.kind == TRIAL]
    if not voters:
        return 0
    after = voters[0]
    proceed = f"{after.removesuffix('after')}proceed"
    return _hops(graph, [after, proceed, f"{LEADER}/server", proceed, after]) * HOP_NS


# -- requests -------------------------------------------------------------------------------------


@lru_cache(maxsize=64)
def _request_hops(ftm: str, placement: str) -> int:
    graph = build(ftm, placement)
    return _hops(graph, path(graph, FOLLOWER if replication_of(ftm) else LEADER))


def request_ns(graph: Graph) -> int:
    """A whole request, from the client and back."""
    return _request_hops(graph.ftm, graph.placement) * HOP_NS


def _hops(graph: Graph, bricks: list[str]) -> int:
    """Messages between nodes on the way through `bricks`."""
    return sum(a != b for a, b in itertools.pairwise(map(graph.node_of, bricks)))

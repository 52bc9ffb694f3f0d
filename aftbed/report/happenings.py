"""What of a run a space-time diagram shows: which happenings, at which place, on which rows, in which words.

A run has thousands of messages, and most of them are like those before. So only what lies around a *turning
point* is kept: a fault, an alarm, a step of a failover, the begin and the end of an adaptation. Each has a
place of its own on the axis, and a longer wait takes more room, but by its logarithm, for a hop takes 10 us
and a hang 50 ms.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Final, NamedTuple

from aftbed.core.events import FIRST_FAULT, REQUEST_EVENTS, STEP_EVENTS, TURNING_POINTS, Event
from aftbed.core.journal import Record
from aftbed.core.messages import Message
from aftbed.ftm.compose import build
from aftbed.inject.receipts import fault_and_bits
from aftbed.report import sequence
from aftbed.runtime.sim.trace import STRUCK, Happening, Sent, Told, Trace

BEFORE, AFTER = 14, 30  # happenings around a turning point
KEPT_MAX: Final = 330  # happenings of a diagram
EXECUTIVE: Final = sequence.EXECUTIVE
GAP_PX: Final = 98.0
WAIT_NS, WAIT_PX = 30_000, 14.0  # a longer one takes so much more room for each power of ten
LEFT: Final = 14.0


class Placed(NamedTuple):
    """A happening at `x`, and how many were left out before it, over how long."""

    x: float
    one: Happening
    skipped: int
    skipped_ns: int


# -- what is drawn --------------------------------------------------------------------------------


def _turns(one: Happening) -> bool:
    match one:
        case Told(event=event):
            return event == STRUCK
        case Record(event=event):
            return event in TURNING_POINTS
        case _:
            return False


def kept_of(happened: Sequence[Happening]) -> list[int]:
    """The places of what is drawn, in order."""
    turns = [at for at, one in enumerate(happened) if _turns(one)] or [len(happened) - 1]
    found: set[int] = set()
    for turn in turns:
        around = range(max(0, turn - BEFORE), min(len(happened), turn + AFTER + 1))
        if len(found | set(around)) > KEPT_MAX:
            break
        found |= set(around)
    return sorted(found)


def placed_of(happened: Sequence[Happening], kept: Sequence[int]) -> Iterator[Placed]:
    x, before = LEFT, kept[0] - 1 if kept else -1
    for at in kept:
        one = happened[at]
        skipped, waited_ns = at - before - 1, one.t_ns - happened[max(before, 0)].t_ns
        x += GAP_PX if skipped else _stretch(waited_ns)
        yield Placed(x, one, skipped, waited_ns)
        x += _room(one)
        before = at


def _room(one: Happening) -> float:
    match one:
        case Sent():
            return 16.0
        case Record(event=event):
            return 3.0 if event in REQUEST_EVENTS else 9.0
        case Told():
            return 9.0
        case _:
            return 0.0


def _stretch(waited_ns: int) -> float:
    return WAIT_PX * math.log10(waited_ns / WAIT_NS) if waited_ns > WAIT_NS else 0.0


# -- rows -----------------------------------------------------------------------------------------


def rows_of(trace: Trace, shown: Iterable[Happening]) -> dict[str, int]:
    """The number of each node that has a part: the client's side, the replicas, the executive."""
    hosts = hosts_of(trace)
    order = {part: place for place, part in enumerate(_parts(trace, hosts))}
    names = dict.fromkeys(node for one in shown for node in nodes_of(one, hosts))

    def key(name: str) -> tuple[int, str, int]:
        replica, slash, part = name.rpartition("/")
        if name in ("client", "proxy"):
            return 0, "", ("client", "proxy").index(name)
        if slash or name in ("a", "b"):
            return 1, replica or name, order.get(part.rstrip("'"), len(order))
        return 2, "", 1 if name == EXECUTIVE else 0

    return {name: place for place, name in enumerate(sorted(names, key=key))}


def _parts(trace: Trace, hosts: dict[str, str]) -> dict[str, None]:
    """The parts of a replica in the order in which a request comes to them."""
    names = (node for one in trace.happened for node in nodes_of(one, hosts))
    return dict.fromkeys(name.rpartition("/")[2] for name in names)


def nodes_of(one: Happening, hosts: dict[str, str]) -> list[str]:
    match one:
        case Sent():
            return [hosts.get(one.source, one.source), hosts.get(one.sink, one.sink)]
        case Record():
            return [one.node]
        case Told(event=event, text=text):
            return [text if event == STRUCK else EXECUTIVE]
        case _:
            return []


def hosts_of(trace: Trace) -> dict[str, str]:
    """Which node hosts which brick: of the mechanism at the start, and of those that came."""
    setup = trace.run.setup
    later = [adaptation.ftm for adaptation in trace.run.adaptations]
    graphs = [trace.run.rest.graph, *(build(ftm, setup.placement) for ftm in (*later, setup.ftm))]
    return {brick: node for graph in graphs for node, bricks in graph.nodes.items() for brick in bricks}


# -- words ----------------------------------------------------------------------------------------


def said(one: Record | Told, trace: Trace) -> str:
    """A mark in words; a fault in its own."""
    if isinstance(one, Told):
        return f"{one.text} was hit" if one.event == STRUCK else f"{one.event}: {one.text}"
    faults, at = trace.run.setup.faults, fault_and_bits(one.detail)[0] - FIRST_FAULT
    if one.event is Event.FAULT_APPLIED:
        return str(faults[at])
    words = [str(one.event), *([f"#{one.request_id}"] if one.request_id else [])]
    return " ".join([*words, *([str(one.detail)] if one.detail and one.event in STEP_EVENTS else [])])


def class_of(one: Record | Told) -> str:
    if isinstance(one, Told):
        return "fault" if one.event == STRUCK else "adapt" if one.event.startswith("adapt") else "told"
    if one.event is Event.FAULT_APPLIED:
        return "fault"
    if one.event in (Event.DETECTED_STOP, Event.FOLLOWER_DIVERGED):
        return "fault"
    return "adapt" if str(one.event).startswith("adapt") else "told"


def struck(one: Happening) -> str:
    """The node that was hit, or ""."""
    return one.text if isinstance(one, Told) and one.event == STRUCK else ""


def kind_of(message: Message) -> str:
    return message.TRAFFIC.value

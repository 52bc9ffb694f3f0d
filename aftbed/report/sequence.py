"""What happened last before a promise was broken: as a listing, and as a sequence diagram.

A breach has no time of its own: the checkers look at a whole history. One that names a request is shown up to
the last that happened to this request; any other, up to the end of the run.

The diagram is Mermaid's `sequenceDiagram`: nodes are its participants, messages its arrows; faults, and what
the executive said, are its notes. What every request brings, such as `request.received`, is in the listing
only: the arrows show it.
"""

import re
from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple, assert_never

from aftbed.core.events import FIRST_FAULT, REQUEST_EVENTS, Event
from aftbed.core.journal import Entry, Record
from aftbed.ftm.compose import build
from aftbed.inject.model import Fault
from aftbed.inject.receipts import fault_and_bits
from aftbed.judge.verdict import Breach
from aftbed.runtime.sim.trace import STRUCK, Happening, Sent, Told, Trace, brief, digest, milliseconds

LAST: Final = 40  # lines of a listing; arrows and notes of a diagram
EXECUTIVE: Final = "supervisor"
_REQUEST: Final = re.compile(r"\brequest (\d+)")
_ESCAPED: Final = re.compile(r"[^A-Za-z0-9 _.,:'/()=+*-]|\b[Ee](?=[Nn][Dd]\b)")  # `end` would end a block


class _Drawn(NamedTuple):
    """An arrow from the first node to the second (`sink`), or a note over the first; "" is the executive."""

    t_ns: int
    node: str
    sink: str
    words: str


def text(trace: Trace, broken: Sequence[Breach] = (), last: int = LAST) -> str:
    """The last lines before the first of `broken` (without one: of the run), with virtual time in ms."""
    faults = trace.run.setup.faults
    rows = [_row(one, faults) for one in _before(trace.happened, broken)[-last:]]
    widths = [max((len(row[at]) for row in rows), default=0) for at in range(3)]
    found = [
        f"{time:>{widths[0]}} ms  {where:<{widths[1]}}  {how:<{widths[2]}}  {what}".rstrip()
        for time, where, how, what in rows
    ]
    return "".join(f"{line}\n" for line in (*found, *(f"broken: {breach}" for breach in broken)))


def mermaid(trace: Trace, broken: Sequence[Breach] = (), last: int = LAST) -> str:
    """The same as a Mermaid sequence diagram, without what every request brings."""
    nodes, faults = _nodes(trace), trace.run.setup.faults
    drawn = [d for one in _before(trace.happened, broken) for d in _draw(one, nodes, faults)][-last:]
    names = dict.fromkeys(name for d in drawn for name in (d.node, d.sink) if name)
    aliases = {name: f"p{number}" for number, name in enumerate(names or (EXECUTIVE,))}
    everybody = ",".join(dict.fromkeys((next(iter(aliases.values())), list(aliases.values())[-1])))
    found = [f"participant {alias} as {escaped(name)}" for name, alias in aliases.items()]
    for t_ns, node, sink, words in drawn:
        said = escaped(f"{milliseconds(t_ns):.3f} ms: {words}")
        if sink:
            found.append(f"{aliases[node]}->>{aliases[sink]}: {said}")
        else:
            found.append(f"Note over {aliases.get(node, everybody)}: {said}")
    found += [f"Note over {everybody}: {escaped(f'broken: {breach}')}" for breach in broken]
    return "".join(f"{line}\n" for line in ("sequenceDiagram", *(f"    {line}" for line in found)))


def escaped(words: str) -> str:
    """`words` with whatever could mean something to Mermaid as the code of the character."""
    return _ESCAPED.sub(lambda found: f"#{ord(found[0])};", words)


def _before(happened: Iterable[Happening], broken: Sequence[Breach]) -> list[Happening]:
    """All up to the last that concerns the request that is named, if one is."""
    found = list(happened)
    named = _REQUEST.search(broken[0].reason) if broken else None
    if named is None:
        return found
    request_id = int(named[1])
    last = max((at for at, one in enumerate(found) if _request_of(one) == request_id), default=len(found) - 1)
    return found[: last + 1]


def _request_of(one: Happening) -> int:
    """0 for none."""
    carrier = one.message if isinstance(one, Sent) else one
    found = getattr(carrier, "request_id", 0)
    assert isinstance(found, int)
    return found


def _row(one: Happening, faults: Sequence[Fault]) -> tuple[str, str, str, str]:
    """Time, where, how and what."""
    time = f"{milliseconds(one.t_ns):.3f}"
    match one:
        case Sent():
            return time, one.source, f"{one.port} -> {one.sink}", brief(one.message)
        case Record():
            return time, one.node, "*", _noted(one, faults)
        case Entry():
            return time, "client", one.kind.name.lower(), f"#{one.request_id} {digest(one.payload)}"
        case Told():
            return time, EXECUTIVE, one.event, one.text
        case _:
            assert_never(one)


def _noted(record: Record, faults: Sequence[Fault]) -> str:
    """A record in words; a fault that was applied by its own."""
    at = fault_and_bits(record.detail)[0] - FIRST_FAULT
    if record.event is Event.FAULT_APPLIED and 0 <= at < len(faults):
        return f"{record.event}: {faults[at]}"
    found = [str(record.event)]
    found += [f"#{record.request_id}"] if record.request_id else []
    found += [str(record.detail)] if record.detail else []
    return " ".join(found)


def _draw(one: Happening, nodes: dict[str, str], faults: Sequence[Fault]) -> list[_Drawn]:
    """An arrow, a note, or nothing."""
    match one:
        case Sent():
            source, sink = nodes.get(one.source, one.source), nodes.get(one.sink, one.sink)
            return [_Drawn(one.t_ns, source, sink, f"{one.port} {brief(one.message)}")]
        case Record() if one.event not in REQUEST_EVENTS:
            node = "" if one.node == EXECUTIVE else one.node
            return [_Drawn(one.t_ns, node, "", _noted(one, faults))]
        case Told(event=event) if event == STRUCK:
            return [_Drawn(one.t_ns, one.text, "", STRUCK)]
        case Told():
            return [_Drawn(one.t_ns, "", "", f"{one.event}: {one.text}")]
        case _:
            return []


def _nodes(trace: Trace) -> dict[str, str]:
    """Which node hosts which brick: of the mechanism at the start, and of those that came."""
    setup = trace.run.setup
    later = [adaptation.ftm for adaptation in trace.run.adaptations]
    graphs = [trace.run.rest.graph, *(build(ftm, setup.placement) for ftm in (*later, setup.ftm))]
    return {brick: node for graph in graphs for node, bricks in graph.nodes.items() for brick in bricks}

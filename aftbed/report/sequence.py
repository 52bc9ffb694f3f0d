"""What happened in a simulated run: as a listing, as a Mermaid diagram, and as a space-time diagram.

All three are made from one trace (`runtime.sim.trace`). The records that every request leaves are the usual
case; a *turning point* is a fault, an alarm, a step of a failover, the start or the end of an adaptation.

- `listing` and `mermaid` show the last `LAST` entries before a promise was broken. A breach has no time of
  its own, because the checks read a whole history. If its reason names a request, the entries end with the
  last one of that request, otherwise with the end of the run. Mermaid leaves out the usual records: the
  arrows show as much.
- `space_time` lays out a diagram in Lamport's form ("Time, clocks, and the ordering of events", CACM 21,
  1978): a row per node, time from left to right, an arrow per message. It shows the turning points, with
  `BEFORE` entries before and `AFTER` entries after each. What is left out is a gap, with its number of
  entries and its duration. Every entry has a place of its own. A longer wait takes more room, by its
  logarithm: a hop takes 10 us and a hang 50 ms. `templates/spacetime.html.j2` turns the layout into SVG.

Limits: a trace has the time at which a message was sent, not the time at which it was received, so all arrows
have the same width. Bricks that share a node exchange no messages: their diagram has marks only.
"""

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Final, NamedTuple, assert_never

import msgspec

from aftbed.core.events import FIRST_FAULT, REQUEST_EVENTS, STEP_EVENTS, Event
from aftbed.core.journal import Entry, Record
from aftbed.ftm.compose import build
from aftbed.inject.model import Fault
from aftbed.inject.receipts import fault_and_bits
from aftbed.judge.verdict import Breach
from aftbed.runtime.sim.trace import STRUCK, Happening, Sent, Told, Trace, brief, digest, milliseconds

EXECUTIVE: Final = "supervisor"
LAST: Final = 40  # lines of a listing; arrows and notes of a Mermaid diagram
BEFORE, AFTER = 14, 30  # entries around a turning point in a space-time diagram
KEPT_MAX: Final = 330  # entries of a space-time diagram

TURNS: Final = frozenset(
    (Event.FAULT_APPLIED, Event.WATCHDOG_SUSPECT, Event.RECOVERY_ENTER, Event.REPLICA_PROMOTED)
    + (Event.RECOVERY_EXIT, Event.DETECTED_STOP, Event.FOLLOWER_DIVERGED, Event.BACKUP_READY)
    + (Event.ADAPT_PLAN, Event.ADAPT_COMMIT, Event.ADAPT_ROLLBACK)
)
_LABELLED: Final = ("roles", "adapted", "script.done")  # lines of the executive with a label in the diagram
_REQUEST: Final = re.compile(r"\brequest (\d+)")
_ESCAPED: Final = re.compile(r"[^A-Za-z0-9 _.,:'/()=+*-]|\b[Ee](?=[Nn][Dd]\b)")  # `end` would end a block


# -- entries of a trace ---------------------------------------------------------------------------


def hosts_of(trace: Trace) -> dict[str, str]:
    """The node of each brick, over all mechanisms that the run had."""
    setup = trace.run.setup
    later = [adaptation.ftm for adaptation in trace.run.adaptations]
    graphs = [trace.run.rest.graph, *(build(ftm, setup.placement) for ftm in (*later, setup.ftm))]
    return {brick: node for graph in graphs for node, bricks in graph.nodes.items() for brick in bricks}


def nodes_of(one: Happening, hosts: dict[str, str]) -> list[str]:
    """The nodes that take part: sender and receiver of a message, the one node of any other entry."""
    match one:
        case Sent():
            return [hosts.get(one.source, one.source), hosts.get(one.sink, one.sink)]
        case Record():
            return [one.node]
        case Told(event=event, text=text):
            return [text if event == STRUCK else EXECUTIVE]
        case _:
            return []


def is_turn(one: Happening) -> bool:
    match one:
        case Told(event=event):
            return event == STRUCK
        case Record(event=event):
            return event in TURNS
        case _:
            return False


def _is_labelled(one: Record | Told) -> bool:
    return one.event in _LABELLED if isinstance(one, Told) else is_turn(one)


def _fault_of(record: Record, faults: Sequence[Fault]) -> Fault | None:
    """The fault that a `fault.applied` record is about."""
    at = fault_and_bits(record.detail)[0] - FIRST_FAULT
    return faults[at] if record.event is Event.FAULT_APPLIED and 0 <= at < len(faults) else None


def _record_words(record: Record, faults: Sequence[Fault]) -> str:
    """With all its details, for a listing."""
    if fault := _fault_of(record, faults):
        return f"{record.event}: {fault}"
    words = [str(record.event), *([f"#{record.request_id}"] if record.request_id else [])]
    return " ".join([*words, *([str(record.detail)] if record.detail else [])])


def _mark_words(one: Record | Told, faults: Sequence[Fault]) -> str:
    """What a mark of the space-time diagram is called; a fault by its own words."""
    if isinstance(one, Told):
        return f"{one.text} was hit" if one.event == STRUCK else f"{one.event}: {one.text}"
    if one.event is Event.FAULT_APPLIED:
        return str(_fault_of(one, faults) or one.event)
    words = [str(one.event), *([f"#{one.request_id}"] if one.request_id else [])]
    return " ".join([*words, *([str(one.detail)] if one.detail and one.event in STEP_EVENTS else [])])


# -- the end of a run: listing and Mermaid --------------------------------------------------------


def listing(trace: Trace, broken: Sequence[Breach] = (), last: int = LAST) -> str:
    """The last lines before the first of `broken` (without one: of the run), with virtual time in ms."""
    return _lines(trace, _until(trace.happened, broken)[-last:], broken)


def _lines(trace: Trace, shown: Iterable[Happening], broken: Sequence[Breach] = ()) -> str:
    rows = [_columns(one, trace.run.setup.faults) for one in shown]
    widths = [max((len(row[at]) for row in rows), default=0) for at in range(3)]
    found = [
        f"{time:>{widths[0]}} ms  {where:<{widths[1]}}  {how:<{widths[2]}}  {what}".rstrip()
        for time, where, how, what in rows
    ]
    return "".join(f"{line}\n" for line in (*found, *(f"broken: {breach}" for breach in broken)))


def _until(happened: Sequence[Happening], broken: Sequence[Breach]) -> Sequence[Happening]:
    """All entries up to the last one of the request that the first breach names, if it names one."""
    named = _REQUEST.search(broken[0].reason) if broken else None
    if named is None:
        return happened
    last = max((at for at, one in enumerate(happened) if _request_of(one) == int(named[1])), default=None)
    return happened if last is None else happened[: last + 1]


def _request_of(one: Happening) -> int:
    """0 for none."""
    found = getattr(one.message if isinstance(one, Sent) else one, "request_id", 0)
    assert isinstance(found, int)
    return found


def _columns(one: Happening, faults: Sequence[Fault]) -> tuple[str, str, str, str]:
    """Time, place, kind, content."""
    time = f"{milliseconds(one.t_ns):.3f}"
    match one:
        case Sent():
            return time, one.source, f"{one.port} -> {one.sink}", brief(one.message)
        case Record():
            return time, one.node, "*", _record_words(one, faults)
        case Entry():
            return time, "client", one.kind.name.lower(), f"#{one.request_id} {digest(one.payload)}"
        case Told():
            return time, EXECUTIVE, one.event, one.text
        case _:
            assert_never(one)


class _Step(NamedTuple):
    """An arrow from `node` to `sink`, or a note over `node`; a note over "" spans all participants."""

    t_ns: int
    node: str
    sink: str
    words: str


def mermaid(trace: Trace, broken: Sequence[Breach] = (), last: int = LAST) -> str:
    """The same in Mermaid: nodes are participants, faults and lines of the executive are notes."""
    hosts, faults = hosts_of(trace), trace.run.setup.faults
    steps = [step for one in _until(trace.happened, broken) for step in _steps(one, hosts, faults)][-last:]
    names = dict.fromkeys(name for step in steps for name in (step.node, step.sink) if name)
    aliases = {name: f"p{number}" for number, name in enumerate(names or (EXECUTIVE,))}
    everybody = ",".join(dict.fromkeys((next(iter(aliases.values())), list(aliases.values())[-1])))
    found = [f"participant {alias} as {escaped(name)}" for name, alias in aliases.items()]
    for t_ns, node, sink, words in steps:
        where = f"{aliases[node]}->>{aliases[sink]}" if sink else f"Note over {aliases.get(node, everybody)}"
        found.append(f"{where}: {escaped(f'{milliseconds(t_ns):.3f} ms: {words}')}")
    found += [f"Note over {everybody}: {escaped(f'broken: {breach}')}" for breach in broken]
    return "".join(f"{line}\n" for line in ("sequenceDiagram", *(f"    {line}" for line in found)))


def escaped(words: str) -> str:
    """`words` with every character that could mean something to Mermaid replaced by its code."""
    return _ESCAPED.sub(lambda found: f"#{ord(found[0])};", words)


def _steps(one: Happening, hosts: dict[str, str], faults: Sequence[Fault]) -> list[_Step]:
    """An arrow, a note, or nothing."""
    match one:
        case Sent():
            source, sink = nodes_of(one, hosts)
            return [_Step(one.t_ns, source, sink, f"{one.port} {brief(one.message)}")]
        case Record() if one.event not in REQUEST_EVENTS:
            return [
                _Step(one.t_ns, "" if one.node == EXECUTIVE else one.node, "", _record_words(one, faults))
            ]
        case Told(event=event) if event == STRUCK:
            return [_Step(one.t_ns, one.text, "", STRUCK)]
        case Told():
            return [_Step(one.t_ns, "", "", f"{one.event}: {one.text}")]
        case _:
            return []


# -- the turning points of a run: layout of a space-time diagram -----------------------------------

ROW_PX, LANE_PX, LANES_MAX = 20.0, 15.0, 7
LEFT_PX, RIGHT_PX = 14.0, 60.0
GAP_PX, GAP_BOX_PX = 98.0, 68.0
ARROW_PX: Final = 12.0  # width of an arrow
TICK_PX: Final = 78.0  # least distance of two times on the axis
CHARACTER_PX: Final = 6.3  # mean width of a character at 11 px
WAIT_NS, WAIT_PX = 30_000, 14.0  # a longer wait takes WAIT_PX more for each power of ten


class Shape(NamedTuple):
    """A piece of the diagram in pixels, from `x, y` to `x2, y2` where it has an end; `css` is its class."""

    x: float
    y: float
    x2: float = 0.0
    y2: float = 0.0
    css: str = ""
    text: str = ""

    @property
    def length(self) -> float:
        return math.hypot(self.x2 - self.x, self.y2 - self.y)

    @property
    def angle(self) -> float:
        """Of an arrow, in degrees."""
        return math.degrees(math.atan2(self.y2 - self.y, self.x2 - self.x))


class SpaceTime(msgspec.Struct, frozen=True):
    """The layout. `text` says the same in lines. The template draws the lists in their order."""

    width: float
    height: float
    top: float  # of the rows
    axis_y: float
    bands: list[Shape]  # ground of a replica
    rows: list[Shape]  # a node: its name and its y
    lives: list[Shape]  # line of a node; `hit` from when it was hit until it acts again
    gaps: list[Shape]  # `text` has two lines
    ticks: list[Shape]
    labels: list[Shape]  # words at `x, y`, with a leader down to `y2`
    arrows: list[Shape]
    dots: list[Shape]
    crosses: list[Shape]
    diamonds: list[Shape]
    text: str


class _Place(NamedTuple):
    """An entry at `x`, the number of entries left out before it, and their duration."""

    x: float
    one: Happening
    skipped: int
    skipped_ns: int


def space_time(trace: Trace) -> SpaceTime:
    """Lay out the turning points of a run, and the entries around them."""
    kept = _kept(trace.happened)
    places = list(_places(trace.happened, kept))
    return _Layout(trace, places).drawn(_lines(trace, [trace.happened[at] for at in kept]))


def _kept(happened: Sequence[Happening]) -> list[int]:
    """The indices of the entries to draw, in order."""
    turns = [at for at, one in enumerate(happened) if is_turn(one)] or [len(happened) - 1]
    found: set[int] = set()
    for turn in turns:
        around = range(max(0, turn - BEFORE), min(len(happened), turn + AFTER + 1))
        if len(found | set(around)) > KEPT_MAX:
            break
        found |= set(around)
    return sorted(found)


def _places(happened: Sequence[Happening], kept: Sequence[int]) -> Iterator[_Place]:
    x, before = LEFT_PX, kept[0] - 1 if kept else -1
    for at in kept:
        one = happened[at]
        skipped, waited_ns = at - before - 1, one.t_ns - happened[max(before, 0)].t_ns
        stretch = WAIT_PX * math.log10(waited_ns / WAIT_NS) if waited_ns > WAIT_NS else 0.0
        x += GAP_PX if skipped else stretch
        yield _Place(x, one, skipped, waited_ns)
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


def _style(one: Record | Told) -> str:
    """The class of a mark and of its label: `fault`, `adapt` or `step`."""
    if isinstance(one, Told):
        return "fault" if one.event == STRUCK else "adapt" if one.event.startswith("adapt") else "step"
    if one.event in (Event.FAULT_APPLIED, Event.DETECTED_STOP, Event.FOLLOWER_DIVERGED):
        return "fault"
    return "adapt" if str(one.event).startswith("adapt") else "step"


def _width_of(words: str) -> float:
    return CHARACTER_PX * len(words)


class _Layout:
    def __init__(self, trace: Trace, places: list[_Place]) -> None:
        self._trace, self._places, self._hosts = trace, places, hosts_of(trace)
        self._order = self._rows()
        self._lanes = list(self._in_lanes())  # (place, lane, words)
        ends = [place.x + _width_of(words) + 8 for place, _, words in self._lanes]
        self._width = max([places[-1].x + RIGHT_PX if places else RIGHT_PX, *ends])
        self._top = LANE_PX * (1 + max((lane for _, lane, _ in self._lanes), default=-1)) + 12
        self._axis_y = self._top + ROW_PX * len(self._order) + 6

    def drawn(self, text: str) -> SpaceTime:
        found: dict[str, list[Shape]] = {"arrows": [], "dots": [], "crosses": [], "diamonds": []}
        for place in self._places:
            if not isinstance(place.one, Entry):
                kind, shape = self._mark(place.one, place.x)
                found[kind].append(shape)
        return SpaceTime(
            width=self._width,
            height=self._axis_y + 24,
            top=self._top,
            axis_y=self._axis_y,
            bands=list(self._bands()),
            rows=[Shape(0, self._y(node), text=node) for node in self._order],
            lives=[life for node in self._order for life in self._lives(node)],
            gaps=[self._gap(place) for place in self._places if place.skipped],
            ticks=list(self._ticks()),
            labels=[self._label(*lane) for lane in self._lanes],
            text=text,
            **found,
        )

    def _nodes(self, one: Happening) -> list[str]:
        return nodes_of(one, self._hosts)

    def _y(self, node: str) -> float:
        return self._top + ROW_PX * (self._order.index(node) + 0.5)

    def _rows(self) -> list[str]:
        """The client's side, the replicas with their bricks in the order of a request, the executive."""
        parts = [n.rpartition("/")[2] for one in self._trace.happened for n in self._nodes(one)]
        order = {part: place for place, part in enumerate(dict.fromkeys(parts))}

        def key(name: str) -> tuple[int, str, int]:
            replica, slash, part = name.rpartition("/")
            if name in ("client", "proxy"):
                return 0, "", ("client", "proxy").index(name)
            if slash or name in ("a", "b"):
                return 1, replica or name, order.get(part.rstrip("'"), len(order))
            return 2, "", 1 if name == EXECUTIVE else 0

        return sorted(dict.fromkeys(n for p in self._places for n in self._nodes(p.one)), key=key)

    def _in_lanes(self) -> Iterator[tuple[_Place, int, str]]:
        """Each label that has room, with its lane above the rows; lane 0 is the lowest."""
        ends = [-math.inf] * LANES_MAX
        for place in self._places:
            one = place.one
            if isinstance(one, Record | Told) and _is_labelled(one):
                words = _mark_words(one, self._trace.run.setup.faults)
                lane = next((n for n, end in enumerate(ends) if end + 10 < place.x), None)
                if lane is not None:
                    ends[lane] = place.x + _width_of(words)
                    yield place, lane, words

    def _label(self, place: _Place, lane: int, words: str) -> Shape:
        assert isinstance(place.one, Record | Told)
        y, row_y = self._top - 10 - LANE_PX * lane, self._y(self._nodes(place.one)[0])
        return Shape(place.x, y, place.x, row_y, _style(place.one), words)

    def _bands(self) -> Iterator[Shape]:
        for replica in ("a", "b"):
            ys = [self._y(name) for name in self._order if name.split("/")[0] == replica]
            if ys:
                yield Shape(0, min(ys) - ROW_PX / 2, self._width, max(ys) + ROW_PX / 2, replica)

    def _lives(self, node: str) -> Iterator[Shape]:
        hit, since, y = False, 0.0, self._y(node)
        for place in self._places:
            one = place.one
            victim = one.text if isinstance(one, Told) and one.event == STRUCK else ""
            acts = not victim and self._nodes(one)[:1] == [node]
            if acts if hit else victim == node:
                yield Shape(since, y, place.x, y, "hit" if hit else "")
                hit, since = not hit, place.x
        yield Shape(since, y, self._width, y, "hit" if hit else "")

    def _ticks(self) -> Iterator[Shape]:
        last = -math.inf
        for place in self._places:
            last = max(last, place.x - GAP_PX / 2) if place.skipped else last
            if place.x - last >= TICK_PX:
                first = place.x < TICK_PX / 2  # its time stands beside it, not below
                last = place.x + (TICK_PX / 2 if first else 0)
                time = f"{milliseconds(place.one.t_ns):.3f} ms"
                yield Shape(place.x, self._axis_y, css="start" if first else "middle", text=time)

    def _gap(self, place: _Place) -> Shape:
        x = place.x - GAP_PX + 18
        words = f"{place.skipped} more\n{place.skipped_ns / 1e6:.3g} ms"
        return Shape(x, self._top, x + GAP_BOX_PX, self._axis_y, text=words)

    def _mark(self, one: Sent | Record | Told, x: float) -> tuple[str, Shape]:
        """Which list it belongs to, and its shape; `text` is its tooltip."""
        time = f"{milliseconds(one.t_ns):.3f} ms  "
        if isinstance(one, Sent):
            source, sink = self._nodes(one)
            words = f"{time}{source} to {sink}: {one.port} {brief(one.message)}"
            css = one.message.TRAFFIC.value
            return "arrows", Shape(x, self._y(source), x + ARROW_PX, self._y(sink), css, words)
        where = f"{one.node}: " if isinstance(one, Record) else ""
        css, words = _style(one), f"{time}{where}{_mark_words(one, self._trace.run.setup.faults)}"
        y = self._y(self._nodes(one)[0])
        if isinstance(one, Record) and one.event in REQUEST_EVENTS:
            return "dots", Shape(x, y, text=words)
        if css == "fault":
            return "crosses", Shape(x, y, css=css, text=words)
        small = isinstance(one, Record) and one.event in STEP_EVENTS
        return "diamonds", Shape(x, y, css=f"{css} small" if small else css, text=words)

"""What happened in a simulated run: as a listing, as a Mermaid diagram, and as a space-time diagram.

All three are made from one trace (`runtime.sim.trace`), in the words of `judge.timeline`. The records that
every request leaves are the usual case; a *turning point* is a fault, an alarm, a step of a failover, the
start or the end of an adaptation.

- `listing` shows the last `LAST` entries before a promise was broken. A breach has no time of its own,
  because the checks read a whole history. If its reason names a request, the entries end with the last one of
  that request, otherwise with the end of the run.
- `mermaid` shows the entries that `space_time` shows, and of a broken run also the last `LAST`. It leaves out
  the usual records: the arrows show as much.
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
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final, NamedTuple, Self, assert_never

import msgspec

from aftbed.core.events import REQUEST_EVENTS, STEP_EVENTS, Event, Weight
from aftbed.core.journal import Entry, Record
from aftbed.ftm.compose import build
from aftbed.inject.model import FaultReport
from aftbed.judge.record import RunRecord
from aftbed.judge.timeline import (
    ACROSS,
    between_processes,
    describe,
    links_of,
    logged_events,
    node_journals,
    steps_of,
)
from aftbed.judge.verdict import Breach
from aftbed.runtime.sim.trace import STRUCK, Happening, LoggedLine, Sent, Trace, brief, digest, milliseconds

EXECUTIVE: Final = "supervisor"
LAST: Final = 40  # lines of a listing; entries before a breach in a Mermaid diagram
BEFORE, AFTER = 14, 30  # entries around a turning point in a diagram
KEPT_MAX: Final = 330  # entries of a diagram

BACK: Final = frozenset(
    {"aft2pro", "pro2pxy", "pxy2clt", "srv2prd", "srv2aft", "srv2bfr"}
)  # towards the client
ACROSS_PORTS: Final = frozenset(ACROSS.values())
_LABELLED: Final = ("roles", "adapted", "script.done")  # lines of the executive with a label in the diagram
_FAULTS: Final = (Event.FAULT_APPLIED, Event.DETECTED_STOP, Event.FOLLOWER_DIVERGED)  # drawn as faults
_REQUEST: Final = re.compile(r"\brequest (\d+)")
_ESCAPED: Final = re.compile(r"[^A-Za-z0-9 _.,:'/()=+*-]|\b[Ee](?=[Nn][Dd]\b)")  # `end` would end a block


# -- entries of a trace ---------------------------------------------------------------------------


class _View(NamedTuple):
    """How an entry is shown. `nodes`: sender and receiver of a message, the one node of any other entry.

    `columns`: place, kind and content in a listing. `note`: in Mermaid, "" if it is left out there. `shape`:
    the list of `SpaceTime` that it belongs to, "" if it is not drawn; `text` is its label and tooltip.
    """

    nodes: tuple[str, ...]
    columns: tuple[str, str, str]
    note: str = ""
    shape: str = ""
    css: str = ""
    text: str = ""
    labelled: bool = False
    room_px: float = 0.0


class Passed(NamedTuple):
    """Something went from one node to another over `channel`: that much a record has of a message."""

    t_ns: int
    source: str
    sink: str
    channel: str


_Shown = Happening | Passed


class _Views:
    """The entries of one run, as they are shown. `hosts`: by brick, the node that hosts it."""

    def __init__(self, hosts: Mapping[str, str], faults: Sequence[FaultReport]) -> None:
        self._hosts, self._faults = hosts, faults

    @classmethod
    def of(cls, trace: Trace) -> Self:
        setup = trace.run.setup
        later = [adaptation.ftm for adaptation in trace.run.adaptations]
        graphs = [trace.run.rest.graph, *(build(ftm, setup.placement) for ftm in (*later, setup.ftm))]
        hosts = {b: node for graph in graphs for node, bricks in graph.nodes.items() for b in bricks}
        return cls(hosts, trace.run.faults)

    def nodes(self, one: _Shown) -> tuple[str, ...]:
        match one:
            case Sent():
                return self._hosts.get(one.source, one.source), self._hosts.get(one.sink, one.sink)
            case Passed():
                return one.source, one.sink
            case Record():
                return (one.node,)
            case LoggedLine(event=event, text=text):
                return (text if event == STRUCK else EXECUTIVE,)
            case _:
                return ()

    def __call__(self, one: _Shown) -> _View:
        nodes = self.nodes(one)
        match one:
            case Sent():
                message = brief(one.message)
                columns = one.source, f"{one.port} -> {one.sink}", message
                text = f"{nodes[0]} to {nodes[1]}: {one.port} {message}"
                css = one.message.TRAFFIC.value
                return _View(nodes, columns, f"{one.port} {message}", "arrows", css, text, room_px=16)
            case Passed():
                columns = one.source, f"{one.channel} ->", one.sink
                text = f"{one.source} to {one.sink}: {one.channel}"
                css = (
                    "reply" if one.channel in BACK else "state" if one.channel in ACROSS_PORTS else "request"
                )
                return _View(nodes, columns, one.channel, "arrows", css, text, room_px=16)
            case Record(event=event):
                return self._of_record(one, event)
            case LoggedLine(event=event, text=text):
                struck = event == STRUCK
                words = f"{text} was hit" if struck else f"{event}: {text}"
                css = "fault" if struck else "adapt" if event.startswith("adapt") else "step"
                note, shape = (STRUCK, "crosses") if struck else (words, "diamonds")
                labelled = event in _LABELLED
                return _View(nodes, (EXECUTIVE, event, text), note, shape, css, words, labelled, 9)
            case Entry():
                content = f"#{one.request_id} {digest(one.payload)}"
                return _View(nodes, ("client", one.kind.name.lower(), content))
            case _:
                assert_never(one)

    def _of_record(self, one: Record, event: Event) -> _View:
        text = describe(one, self._faults)
        full = f"{event}: {text}" if event is Event.FAULT_APPLIED else text
        if one.detail and event not in (*STEP_EVENTS, Event.FAULT_APPLIED, Event.NODE_DIED):
            full = f"{text} {one.detail}"
        columns = one.node, "*", full
        if event in REQUEST_EVENTS:
            return _View((one.node,), columns, shape="dots", css="step", text=text, room_px=3)
        css = "fault" if event in _FAULTS else "adapt" if str(event).startswith("adapt") else "step"
        shape = "crosses" if css == "fault" else "diamonds"
        return _View((one.node,), columns, full, shape, css, text, is_turn(one), 9)


def is_turn(one: _Shown) -> bool:
    turns = isinstance(one, Record) and one.event.weight is Weight.TURNING_POINT
    return turns or _is_strike(one)


def _is_strike(one: _Shown) -> bool:
    return isinstance(one, LoggedLine) and one.event == STRUCK


def _ms(t_ns: int) -> str:
    return f"{milliseconds(t_ns):.3f}"


# -- which entries are shown ----------------------------------------------------------------------


class _Kept(NamedTuple):
    """An entry of a diagram, the number of entries left out before it, and the time since the one before."""

    one: _Shown
    skipped: int
    waited_ns: int


def _kept(happened: Sequence[_Shown], ending: int = 0) -> list[_Kept]:
    """The turning points, what is around them, and the last `ending` entries; the end if there are none."""
    kept = set(range(max(0, len(happened) - ending), len(happened)))
    for turn in [at for at, one in enumerate(happened) if is_turn(one)] or [len(happened) - 1]:
        around = range(max(0, turn - BEFORE), min(len(happened), turn + AFTER + 1))
        if len(kept.union(around)) > KEPT_MAX:
            break
        kept.update(around)
    found, before = list[_Kept](), min(kept, default=0) - 1
    for at in sorted(kept):
        waited_ns = happened[at].t_ns - happened[max(before, 0)].t_ns
        found.append(_Kept(happened[at], at - before - 1, waited_ns))
        before = at
    return found


# -- listing and Mermaid --------------------------------------------------------------------------


def listing(trace: Trace, broken: Sequence[Breach] = (), last: int = LAST) -> str:
    """The last lines before the first of `broken` (without one: of the run), with virtual time in ms."""
    return _lines(_Views.of(trace), _until(trace.happened, broken)[-last:], broken)


def _lines(views: _Views, shown: Iterable[_Shown], broken: Sequence[Breach] = ()) -> str:
    rows = [(_ms(one.t_ns), *views(one).columns) for one in shown]
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
    for at in range(len(happened) - 1, -1, -1):
        one = happened[at]
        if getattr(one.message if isinstance(one, Sent) else one, "request_id", 0) == int(named[1]):
            return happened[: at + 1]
    return happened


def mermaid(trace: Trace, broken: Sequence[Breach] = ()) -> str:
    """In Mermaid: nodes are participants; faults, lines of the executive and what is left out are notes."""
    views = _Views.of(trace)
    kept = _kept(_until(trace.happened, broken), LAST if broken else 0)
    shown = [(one, view) for one in kept if (view := views(one.one)).note or one.skipped]
    names = dict.fromkeys(name for _, view in shown if view.note for name in view.nodes if name != EXECUTIVE)
    aliases = {name: f"p{number}" for number, name in enumerate(names or (EXECUTIVE,))}
    all_nodes = ",".join(dict.fromkeys((next(iter(aliases.values())), list(aliases.values())[-1])))
    found = [f"participant {alias} as {escaped(name)}" for name, alias in aliases.items()]
    for (one, skipped, waited_ns), view in shown:
        if skipped:
            found.append(f"Note over {all_nodes}: {escaped(f'{skipped} more, {waited_ns / 1e6:.3g} ms')}")
        if view.note:
            where = "->>".join(aliases.get(name, all_nodes) for name in view.nodes)
            where = where if view.shape == "arrows" else f"Note over {where}"
            found.append(f"{where}: {escaped(f'{_ms(one.t_ns)} ms: {view.note}')}")
    found += [f"Note over {all_nodes}: {escaped(f'broken: {breach}')}" for breach in broken]
    return "".join(f"{line}\n" for line in ("sequenceDiagram", *(f"    {line}" for line in found)))


def escaped(words: str) -> str:
    """`words` with every character that could mean something to Mermaid replaced by its code."""
    return _ESCAPED.sub(lambda found: f"#{ord(found[0])};", words)


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
    """The layout. `text` has the same in lines. The template draws the lists in their order."""

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
    one: _Shown
    view: _View
    skipped: int
    skipped_ns: int


def space_time(trace: Trace) -> SpaceTime:
    """Lay out the turning points of a run, and the entries around them."""
    return _space_time(trace.happened, _Views.of(trace))


def space_time_of(record: RunRecord) -> SpaceTime:
    """The same of a run of real processes.

    Its record has no messages: an arrow is where the next event on the path of a request was in another node.
    """
    steps = steps_of(record)
    passed = [
        Passed(step_before.t_ns, step_before.node, step.node, link.channel)
        for link in between_processes(steps, links_of(steps))
        for step_before, step in [(steps[link.cause], steps[link.effect])]
    ]
    found: list[Record | Passed | LoggedLine] = [*passed]
    found += (one for _, _, records in node_journals(record) for one in records)
    found += (LoggedLine(*line) for line in logged_events(record))
    happened = [_since(one, record.started_ns) for one in found]
    return _space_time(sorted(happened, key=lambda one: one.t_ns), _Views({}, record.faults))


def _since(one: Record | Passed | LoggedLine, started_ns: int) -> Record | Passed | LoggedLine:
    """With the time since the start of the run."""
    if isinstance(one, Passed):
        return one._replace(t_ns=one.t_ns - started_ns)
    return msgspec.structs.replace(one, t_ns=one.t_ns - started_ns)


def _space_time(happened: Sequence[_Shown], views: _Views) -> SpaceTime:
    places, x = list[_Place](), LEFT_PX
    for one, skipped, waited_ns in _kept(happened):
        view = views(one)
        x += GAP_PX if skipped else WAIT_PX * math.log10(max(1.0, waited_ns / WAIT_NS))
        places.append(_Place(x, one, view, skipped, waited_ns))
        x += view.room_px
    parts = (node.rpartition("/")[2] for one in happened for node in views.nodes(one))
    text = _lines(views, [place.one for place in places])
    return _layout(places, {part: at for at, part in enumerate(dict.fromkeys(parts))}, text)


def _layout(places: list[_Place], parts: dict[str, int], text: str) -> SpaceTime:
    """`parts`: the last words of the names of nodes, in the order of a request."""

    def order(name: str) -> tuple[int, str, int]:
        """The client's side, the replicas with their bricks in the order of a request, the executive."""
        replica, slash, part = name.rpartition("/")
        if name in ("client", "proxy"):
            return 0, "", ("client", "proxy").index(name)
        if slash or name in ("a", "b"):
            return 1, replica or name, parts.get(part.rstrip("'"), len(parts))
        return 2, "", 1 if name == EXECUTIVE else 0

    names = sorted(dict.fromkeys(name for place in places for name in place.view.nodes), key=order)
    labels = list(_labels(places))
    ends = [place.x + CHARACTER_PX * len(place.view.text) + 8 for place, _ in labels]
    width = max([places[-1].x + RIGHT_PX if places else RIGHT_PX, *ends])
    top = LANE_PX * (1 + max((lane for _, lane in labels), default=-1)) + 12
    ys = {name: top + ROW_PX * (at + 0.5) for at, name in enumerate(names)}
    axis_y = top + ROW_PX * len(names) + 6
    marks: dict[str, list[Shape]] = {"arrows": [], "dots": [], "crosses": [], "diamonds": []}
    for place in places:
        if place.view.shape:
            marks[place.view.shape].append(_mark(place, ys))
    bands = []
    for replica in ("a", "b"):
        of_replica = [y for name, y in ys.items() if name.split("/")[0] == replica]
        if of_replica:
            edges = min(of_replica) - ROW_PX / 2, max(of_replica) + ROW_PX / 2
            bands.append(Shape(0, edges[0], width, edges[1], replica))
    gaps = []
    for place in places:
        if place.skipped:
            x, words = place.x - GAP_PX + 18, f"{place.skipped} more\n{place.skipped_ns / 1e6:.3g} ms"
            gaps.append(Shape(x, top, x + GAP_BOX_PX, axis_y, text=words))
    return SpaceTime(
        width=width,
        height=axis_y + 24,
        top=top,
        axis_y=axis_y,
        bands=bands,
        rows=[Shape(0, y, text=name) for name, y in ys.items()],
        lives=[life for name, y in ys.items() for life in _lives(name, y, places, width)],
        gaps=gaps,
        ticks=list(_ticks(places, axis_y)),
        labels=[
            Shape(p.x, top - 10 - LANE_PX * lane, p.x, ys[p.view.nodes[0]], p.view.css, p.view.text)
            for p, lane in labels
        ],
        text=text,
        **marks,
    )


def _labels(places: Iterable[_Place]) -> Iterator[tuple[_Place, int]]:
    """Each label that has room, with its lane above the rows; lane 0 is the lowest."""
    ends = [-math.inf] * LANES_MAX
    for place in places:
        if place.view.labelled:
            lane = next((n for n, end in enumerate(ends) if end + 10 < place.x), None)
            if lane is not None:
                ends[lane] = place.x + CHARACTER_PX * len(place.view.text)
                yield place, lane


def _lives(name: str, y: float, places: Iterable[_Place], width: float) -> Iterator[Shape]:
    hit, since = False, 0.0
    for place in places:
        strike = _is_strike(place.one)
        if place.view.nodes[:1] == (name,) and strike is not hit:  # it is hit, or acts again
            yield Shape(since, y, place.x, y, "hit" if hit else "")
            hit, since = not hit, place.x
    yield Shape(since, y, width, y, "hit" if hit else "")


def _ticks(places: Iterable[_Place], axis_y: float) -> Iterator[Shape]:
    last = -math.inf
    for place in places:
        last = max(last, place.x - GAP_PX / 2) if place.skipped else last
        if place.x - last >= TICK_PX:
            first = place.x < TICK_PX / 2  # its time stands beside it, not below
            last = place.x + (TICK_PX / 2 if first else 0)
            yield Shape(place.x, axis_y, css="start" if first else "middle", text=f"{_ms(place.one.t_ns)} ms")


def _mark(place: _Place, ys: dict[str, float]) -> Shape:
    """`text` is its tooltip."""
    one, view = place.one, place.view
    node = f"{one.node}: " if isinstance(one, Record) else ""
    text, y = f"{_ms(one.t_ns)} ms  {node}{view.text}", ys[view.nodes[0]]
    match view.shape:
        case "arrows":
            return Shape(place.x, y, place.x + ARROW_PX, ys[view.nodes[1]], view.css, text)
        case "dots":
            return Shape(place.x, y, text=text)
        case _:
            small = isinstance(one, Record) and one.event in STEP_EVENTS
            return Shape(place.x, y, css=f"{view.css} small" if small else view.css, text=text)

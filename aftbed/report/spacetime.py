"""A space-time diagram: a row per node, time from left to right, an arrow per message.

The form is Lamport's ("Time, clocks, and the ordering of events", CACM 21, 1978). What of a run is shown,
`happenings` says; what is left out is a gap that says how much it is, and the figures below say when it was.

Limits: a trace knows when a message was sent and not when it was taken up, so an arrow ends one place further
on. Bricks that share a node speak without messages: then there are marks alone.
"""

import math
from collections.abc import Iterable, Iterator
from typing import Final, NamedTuple

from aftbed.core.events import REQUEST_EVENTS, STEP_EVENTS, TURNING_POINTS
from aftbed.core.journal import Entry, Record
from aftbed.report import sequence, svg
from aftbed.report.happenings import (
    GAP_PX,
    Placed,
    class_of,
    hosts_of,
    kept_of,
    kind_of,
    nodes_of,
    placed_of,
    rows_of,
    said,
    struck,
)
from aftbed.runtime.sim.trace import Happening, Sent, Told, Trace, brief, milliseconds

ROW_PX, LANE_PX, LANES_MAX = 20.0, 15.0, 7
RIGHT: Final = 60.0
TICK_PX: Final = 78.0  # between two figures of the time axis, at least
ARROW_PX: Final = 12.0
NAMES_PX: Final = 108.0


class Drawn(NamedTuple):
    """`names` stay in sight while `body` is scrolled; `text` says the same in lines."""

    names: str
    body: str
    text: str


class _Label(NamedTuple):
    """Words above the rows; lane 0 is the lowest."""

    placed: Placed
    one: Record | Told
    lane: int
    words: str


def space_time(trace: Trace) -> Drawn:
    """The turning points of a run, and what lies around them."""
    kept = kept_of(trace.happened)
    placed = list(placed_of(trace.happened, kept))
    rows = rows_of(trace, [p.one for p in placed])
    labels = list(_labels(trace, placed))
    page = _Page(trace, placed, rows, labels)
    text = sequence.text(Trace(trace.run, tuple(trace.happened[at] for at in kept)), last=len(kept))
    return Drawn(page.names(), page.body(), text)


# -- words above the rows --------------------------------------------------------------------------


def _labels(trace: Trace, placed: Iterable[Placed]) -> Iterator[_Label]:
    """Each that has room."""
    ends = [-math.inf] * LANES_MAX
    for at in placed:
        one = at.one
        if not isinstance(one, Record | Told) or not _labelled(one):
            continue
        words = said(one, trace)
        lane = next((n for n, end in enumerate(ends) if end + 10 < at.x), None)
        if lane is not None:
            ends[lane] = at.x + svg.width_of(words)
            yield _Label(at, one, lane, words)


def _labelled(one: Record | Told) -> bool:
    if isinstance(one, Told):
        return one.event in ("roles", "adapted", "script.done")
    return one.event in TURNING_POINTS


# -- drawing --------------------------------------------------------------------------------------


class _Page:
    """One diagram on its way."""

    def __init__(
        self, trace: Trace, placed: list[Placed], rows: dict[str, int], labels: list[_Label]
    ) -> None:
        self._trace, self._placed, self._rows, self._labels = trace, placed, rows, labels
        self._hosts = hosts_of(trace)
        ends = [label.placed.x + svg.width_of(label.words) for label in labels]
        self._width = max([placed[-1].x + RIGHT if placed else RIGHT, *(end + 8 for end in ends)])
        self._top = LANE_PX * (1 + max((label.lane for label in labels), default=-1)) + 12
        self._height = self._top + ROW_PX * len(rows) + 30

    def names(self) -> str:
        """The names of the rows."""
        parts = [svg.label(NAMES_PX - 6, self._y(n) + 4, n, "node", "end") for n in self._rows]
        return svg.drawing(NAMES_PX, self._height, "nodes", *self._bands(NAMES_PX), *parts, css="names")

    def body(self) -> str:
        """All but the names."""
        parts = [*self._bands(self._width), *self._lives(), *self._axis()]
        parts += [svg.label(2, self._y(node) - 3, node, "inline") for node in self._rows]  # on paper
        leaders, words = [], []
        for label in self._labels:
            x, y = label.placed.x, self._top - 10 - LANE_PX * label.lane
            row, css = self._y(self._nodes(label.placed.one)[0]), class_of(label.one)
            leaders.append(svg.line(x, y + 3, x, row, f"leader {css}"))
            words.append(svg.label(x, y, label.words, f"said {css}"))
        parts += [*leaders, *(self._drawn(p) for p in self._placed if not isinstance(p.one, Entry)), *words]
        title = f"space-time diagram: {len(self._rows)} nodes"
        return svg.drawing(self._width, self._height, title, *parts, css="spacetime")

    def _y(self, node: str) -> float:
        return self._top + ROW_PX * (self._rows[node] + 0.5)

    def _nodes(self, one: Happening) -> list[str]:
        return nodes_of(one, self._hosts)

    def _bands(self, width: float) -> list[str]:
        """A ground for each replica."""
        found = []
        for replica in ("a", "b"):
            rows = [place for name, place in self._rows.items() if name.split("/")[0] == replica]
            if rows:
                y, height = self._top + ROW_PX * min(rows), ROW_PX * (max(rows) - min(rows) + 1)
                box: svg.Attributes = {
                    "x": 0.0,
                    "y": y,
                    "width": width,
                    "height": height,
                    "class": f"band {replica}",
                }
                found.append(svg.element("rect", box))
        return found

    def _lives(self) -> list[str]:
        """A line per node, broken from when it was hit until it does something again."""
        found = []
        for node in self._rows:
            hit, since = False, 0.0
            for placed in self._placed:
                victim = struck(placed.one)
                acts = not victim and self._nodes(placed.one)[:1] == [node]
                if acts if hit else victim == node:
                    found.append(self._life(node, since, placed.x, hit=hit))
                    hit, since = not hit, placed.x
            found.append(self._life(node, since, self._width, hit=hit))
        return found

    def _life(self, node: str, x1: float, x2: float, *, hit: bool) -> str:
        return svg.line(x1, self._y(node), x2, self._y(node), "life hit" if hit else "life")

    def _axis(self) -> list[str]:
        y, last, found = self._height - 24, -math.inf, []
        for placed in self._placed:
            if placed.skipped:
                found.append(self._gap(placed))
                last = max(last, placed.x - GAP_PX / 2)
            if placed.x - last >= TICK_PX:
                first = placed.x < TICK_PX / 2  # its figure stands beside it, not below
                last = placed.x + (TICK_PX / 2 if first else 0)
                found.append(svg.line(placed.x, y, placed.x, y + 5, "axis"))
                figure = f"{milliseconds(placed.one.t_ns):.3f} ms"
                found.append(svg.label(placed.x, y + 17, figure, "tick", "start" if first else "middle"))
        return [svg.line(0, y, self._width, y, "axis"), *found]

    def _gap(self, placed: Placed) -> str:
        x, bottom = placed.x - GAP_PX + 18, self._height - 24
        box: svg.Attributes = {
            "x": x,
            "y": self._top,
            "width": GAP_PX - 30,
            "height": bottom - self._top,
            "class": "gap",
        }
        middle = x + (GAP_PX - 30) / 2
        words = [f"{placed.skipped} more", f"{placed.skipped_ns / 1e6:.3g} ms"]
        said = [
            svg.label(middle, self._top + 14 + 14 * n, word, "tick", "middle") for n, word in enumerate(words)
        ]
        return svg.group("", svg.element("rect", box), *said, title="left out: nothing turns here")

    def _drawn(self, placed: Placed) -> str:
        one, x = placed.one, placed.x
        match one:
            case Sent():
                return self._arrow(one, x)
            case Record(event=event) if event in REQUEST_EVENTS:
                dot: svg.Attributes = {"cx": x, "cy": self._y(one.node), "r": 1.6, "class": "dot"}
                return svg.group(
                    "", svg.element("circle", dot), title=self._title(one, said(one, self._trace))
                )
            case Record() | Told():
                return self._mark(one, x)
            case _:
                return ""

    def _mark(self, one: Record | Told, x: float) -> str:
        y, css = self._y(self._nodes(one)[0]), class_of(one)
        shape = svg.path(f"M{x - 5:.1f} {y - 5:.1f}l10 10m0 -10l-10 10", "cross")
        if css != "fault":
            size = 3 if isinstance(one, Record) and one.event in STEP_EVENTS else 4.5
            shape = svg.path(
                f"M{x:.1f} {y - size:.1f}l{size} {size}l-{size} {size}l-{size} -{size}z", "diamond"
            )
        return svg.group(f"mark {css}", shape, title=self._title(one, said(one, self._trace)))

    def _arrow(self, one: Sent, x: float) -> str:
        source, sink = self._nodes(one)
        y1, y2 = self._y(source), self._y(sink)
        length = math.hypot(ARROW_PX, y2 - y1)
        dx, dy = ARROW_PX / length, (y2 - y1) / length
        x2 = x + ARROW_PX
        left, right = (
            (x2 - 7 * dx - 3 * dy, y2 - 7 * dy + 3 * dx),
            (x2 - 7 * dx + 3 * dy, y2 - 7 * dy - 3 * dx),
        )
        head = f"M{x2:.1f} {y2:.1f}L{left[0]:.1f} {left[1]:.1f}L{right[0]:.1f} {right[1]:.1f}z"
        words = f"{source} to {sink}: {one.port} {brief(one.message)}"
        shape = svg.line(x, y1, x2 - 4 * dx, y2 - 4 * dy, "shaft") + svg.path(head, "head")
        return svg.group(f"message {kind_of(one.message)}", shape, title=self._title(one, words))

    def _title(self, one: Happening, words: str) -> str:
        where = f"{one.node}: " if isinstance(one, Record) else ""
        return f"{milliseconds(one.t_ns):.3f} ms  {where}{words}"

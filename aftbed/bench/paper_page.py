"""The document of `aftbed bench paper` for people: aligned text, markdown, and a page with plots.

All of them are made of `tables`, where the words of each cell are decided once. A dash stands for what is not
known, or was not measured. The page is one file, which needs neither network nor script; its style sheet is
that of a campaign's report.
"""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

import msgspec

from aftbed.bench.paper import Figure, OnRoad, Paper, PlacementResult, PublishedFigure
from aftbed.bench.resources import LoadResult
from aftbed.bench.sweep import StateResult
from aftbed.report import plots
from aftbed.report.plots import Points, TimeRange, milliseconds

TEMPLATES: Final = Path(__file__).resolve().parent / "templates"
NOTHING: Final = "-"


class PaperTable(msgspec.Struct, frozen=True):
    """The first column is words, all others are aligned to the right."""

    name: str
    title: str
    about: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def tables(paper: Paper) -> tuple[PaperTable, ...]:
    """All of it, in the order in which it is read."""
    return (
        PaperTable(
            "times",
            "Times",
            "ms. In rounds: our p50 in median rounds of the bare ring of as many hops as a request has under"
            " pbr, or, for a cycle, as it has itself.",
            ("figure", "the paper", "here, p50", "p99", "in rounds", "of"),
            (_ring(paper), *map(_time, paper.figures)),
        ),
        PaperTable(
            "road",
            "On the road",
            f"At {paper.speed_kmh:g} km/h: how far the car travels in that time, and with what speed it meets"
            " the obstacle before which it would just have stopped, braking with"
            f" {paper.deceleration_ms2:.2f} m/s2, if it begins so much too late.",
            ("figure", "the paper, way", "speed", "here, p50, way", "speed", "p99, way", "speed"),
            tuple(map(_road, paper.figures)),
        ),
        PaperTable(
            "processes",
            "Processes",
            "The nodes, and the supervisor in the place of the ROS master.",
            ("graph", "the paper", "here"),
            tuple((f"{p.ftm}, {p.placement}", str(p.paper or NOTHING), str(p.ours)) for p in paper.processes),
        ),
        PaperTable(
            "placements",
            "Placements",
            "Under pbr. CPU in percent of one core, at 50 requests a second and at one, which is as good as"
            " none; asleep: processes that took less than half a percent at 50; memory is PSS.",
            ("placement", "crash", "processes", "asleep", "cycle p50", "p99", "CPU", "CPU, idle", "memory")
            + ("beside: memory",),
            tuple(map(_placement, paper.placements)),
        ),
        PaperTable(
            "state",
            "Size of the state",
            "Cycle in a closed loop, us; blackout of an update of the function, which moves the state, ms.",
            ("state", "under", "cycle p50", "p99", "in rounds", "blackout p50", "p99", "updates"),
            tuple(map(_state, paper.state)),
        ),
        PaperTable(
            "load",
            "Load",
            "Under pbr, at a fixed rate. Latency as the client saw it, ms; CPU in percent of one core.",
            ("requests a second", "placement", "sent", "p50", "p99", "in rounds", "CPU", "of"),
            tuple(map(_load, paper.load)),
        ),
    )


def _ring(paper: Paper) -> tuple[str, ...]:
    cycle = paper.placements[0].cycle
    p50, p99 = (milliseconds(us / 1e3) for us in (cycle.ring_us.p50, cycle.ring_us.p99))
    return f"the bare ring of {cycle.hops} hops", NOTHING, p50, p99, "1", str(cycle.requests)


def _time(row: Figure) -> tuple[str, ...]:
    p50, p99 = milliseconds(row.ours_ms.p50), milliseconds(row.ours_ms.p99)
    return row.what, _published(row.paper), p50, p99, milliseconds(row.ratio), str(row.samples)


def _road(row: Figure) -> tuple[str, ...]:
    theirs = (NOTHING, NOTHING)
    if row.paper_road:
        theirs = _range(map(distance, row.paper_road)), _range(map(_speed, row.paper_road))
    ours = [cell for found in row.road or () for cell in (distance(found), _speed(found))]
    return row.what, *theirs, *(ours or ["served meanwhile", NOTHING, NOTHING, NOTHING])


def _placement(row: PlacementResult) -> tuple[str, ...]:
    cycle, loaded = row.cycle.cycle_us, row.loaded
    return (
        row.placement,
        "survived" if row.survives_crash else "the end",
        *(str(count) for count in (loaded.processes, loaded.asleep)),
        *(f"{us:g} us" for us in (cycle.p50, cycle.p99)),
        *(f"{percent:g} %" for percent in (loaded.cpu_percent, row.idle.cpu_percent)),
        *(f"{mb:g} MB" for mb in (loaded.pss_mb, loaded.others_pss_mb)),
    )


def _state(row: StateResult) -> tuple[str, ...]:
    found = (size(row.state_bytes), row.ftm)
    if row.cycle_us is None or row.blackout_ms is None:
        return *found, *([NOTHING] * 5), "not carried"
    cycle = (f"{row.cycle_us.p50:g}", f"{row.cycle_us.p99:g}", milliseconds(row.cycle_us.p50 / row.ring_us))
    return *found, *cycle, *map(milliseconds, (row.blackout_ms.p50, row.blackout_ms.p99)), str(row.updates)


def _load(row: LoadResult) -> tuple[str, ...]:
    p50_ms, p99_ms = row.latency_ms.p50, row.latency_ms.p99
    times = map(milliseconds, (p50_ms, p99_ms, p50_ms * 1e3 / row.ring_us))
    cpu = f"{row.usage.cpu_percent:g} %"
    return f"{row.rate_hz:g}", row.placement, f"{row.sent_hz:g}", *times, cpu, str(row.requests)


def size(count_bytes: float) -> str:
    """`100 B`, `60 kB`, `10 MB`."""
    for unit, name in ((1e6, "MB"), (1e3, "kB")):
        if count_bytes >= unit:
            return f"{count_bytes / unit:g} {name}"
    return f"{count_bytes:g} B"


def distance(on_road: OnRoad) -> str:
    """`0.15 cm`, `4.17 m`."""
    return f"{on_road.metres:.3g} m" if on_road.metres >= 1 else f"{on_road.metres * 100:.2g} cm"


def _speed(on_road: OnRoad) -> str:
    return f"{on_road.worst_kmh:.1f} km/h"


def _published(paper: PublishedFigure | None) -> str:
    return _range((f"{paper.low:g}", f"{paper.high:g}")) if paper else NOTHING


def _range(words: Iterable[str]) -> str:
    return " to ".join(dict.fromkeys(words))


# -- text and markdown --------------------------------------------------------------------------------


def text(paper: Paper) -> Iterator[str]:
    """Lines for a terminal."""
    yield f"{paper.title} ({paper.source})"
    yield f"theirs: {paper.their_machine}"
    yield f"here: {machine(paper)}"
    for table in tables(paper):
        yield ""
        yield f"{table.title}. {table.about}"
        yield from _aligned([table.head, *table.rows])
    yield ""
    yield from notes(paper)


def markdown(paper: Paper) -> Iterator[str]:
    """The same for a page."""
    yield f"Measured here: {machine(paper)}, in {paper.seconds:.0f} s{', quickly' if paper.quick else ''}."
    for table in tables(paper):
        yield from ("", f"### {table.title}", "", table.about, "")
        yield _piped(table.head)
        yield _piped(["---", *["---:"] * (len(table.head) - 1)])
        yield from map(_piped, table.rows)
    yield ""
    yield from (f"- {note}" for note in notes(paper))


def notes(paper: Paper) -> list[str]:
    """What is to be known of single figures, and what is missing."""
    published = [(f.paper, f.paper.note) for f in paper.figures if f.paper and f.paper.note]
    theirs = [f"The paper's {_published(figure)} ms: {note}." for figure, note in published]
    ours = [f"{figure.what}: {figure.note}." for figure in paper.figures if figure.note]
    missing = [row for row in paper.state if row.refused]
    refused = [f"State of {size(row.state_bytes)} under {row.ftm}: {row.refused}." for row in missing]
    rospy_ms = f"{paper.rospy_cycle_ms:g}"
    rospy = f"The paper's graph on ROS 1 with rospy, on two cores of today: {rospy_ms} ms a cycle."
    return [*dict.fromkeys(theirs), rospy, *paper.notes, *ours, *refused]


def machine(paper: Paper) -> str:
    """The machine of this measurement, without what the builder of its kernel appended."""
    environment = paper.environment
    return f"{environment.cpus}; {environment.kernel.partition('-')[0]}; {environment.python}"


def _aligned(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for first, *others in rows:
        cells = [first.ljust(widths[0]), *(c.rjust(w) for c, w in zip(others, widths[1:], strict=True))]
        yield "  ".join(cells).rstrip()


def _piped(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


# -- page -----------------------------------------------------------------------------------------------


class PaperPlot(msgspec.Struct, frozen=True):
    """A drawing, and the names of its lines in the order of their styles."""

    title: str
    drawing: str
    lines: tuple[str, ...]


def html_page(paper: Paper) -> str:
    """The whole page."""
    from aftbed.report.html import TEMPLATES as STYLES  # noqa: PLC0415 - jinja2
    from aftbed.report.html import engine, page_text  # noqa: PLC0415

    return page_text(
        engine(TEMPLATES, STYLES).get_template("paper.html.j2"),
        paper=paper,
        tables=tables(paper),
        here=machine(paper),
        notes=notes(paper),
        plots={"times": [_ranges(paper)], "state": _state_plots(paper), "load": _load_plots(paper)},
    )


def _ranges(paper: Paper) -> PaperPlot:
    rows = [
        TimeRange(f.what, (f.paper.low, f.paper.high) if f.paper else None, (f.ours_ms.p50, f.ours_ms.p99))
        for f in paper.figures
    ]
    title = "The paper, and here from p50 to p99"
    return PaperPlot(title, plots.ranges(title, rows), ("here", "the paper"))


def _state_plots(paper: Paper) -> list[PaperPlot]:
    cycle: dict[str, list[tuple[float, float]]] = {}
    blackout: dict[str, list[tuple[float, float]]] = {}
    for row in paper.state:
        if row.cycle_us and row.blackout_ms:
            cycle.setdefault(row.ftm, []).append((row.state_bytes, row.cycle_us.p50))
            blackout.setdefault(row.ftm, []).append((row.state_bytes, row.blackout_ms.p50))
    return [
        *_sweep("Cycle, p50", cycle, "state", "us", size),
        *_sweep("Blackout of an update, p50", blackout, "state", "ms", size),
    ]


def _load_plots(paper: Paper) -> list[PaperPlot]:
    latency: dict[str, list[tuple[float, float]]] = {}
    cpu: dict[str, list[tuple[float, float]]] = {}
    for row in paper.load:
        latency.setdefault(f"{row.placement}, p50", []).append((row.rate_hz, row.latency_ms.p50))
        latency.setdefault(f"{row.placement}, p99", []).append((row.rate_hz, row.latency_ms.p99))
        cpu.setdefault(row.placement, []).append((row.rate_hz, row.usage.cpu_percent))
    return [
        *_sweep("Latency", latency, "requests a second", "ms"),
        *_sweep("CPU, all processes of the graph", cpu, "requests a second", "% of one core"),
    ]


def _sweep(
    title: str,
    lines: dict[str, list[tuple[float, float]]],
    x_name: str,
    y_name: str,
    format_x: plots.Format = milliseconds,
) -> list[PaperPlot]:
    """One plot; none where nothing was measured."""
    drawn: dict[str, Points] = dict(lines)
    if not drawn:
        return []
    return [PaperPlot(title, plots.curves(title, drawn, x_name, y_name, format_x), tuple(drawn))]

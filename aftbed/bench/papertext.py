"""The document of `aftbed bench paper` as tables, and these as text: aligned for a terminal, or as
markdown.

What a cell says is decided once, here, for the terminal, for markdown and for the page. A dash stands for
what is not known, or was not measured.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Final

import msgspec

from aftbed.bench.paperdocument import Count, Figure, Paper
from aftbed.bench.placements import Loaded, Placed
from aftbed.bench.published import Published
from aftbed.bench.road import OnRoad
from aftbed.bench.sweep import Sized
from aftbed.report.plots import milliseconds

NOTHING: Final = "-"


class Table(msgspec.Struct, frozen=True):
    """The first column is words, all others are aligned to the right."""

    name: str
    title: str
    about: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def tables(paper: Paper) -> tuple[Table, ...]:
    """All of it, in the order in which it is read."""
    return (
        Table(
            "times",
            "Times",
            "ms. In rounds: our p50 in median rounds of the bare ring of as many hops as a request has under"
            " pbr, or, for a cycle, as it has itself.",
            ("figure", "the paper", "here, p50", "p99", "in rounds", "of"),
            (_ring(paper), *map(_time, paper.figures)),
        ),
        Table(
            "road",
            "On the road",
            f"At {paper.speed_kmh:g} km/h: how far the car travels in that time, and with what speed it meets"
            " the obstacle before which it would just have stopped, braking with"
            f" {paper.deceleration_ms2:.2f} m/s2, if it begins so much too late.",
            ("figure", "the paper, way", "speed", "here, p50, way", "speed", "p99, way", "speed"),
            tuple(map(_road, paper.figures)),
        ),
        Table(
            "processes",
            "Processes",
            "The nodes, and the supervisor in the place of the ROS master.",
            ("graph", "the paper", "here"),
            tuple(map(_count, paper.processes)),
        ),
        Table(
            "placements",
            "Placements",
            "Under pbr. CPU in percent of one core, at 50 requests a second and at one, which is as good as"
            " none; asleep: processes that took less than half a percent at 50; memory is PSS.",
            ("placement", "crash", "processes", "asleep", "cycle p50", "p99", "CPU", "CPU, idle", "memory")
            + ("beside: memory",),
            tuple(map(_placed, paper.placements)),
        ),
        Table(
            "state",
            "Size of the state",
            "Cycle in a closed loop, us; blackout of an update of the function, which moves the state, ms.",
            ("state", "under", "cycle p50", "p99", "in rounds", "blackout p50", "p99", "updates"),
            tuple(map(_sized, paper.state)),
        ),
        Table(
            "load",
            "Load",
            "Under pbr, at a fixed rate. Latency as the client saw it, ms; CPU in percent of one core.",
            ("requests a second", "placement", "sent", "p50", "p99", "in rounds", "CPU", "of"),
            tuple(map(_loaded, paper.load)),
        ),
    )


def text(paper: Paper) -> Iterator[str]:
    """Lines for a terminal."""
    yield f"{paper.title} ({paper.source})"
    yield f"theirs: {paper.their_machine}"
    yield f"here: {here(paper)}"
    for table in tables(paper):
        yield ""
        yield f"{table.title}. {table.about}"
        yield from aligned([table.head, *table.rows])
    yield ""
    yield from notes(paper)


def markdown(paper: Paper) -> Iterator[str]:
    """The same for a page."""
    yield f"Measured here: {here(paper)}, in {paper.seconds:.0f} s{', quickly' if paper.quick else ''}."
    for table in tables(paper):
        yield ""
        yield f"### {table.title}"
        yield ""
        yield table.about
        yield ""
        yield _piped(table.head)
        yield _piped(["---", *["---:"] * (len(table.head) - 1)])
        yield from map(_piped, table.rows)
    yield ""
    yield from (f"- {note}" for note in notes(paper))


def notes(paper: Paper) -> list[str]:
    """What is to be known of single figures, and what is missing."""
    theirs = [
        f"The paper's {_published(f.paper)} ms: {f.paper.note}."
        for f in paper.figures
        if f.paper and f.paper.note
    ]
    ours = [f"{f.what}: {f.note}." for f in paper.figures if f.note]
    refused = [
        f"State of {size(r.state_bytes)} under {r.ftm}: {r.refused}." for r in paper.state if r.refused
    ]
    rospy = (
        f"The paper's graph on ROS 1 with rospy, on two cores of today: {paper.rospy_cycle_ms:g} ms a cycle."
    )
    return [*dict.fromkeys(theirs), rospy, *paper.notes, *ours, *refused]


def aligned(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Columns as wide as their widest cell."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for first, *others in rows:
        cells = [first.ljust(widths[0]), *(c.rjust(w) for c, w in zip(others, widths[1:], strict=True))]
        yield "  ".join(cells).rstrip()


def size(count_bytes: float) -> str:
    """`100 B`, `60 kB`, `10 MB`."""
    for unit, name in ((1e6, "MB"), (1e3, "kB")):
        if count_bytes >= unit:
            return f"{count_bytes / unit:g} {name}"
    return f"{count_bytes:g} B"


def way(on_road: OnRoad) -> str:
    """`0.15 cm`, `4.17 m`."""
    return f"{on_road.metres:.3g} m" if on_road.metres >= 1 else f"{on_road.metres * 100:.2g} cm"


def _piped(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def here(paper: Paper) -> str:
    environment = paper.environment
    kernel = environment.kernel.partition("-")[0]  # what its builder appended tells nobody anything
    return f"{environment.cpus}; {kernel}; {environment.python}"


def _between(words: Iterable[str]) -> str:
    return " to ".join(dict.fromkeys(words))


def _published(paper: Published | None) -> str:
    return _between((f"{paper.low:g}", f"{paper.high:g}")) if paper else NOTHING


def _time(row: Figure) -> tuple[str, ...]:
    ours = row.ours_ms
    p50, p99 = milliseconds(ours.p50), milliseconds(ours.p99)
    return row.what, _published(row.paper), p50, p99, milliseconds(row.ratio), str(row.samples)


def _ring(paper: Paper) -> tuple[str, ...]:
    cycle = paper.placements[0].cycle
    ring = cycle.ring_us
    return (
        f"the bare ring of {cycle.hops} hops",
        NOTHING,
        milliseconds(ring.p50 / 1e3),
        milliseconds(ring.p99 / 1e3),
        "1",
        str(cycle.requests),
    )


def _road(row: Figure) -> tuple[str, ...]:
    theirs = (NOTHING, NOTHING)
    if row.paper_road:
        theirs = _between(map(way, row.paper_road)), _between(map(_speed, row.paper_road))
    ours = [cell for found in row.road or () for cell in (way(found), _speed(found))]
    return row.what, *theirs, *(ours or ["served meanwhile", *[NOTHING] * 3])


def _speed(on_road: OnRoad) -> str:
    return f"{on_road.worst_kmh:.1f} km/h"


def _count(row: Count) -> tuple[str, ...]:
    return f"{row.ftm}, {row.placement}", str(row.paper) if row.paper else NOTHING, str(row.ours)


def _placed(row: Placed) -> tuple[str, ...]:
    cycle = row.cycle.cycle_us
    return (
        row.placement,
        "survived" if row.survives_crash else "the end",
        str(row.loaded.processes),
        str(row.loaded.asleep),
        f"{cycle.p50:g} us",
        f"{cycle.p99:g} us",
        f"{row.loaded.cpu_percent:g} %",
        f"{row.idle.cpu_percent:g} %",
        f"{row.loaded.pss_mb:g} MB",
        f"{row.loaded.others_pss_mb:g} MB",
    )


def _sized(row: Sized) -> tuple[str, ...]:
    found = (size(row.state_bytes), row.ftm)
    if row.cycle_us is None or row.blackout_ms is None:
        return *found, *([NOTHING] * 5), "not carried"
    cycle, blackout = row.cycle_us, row.blackout_ms
    in_rounds = milliseconds(cycle.p50 / row.ring_us)
    times = (
        f"{cycle.p50:g}",
        f"{cycle.p99:g}",
        in_rounds,
        milliseconds(blackout.p50),
        milliseconds(blackout.p99),
    )
    return *found, *times, str(row.updates)


def _loaded(row: Loaded) -> tuple[str, ...]:
    latency = row.latency_ms
    in_rounds = milliseconds(latency.p50 * 1e3 / row.ring_us)
    return (
        f"{row.rate_hz:g}",
        row.placement,
        f"{row.sent_hz:g}",
        milliseconds(latency.p50),
        milliseconds(latency.p99),
        in_rounds,
        f"{row.usage.cpu_percent:g} %",
        str(row.requests),
    )

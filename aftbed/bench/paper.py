"""`aftbed bench paper`: every figure of the paper's Section IV whose source is known here, beside ours,
measured now.

M. Amy, *Adaptive Fault Tolerance: Is ROS a Relevant Executive Support?* (DSN 2016 Student Forum,
hal-01318364).

A row is one figure: the paper's range, our quantiles, and the bare ring of 12 hops (the hops of a request
under `pbr`) measured in the same run. The ratio of our median to the ring's is the one number that can be
compared between machines. Each time is also given as what it is on the road (`on_road`).

The methods differ. Their recovery does not count detection, so ours is given with and without it. Their
adaptation stops the Protocol while it lasts, so their one figure stands beside our blackout and beside our
whole duration, in which requests are served except during the blackout (0.1 s of it is the observation
after which it can no longer be undone). They measured on a machine of 2014. What has no source here is left
out rather than guessed.

The document (`Paper`) is printed as JSON; text, markdown and page are made of `tables`, where the words of
each cell are decided once. The page is one file, which needs neither network nor script; its style sheet is
that of a campaign's report.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Final

import msgspec

from aftbed.bench.adaptation import AdaptationResult, bench_adapt
from aftbed.bench.cycle import CycleResult, CycleRun, bench_cycle, ring_p50_us
from aftbed.bench.recovery import bench_recovery
from aftbed.bench.resources import (
    IDLE_HZ,
    NO_CRASH,
    RADAR_HZ,
    LoadResult,
    Usage,
    bench_launch,
    process_count,
    under_load,
)
from aftbed.bench.rounds import ROUNDS
from aftbed.bench.runs import Found, Log, Percentiles, percentiles, tried
from aftbed.bench.sweep import PLACEMENT, StateResult, sized, sweep_sizes
from aftbed.campaign.ledger import Environment, here
from aftbed.core.errors import ConfigError, HarnessError
from aftbed.core.graph import PLACEMENTS
from aftbed.core.progress import Show, unshown
from aftbed.core.script import RECIPES
from aftbed.report import plots
from aftbed.report.plots import milliseconds
from aftbed.search.road_table import speed_left_ms
from aftbed.vehicle.plant import GRAVITY_MS2, KMH_PER_MS

CYCLES: Final = ("pbr", "lfr", "pbr+tr", "lfr+tr")
BASE, COMPOSED, SWITCHED = "pbr", "pbr+tr", "lfr"
UPDATED_BYTES: Final = 1000  # the state that moves when the function is updated
STATE_FTMS: Final = ("pbr", "lfr")
LOAD_PLACEMENTS: Final = PLACEMENTS[:2]
TEMPLATES: Final = Path(__file__).resolve().parent / "templates"
NOTHING: Final = "-"  # not known, or not measured


class PublishedFigure(msgspec.Struct, frozen=True):
    """A range of times of the paper (ms), and what is to be known of it."""

    low: float
    high: float
    note: str = ""


CYCLE_PBR: Final = PublishedFigure(4.0, 5.0)
CYCLE_ANY: Final = PublishedFigure(4.0, 10.0, "of all mechanisms together")
RECOVERY: Final = PublishedFigure(1.0, 2.0, "without detection")
ADAPTATION: Final = PublishedFigure(300.0, 300.0, "of any kind")
PROCESSES: Final = {"pbr": 17, "pbr+tr": 23}
# Not of the paper: its graph on ROS 1 with rospy, measured by this project on two cores of 2026.
ROSPY_CYCLE_MS: Final = 0.6

NOT_SOURCED: Final = (
    "Initialisation: the paper has a figure, which is not sourced here; ours stands alone.",
    "Cycles of LFR and of the compositions: only their common range is sourced, 4 to 10 ms.",
)

# -- on the road --------------------------------------------------------------------------------------

SPEED_KMH: Final = 50.0  # as in the paper
FRICTION: Final = 0.9  # nominal peak braking coefficient of UN R152
DECELERATION_MS2: Final = FRICTION * GRAVITY_MS2


class OnRoad(msgspec.Struct, frozen=True):
    """A time, in metres travelled and in km/h left at contact where it comes at the worst instant."""

    ms: float
    metres: float
    worst_kmh: float


def metres(speed_kmh: float, delay_ms: float) -> float:
    """The distance that the car travels in that time."""
    return speed_kmh / KMH_PER_MS * delay_ms / 1e3


def residual_kmh(speed_kmh: float, delay_ms: float, deceleration_ms2: float = DECELERATION_MS2) -> float:
    """The speed at contact of a car that brakes so much too late, and otherwise would just have stopped.

    The distance v0 tau is missing at the end of its way; with a constant deceleration a it has left at
    contact

        v = sqrt(2 a v0 tau),    at most v0

    A delay that is over before the last moment to brake costs nothing, and one that comes later meets a
    slower car. Limits: the deceleration is there at once (dead time, lag and jerk of the brakes cost the
    same with and without the delay), and the brakes do not work during the delay.
    """
    assert speed_kmh >= 0 and delay_ms >= 0 and deceleration_ms2 > 0
    missing_m = metres(speed_kmh, delay_ms)
    left_kmh = speed_left_ms(speed_kmh / KMH_PER_MS, missing_m, deceleration_ms2) * KMH_PER_MS
    return min(speed_kmh, left_kmh)  # 3.6 there and back may be more by the last bit


def on_road(delay_ms: float, speed_kmh: float = SPEED_KMH) -> OnRoad:
    """Both, rounded to a tenth of a millimetre and a hundredth of a km/h."""
    left_kmh = residual_kmh(speed_kmh, delay_ms)
    return OnRoad(delay_ms, round(metres(speed_kmh, delay_ms), 4), round(left_kmh, 2))


# -- the document -------------------------------------------------------------------------------------


class Figure(msgspec.Struct, frozen=True):
    """One time. `ratio` is its p50 in rounds of the bare ring; `road` has our p50 and p99.

    `road` is None for a time in which the service goes on.
    """

    name: str
    what: str
    samples: int
    ours_ms: Percentiles
    ring_us: float
    ratio: float
    road: tuple[OnRoad, OnRoad] | None
    paper: PublishedFigure | None = None
    paper_road: tuple[OnRoad, OnRoad] | None = None
    note: str = ""


def figure(
    name: str,
    what: str,
    ours_ms: Percentiles,
    samples: int,
    ring_us: float,
    paper: PublishedFigure | None = None,
    note: str = "",
    *,
    served: bool = False,
) -> Figure:
    """A row, with what follows from its times; `served`: requests are served during this time."""
    ratio = round(ours_ms.p50 * 1e3 / ring_us, 2)
    road = None if served else (on_road(ours_ms.p50), on_road(ours_ms.p99))
    paper_road = (on_road(paper.low), on_road(paper.high)) if paper else None
    return Figure(name, what, samples, ours_ms, ring_us, ratio, road, paper, paper_road, note)


class ProcessCount(msgspec.Struct, frozen=True):
    """Processes of a graph, with the supervisor in the place of the ROS master."""

    ftm: str
    placement: str
    ours: int
    paper: int | None


class PlacementResult(msgspec.Struct, frozen=True):
    """What a placement costs in time, CPU and memory, and whether the crash of a replica is survived."""

    placement: str
    survives_crash: bool
    cycle: CycleResult
    loaded: Usage
    idle: Usage


class Paper(msgspec.Struct, frozen=True):
    """The whole document."""

    title: str
    source: str
    their_machine: str
    environment: Environment
    quick: bool
    seconds: float
    speed_kmh: float
    deceleration_ms2: float
    rospy_cycle_ms: float
    figures: tuple[Figure, ...]
    processes: tuple[ProcessCount, ...]
    placements: tuple[PlacementResult, ...]
    state: tuple[StateResult, ...]
    load: tuple[LoadResult, ...]
    notes: tuple[str, ...]


# -- measurement ----------------------------------------------------------------------------------------


class Effort(msgspec.Struct, frozen=True):
    """How much is measured; seconds are the length of a window."""

    launches: int
    requests: int
    rounds: int
    kills: int
    adaptations: int
    recipe_runs: int
    placement_seconds: float
    load_seconds: float
    rates_hz: tuple[float, ...]
    state_seconds: float
    sizes_bytes: tuple[int, ...]


FULL: Final = Effort(
    launches=10,
    requests=5000,
    rounds=ROUNDS,
    kills=30,
    adaptations=25,
    recipe_runs=5,
    placement_seconds=4.0,
    load_seconds=3.0,
    rates_hz=(10, 50, 100, 200, 500, 1000, 2000),
    state_seconds=0.5,
    sizes_bytes=(100, 1_000, 10_000, 60_000, 100_000, 1_000_000, 10_000_000),
)
QUICK: Final = Effort(
    launches=1,
    requests=200,
    rounds=1,
    kills=2,
    adaptations=2,
    recipe_runs=0,
    placement_seconds=0.3,
    load_seconds=0.3,
    rates_hz=(200,),
    state_seconds=0.2,
    sizes_bytes=(100, 60_000),
)


def bench_paper(effort: Effort, log: Log, show: Show = unshown) -> Paper:
    """Measure everything; `log` gets the name of each measurement. Raises HarnessError."""
    began = time.monotonic()
    bench = _Measurements(effort, log, show)
    cycles = {ftm: bench.cycle(ftm, PLACEMENT) for ftm in CYCLES}
    figures = [*bench.launch(), *map(_cycle_figure, cycles.values())]
    figures += [*bench.recoveries(), *bench.adaptations()]
    by_recipe, fate = bench.recipe()
    placements = tuple(bench.placement(name, cycles[BASE]) for name in PLACEMENTS)
    return Paper(
        title="M. Amy, Adaptive Fault Tolerance: Is ROS a Relevant Executive Support?",
        source="DSN 2016 Student Forum, hal-01318364",
        their_machine="dual core of 2.5 GHz, 2014, ROS 1",
        environment=here(),
        quick=effort is QUICK,
        figures=(*figures, *by_recipe),
        processes=bench.processes(placements),
        placements=placements,
        state=tuple(row for ftm in STATE_FTMS for row in bench.sizes(ftm)),
        load=tuple(bench.load(placement, hz) for placement in LOAD_PLACEMENTS for hz in effort.rates_hz),
        speed_kmh=SPEED_KMH,
        deceleration_ms2=DECELERATION_MS2,
        rospy_cycle_ms=ROSPY_CYCLE_MS,
        notes=(*NOT_SOURCED, fate),
        seconds=round(time.monotonic() - began, 1),
    )


class _Measurements:
    def __init__(self, effort: Effort, log: Log, show: Show) -> None:
        self._effort, self._log, self._show = effort, log, show
        self._done = 0
        of_cycles = len(CYCLES) + len(PLACEMENTS) - 1
        of_sizes = len(STATE_FTMS) * len(effort.sizes_bytes)
        of_loads = len(LOAD_PLACEMENTS) * len(effort.rates_hz)
        others = 1 + len(STATE_FTMS) + 3 + bool(effort.recipe_runs) + len(PLACEMENTS) + 1
        self.total = of_cycles + of_sizes + of_loads + others

    def _tried(self, what: str, measure: Callable[[], Found]) -> Found:
        found = tried(what, measure, self._log)
        self._count()
        return found

    def _count(self) -> None:
        self._done += 1
        self._show(self._done, self.total)

    def launch(self) -> list[Figure]:
        count = self._effort.launches
        found = self._tried("initialisation", partial(bench_launch, BASE, PLACEMENT, count))
        graph, whole = (  # of so few values the p95 and the p99 are the greatest
            Percentiles(one.p50, one.max, one.max, one.max) for one in (found.graph_ms, found.launch_ms)
        )
        ring_us, what = ring_p50_us(BASE, PLACEMENT), "initialisation"
        warm = "its zygote is warm and its spares are parked"
        return [
            figure(f"{what}.graph", f"{what}: the whole graph", graph, count, ring_us, note=warm),
            figure(f"{what}.reply", f"{what}: command to first reply", whole, count, ring_us),
        ]

    def cycle(self, ftm: str, placement: str) -> CycleResult:
        requests, rounds = self._effort.requests, self._effort.rounds
        what = f"cycle of {ftm}, placement {placement}"
        return self._tried(what, partial(bench_cycle, CycleRun(ftm, placement), requests, rounds=rounds))

    def recoveries(self) -> Iterator[Figure]:
        kills = self._effort.kills
        for ftm in STATE_FTMS:
            what, name = f"recovery under {ftm}", f"recovery.{ftm}"
            found = self._tried(what, partial(bench_recovery, ftm, PLACEMENT, kills))
            ring_us = ring_p50_us(BASE, PLACEMENT)
            detected = f"{what}, detection to the next good reply"
            yield figure(
                f"{name}.after_detection", detected, found.after_detection_ms, kills, ring_us, RECOVERY
            )
            yield figure(name, f"{what}, SIGKILL to the next good reply", found.recovery_ms, kills, ring_us)

    def adaptations(self) -> list[Figure]:
        count, seconds = self._effort.adaptations, self._effort.state_seconds
        figures = []
        for name, kind, new in (("compose", "composition", COMPOSED), ("switch", "switch", SWITCHED)):
            what = f"{kind} {BASE} to {new}"
            found = self._tried(what, partial(bench_adapt, BASE, new, PLACEMENT, RECIPES[0], count))
            figures += _both(name, what, found.blackout_ms, found.total_ms, count, _fate(found))
        what = f"update of the function, {UPDATED_BYTES} bytes of state"
        update = self._tried(what, partial(sized, BASE, UPDATED_BYTES, count, seconds))
        assert update.blackout_ms is not None and update.total_ms is not None, update.refused
        times = update.blackout_ms, update.total_ms
        return figures + _both("update", what, *times, count, "under a closed loop")

    def recipe(self) -> tuple[list[Figure], str]:
        """Its figures, and how its runs ended: the paper's recipe kills bricks that are in use."""
        what, runs = f"composition {BASE} to {COMPOSED} by the paper's recipe", self._effort.recipe_runs
        if not runs:
            return [], f"{what}: not measured in a quick run."
        self._log(what)
        blackouts, totals, ends = [], [], Counter[str]()
        for _ in range(runs):
            try:
                found = bench_adapt(BASE, COMPOSED, PLACEMENT, RECIPES[1], 1)
            except (HarnessError, ConfigError):
                ends["failed"] += 1
                continue
            blackouts.append(found.blackout_ms.p50)
            totals.append(found.total_ms.p50)
            ends["never served again"] += bool(found.stuck)
        self._count()
        words = ", ".join(f"{count} {end}" for end, count in ends.items() if count) or "all served again"
        fate = f"{what}: {runs} runs: {words}."
        if not blackouts:
            return [], fate
        return _both("recipe", what, percentiles(blackouts), percentiles(totals), len(blackouts), ""), fate

    def placement(self, placement: str, base: CycleResult) -> PlacementResult:
        cycle = base if placement == PLACEMENT else self.cycle(BASE, placement)
        seconds = self._effort.placement_seconds
        loaded, idle = self._tried(
            f"CPU and memory, placement {placement}",
            lambda: [under_load(BASE, placement, hz, seconds).usage for hz in (RADAR_HZ, IDLE_HZ)],
        )
        return PlacementResult(placement, placement != NO_CRASH, cycle, loaded, idle)

    def processes(self, placements: tuple[PlacementResult, ...]) -> tuple[ProcessCount, ...]:
        composed = self._tried(f"processes of {COMPOSED}", partial(process_count, COMPOSED, PLACEMENT))
        counts = [(BASE, p.placement, p.loaded.processes) for p in placements]
        return tuple(
            ProcessCount(ftm, placement, ours, PROCESSES[ftm] if placement == PLACEMENT else None)
            for ftm, placement, ours in (*counts, (COMPOSED, PLACEMENT, composed))
        )

    def sizes(self, ftm: str) -> list[StateResult]:
        updates, seconds = max(2, self._effort.adaptations // 4), self._effort.state_seconds

        def measure(size_bytes: int) -> StateResult:
            what = f"state of {size_bytes} bytes under {ftm}"
            return self._tried(what, partial(sized, ftm, size_bytes, updates, seconds))

        before = self._done
        found = sweep_sizes(ftm, self._effort.sizes_bytes, measure)
        self._done = before + len(found)  # not all of them were tried
        return found

    def load(self, placement: str, rate_hz: float) -> LoadResult:
        what, seconds = f"{rate_hz:g} requests a second, placement {placement}", self._effort.load_seconds
        return self._tried(what, partial(under_load, BASE, placement, rate_hz, seconds))


def _cycle_figure(cycle: CycleResult) -> Figure:
    ours_ms = Percentiles(*(round(us / 1e3, 4) for us in msgspec.structs.astuple(cycle.cycle_us)))
    paper = CYCLE_PBR if cycle.ftm == BASE else CYCLE_ANY
    what = f"cycle of {cycle.ftm}, {cycle.hops} hops"
    return figure(f"cycle.{cycle.ftm}", what, ours_ms, cycle.requests, cycle.ring_us.p50, paper)


def _both(
    name: str, what: str, blackout: Percentiles, total: Percentiles, count: int, note: str
) -> list[Figure]:
    """Blackout and whole duration of an adaptation, each beside the paper's one figure."""
    ring_us, name = ring_p50_us(BASE, PLACEMENT), f"adapt.{name}"
    dark, whole = f"{what}: no service", f"{what}: from order to end"
    return [
        figure(f"{name}.blackout", dark, blackout, count, ring_us, ADAPTATION, note),
        figure(f"{name}.total", whole, total, count, ring_us, ADAPTATION, served=True),
    ]


def _fate(found: AdaptationResult) -> str:
    """What became of the requests meanwhile."""
    bad = {name: n for name, n in found.requests.items() if n and name != "sent"}
    words = ", ".join(f"{n} {name}" for name, n in bad.items()) or "none lost, doubled, out of order or wrong"
    stuck = f"; {found.stuck} of {found.adaptations} never served again" if found.stuck else ""
    return f"{found.requests['sent']} requests: {words}{stuck}"


# -- tables -------------------------------------------------------------------------------------------


class PaperTable(msgspec.Struct, frozen=True):
    """The first column is words, all others are aligned to the right."""

    name: str
    title: str
    about: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def tables(paper: Paper) -> tuple[PaperTable, ...]:
    """All of it, in the order in which it is read."""
    ring = paper.placements[0].cycle
    bare_ms = [milliseconds(us / 1e3) for us in (ring.ring_us.p50, ring.ring_us.p99)]
    return (
        PaperTable(
            "times",
            "Times",
            "ms. In rounds: our p50 in median rounds of the bare ring of as many hops as a request has under"
            " pbr, or, for a cycle, as it has itself.",
            ("figure", "the paper", "here, p50", "p99", "in rounds", "of"),
            (
                (f"the bare ring of {ring.hops} hops", NOTHING, *bare_ms, "1", str(ring.requests)),
                *map(_time, paper.figures),
            ),
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
        widths = [max(map(len, column)) for column in zip(table.head, *table.rows, strict=True)]
        for first, *others in (table.head, *table.rows):
            cells = [first.ljust(widths[0]), *map(str.rjust, others, widths[1:])]
            yield "  ".join(cells).rstrip()
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


def _piped(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


# -- page -----------------------------------------------------------------------------------------------


class PaperPlot(msgspec.Struct, frozen=True):
    """A drawing, and the names of its lines, or bars, in the order of their styles."""

    title: str
    drawing: str
    lines: tuple[str, ...]
    bars: bool = False


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
        plots=_plots(paper),
    )


def _plots(paper: Paper) -> dict[str, list[PaperPlot]]:
    """By the name of the table above which they stand."""
    ranges = [
        plots.TimeRange(
            f.what, (f.paper.low, f.paper.high) if f.paper else None, (f.ours_ms.p50, f.ours_ms.p99)
        )
        for f in paper.figures
    ]
    title, rate = "The paper, and here from p50 to p99", "requests a second"
    cycles = [(row.ftm, row.state_bytes, row.cycle_us.p50) for row in paper.state if row.cycle_us]
    updates = [(row.ftm, row.state_bytes, row.blackout_ms.p50) for row in paper.state if row.blackout_ms]
    latencies = [
        (f"{row.placement}, {name}", row.rate_hz, ms)
        for row in paper.load
        for name, ms in (("p50", row.latency_ms.p50), ("p99", row.latency_ms.p99))
    ]
    cpu = [(row.placement, row.rate_hz, row.usage.cpu_percent) for row in paper.load]
    return {
        "times": [PaperPlot(title, plots.ranges(title, ranges), ("here", "the paper"), bars=True)],
        "state": [
            *_sweep("Cycle, p50", cycles, "state", "us", size),
            *_sweep("Blackout of an update, p50", updates, "state", "ms", size),
        ],
        "load": [
            *_sweep("Latency", latencies, rate, "ms"),
            *_sweep("CPU, all processes of the graph", cpu, rate, "% of one core"),
        ],
    }


def _sweep(
    title: str,
    points: Iterable[tuple[str, float, float]],
    x_name: str,
    y_name: str,
    format_x: plots.Format = milliseconds,
) -> list[PaperPlot]:
    """One plot of points, each with the name of its line; none where nothing was measured."""
    lines: dict[str, list[tuple[float, float]]] = {}
    for name, x, y in points:
        lines.setdefault(name, []).append((x, y))
    if not lines:
        return []
    return [PaperPlot(title, plots.curves(title, lines, x_name, y_name, format_x), tuple(lines))]

"""Endurance: one long run with crashes and adaptations in turn. Nothing may be lost, and nothing may grow.

A load at a fixed rate is served under each mechanism that tolerates a crash, in turn. Every second crash is
of the primary; the others are of the backup, each supporting node, and a single node of a replica, in turn.
A crash or an adaptation begins when the one before has been dealt with: both replicas stand, and nothing is
under way. So every one of them has to succeed, and the judge of all runs says whether the requests were
served right.

The size of the run is sampled after each adaptation, and averaged over a *tour*, one turn of all mechanisms:
they differ in their size, and a tour has each of them once. The first tour is left out: in it each process
allocates what it needs for the first time.

The time of a machine that others use drifts by itself. So the time from a crash to the next reply is in
*deaths*: multiples of `recovery.death_ms`, which is measured right before each crash. A single death can take
ten times the median of all, so the unit is the median of those around the crash.

The slope of a figure is the median of the slopes of all pairs of its values (Sen, JASA 63, 1968), with the
interval that follows from Kendall's tau: it assumes no normal distribution, and an outlier is one value of
many. A figure is *flat* if its slope is at most a bound with 95 % confidence, so if the upper end of the
interval is. It *grows* if the lower end is above the bound. In between the run was too short to tell, which
is no pass.
"""

import contextlib
import os
import resource
import select
import time
from bisect import bisect_left
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final, Literal, NamedTuple

import msgspec

from aftbed.adapt.engine import DONE
from aftbed.bench.recovery import DEATH, death_ms
from aftbed.bench.runs import POLL_SECONDS, Log, Percentiles, percentiles
from aftbed.campaign.statistics import CONFIDENCE, quantile
from aftbed.core.errors import ConfigError, HarnessError, unknown
from aftbed.core.events import Event
from aftbed.core.graph import PLACEMENTS, Graph
from aftbed.core.journal import EntryKind, History
from aftbed.core.messages import Goal
from aftbed.core.progress import Show, unshown
from aftbed.ftm.compose import DUPLEX_EXPRESSIONS
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Trigger
from aftbed.inject.model import Fault, FaultReport
from aftbed.inject.targets import BACKUP, PRIMARY
from aftbed.judge.checks import Requests, number_of
from aftbed.judge.record import read_record
from aftbed.judge.verdict import Verdict, Word, judge
from aftbed.runtime.unix import control_client
from aftbed.runtime.unix.control_client import ProcessRow
from aftbed.runtime.unix.interrupts import scratch_directory
from aftbed.runtime.unix.launch import launch, options_for
from aftbed.runtime.unix.options import LoadRun

SETTLE_SECONDS_MAX: Final = 10.0  # until both replicas stand again
ANSWER_SECONDS_MAX: Final = 2.0  # until a run that has ended is seen to have
LAST_SECONDS: Final = 1.0  # of the run, in which nothing begins
END_SECONDS_MAX: Final = 60.0  # beyond its time: a load is held up, and makes good for little of it
REQUESTS_MAX: Final = 100_000_000
RATE_HZ_MAX: Final = 5000.0
MINUTES_MIN: Final = 0.05
EVERY_SECONDS_MIN: Final = 0.1
SHOW_SECONDS: Final = 1.0  # between two looks at the time, if nothing happens
SAMPLE_SECONDS: Final = 5.0  # between samples, where there are no adaptations
DESCRIPTORS_OF_SPARE: Final = 2  # in the supervisor: its control line and its pidfd
DEATHS_AROUND: Final = 31  # a crash, by whose median it is told; with a crash every 2 s those of a minute
VALUES_MIN: Final = 8  # for the interval: of fewer, Kendall's tau is not normally distributed


Finding = Literal["flat", "grows", "unknown"]


class SoakPlan(msgspec.Struct, frozen=True):
    """What is asked for. No crashes, or no adaptations, where the time between them is 0."""

    minutes: float
    rate_hz: float
    crash_every_s: float
    adapt_every_s: float
    placement: str
    record: str | None = None


class Trend(msgspec.Struct, frozen=True):
    """A figure over the time of the run; slopes are per 1000 s, None where there were too few values."""

    what: str
    unit: str
    values: int
    median: float | None
    slope: float | None
    low: float | None
    high: float | None
    bound: float
    finding: Finding


class SoakResult(msgspec.Struct, frozen=True):
    """The document of `aftbed bench soak`. `crashes` by target, `adaptations` by mechanism.

    `verdict` is the judge's unless a figure grows (fail), or is not known to be flat (inconclusive).
    """

    placement: str
    rate_hz: float
    seconds: float
    verdict: Word
    judged: Word
    reasons: list[str]
    requests: Requests
    crashes: dict[str, int]
    failovers: int
    adaptations: dict[str, int]
    recovery_ms: Percentiles | None
    death_ms: Percentiles | None  # the limit of a recovery, measured before each crash
    trends: list[Trend]
    record_mb: float
    judge_seconds: float
    judge_rss_mb: float  # the most that this process ever had


class Sample(NamedTuple):
    """The size of the run at a time of the monotonic clock."""

    t_ns: int
    sizes: dict[str, float]


class Death(NamedTuple):
    """How long the machine took to tell of a death, and when (monotonic)."""

    t_ns: int
    ms: float


class Quantity(NamedTuple):
    """The name of a figure in a sample, its unit, and how much its slope may be per 1000 s."""

    name: str
    unit: str
    bound: float


REPLICAS: Final = "replicas"
SPARES: Final = "spares"
GROUPS: Final = {  # of processes, by the name of a row
    "supervisor": "supervisor",
    "zygote": "zygote",
    "client": "client",
    "proxy": "proxy",
    "recovery": "recovery",
    "engine": "engine",
    "a/watchdog": "watchdogs",
    "b/watchdog": "watchdogs",
    "spare": SPARES,
}
# Bounds are per 1000 s: of `make soak` these are 500,000 requests, 500 crashes and 200 adaptations.
RSS_BOUND_MB: Final = 1.0  # 2 bytes for each request
KEPT_BOUND_MB: Final = 3.0  # 4 kB for each crash and adaptation: the supervisor tells of them at the end
COUNT_BOUND: Final = 10.0  # one for each 50 crashes, or 20 adaptations
RECORD_BOUND: Final = 50.0  # bytes for each request, of some 1000
# In deaths, each of 1 ms on a quiet machine, of up to 3.5 ms on one that others use.
FAILOVER_BOUND: Final = 0.3
REPLACEMENT_BOUND: Final = 3.0  # one that read all that was written took a second more
SIZES: Final = (
    Quantity("RSS of supervisor", "MB", KEPT_BOUND_MB),
    *(
        Quantity(f"RSS of {one}", "MB", RSS_BOUND_MB)
        for one in ("zygote", "client", "proxy", "recovery", "engine")
    ),
    *(Quantity(f"RSS of {one}", "MB", RSS_BOUND_MB) for one in ("watchdogs", REPLICAS)),
    Quantity("RSS of a spare", "MB", RSS_BOUND_MB),
    Quantity("RSS of all", "MB", KEPT_BOUND_MB + RSS_BOUND_MB),
    Quantity("descriptors of supervisor", "", COUNT_BOUND),
    Quantity("descriptors of all", "", COUNT_BOUND),
    Quantity("threads of all", "", COUNT_BOUND),
    Quantity("processes", "", COUNT_BOUND),
    Quantity("objects in /dev/shm", "", 0.0),
)


# -- the run --------------------------------------------------------------------------------------


def check(plan: SoakPlan) -> None:
    """Raise ConfigError on what cannot be run."""
    if plan.placement not in PLACEMENTS:
        raise unknown("placement", plan.placement, PLACEMENTS)
    if plan.placement == "single":
        raise ConfigError(
            "--placement single: both replicas die with their node; process or replica is allowed"
        )
    if not 1 <= plan.rate_hz <= RATE_HZ_MAX:
        raise ConfigError(f"--rate {plan.rate_hz:g}: 1 to {RATE_HZ_MAX:g} requests a second are allowed")
    most = REQUESTS_MAX / 60 / plan.rate_hz
    if not MINUTES_MIN <= plan.minutes <= most:
        raise ConfigError(
            f"--minutes {plan.minutes:g}: {MINUTES_MIN:g} to {most:.0f} are allowed at this rate:"
            f" at most {REQUESTS_MAX} requests"
        )
    least_s, most_s = EVERY_SECONDS_MIN, plan.minutes * 60
    for option, seconds in (("--crash-every", plan.crash_every_s), ("--adapt-every", plan.adapt_every_s)):
        if seconds and not least_s <= seconds <= most_s:
            raise ConfigError(f"{option} {seconds:g}: 0 (none), or {least_s:g} to {most_s:g} s is allowed")


def bench_soak(plan: SoakPlan, log: Log, show: Show = unshown) -> SoakResult:
    """Run for so long, and judge; `show` gets the seconds.

    Raises HarnessError where something was not dealt with in time.
    """
    with contextlib.ExitStack() as standing:
        folder = plan.record or str(standing.enter_context(scratch_directory("aftbed-bench-")) / "record")
        soak = Soak(plan, folder, log, show)
        standing.callback(soak.launched.remove)
        soak.run()
        log("judging the record")
        began_s = time.monotonic()
        record = read_record(soak.launched.record)
        verdict = judge(record)
        judged_s = time.monotonic() - began_s
        log("slopes")
        return _result(soak, record.history, verdict, judged_s)


class Soak:
    """One run, from its launch to its end."""

    def __init__(self, plan: SoakPlan, folder: str, log: Log, show: Show = unshown) -> None:
        self.plan, self._log, self._show = plan, log, show
        load = LoadRun(max(1, round(plan.minutes * 60 * plan.rate_hz)), plan.rate_hz)
        first = DUPLEX_EXPRESSIONS[0]
        options, listener = options_for(ftm=first, placement=plan.placement, work=load, record=folder)
        self.launched = launch(options, listener)
        self.samples: list[Sample] = []
        self.deaths: list[Death] = []
        self.crashes: Counter[str] = Counter()
        self.adaptations: Counter[str] = Counter()
        self._asked = 0  # adaptations
        self._reports = self.launched.reports()
        self._ended = False
        self._began_s = time.monotonic()

    @property
    def tour(self) -> int:
        """The number of samples of one turn of all mechanisms."""
        return len(DUPLEX_EXPRESSIONS) if self.plan.adapt_every_s else 1

    def run(self) -> None:
        """To its end."""
        plan = self.plan
        self._settle()
        began_s = self._began_s = time.monotonic()
        end_s = began_s + plan.minutes * 60 - LAST_SECONDS
        begin = {"crash": self._crash, "adapt": self._adapt, "sample": self._sample}
        try:
            for due_s, what in _agenda(plan, began_s):
                self._wait(min(due_s, end_s) - time.monotonic())
                self._settle()
                if self._ended or time.monotonic() >= end_s:
                    break
                begin[what]()
        except (ConfigError, HarnessError):  # it does not answer
            self._wait(ANSWER_SECONDS_MAX)
            if not self._ended:  # else the judge says how
                raise
        self._wait(end_s + LAST_SECONDS + END_SECONDS_MAX - time.monotonic())
        if not self._ended:
            raise HarnessError(f"the run had not ended {END_SECONDS_MAX:g} s after its time")
        self.launched.wait()

    def _wait(self, seconds: float) -> None:
        """Take the reports of the run for so long, or to its end; they would fill its line."""
        limit_s = time.monotonic() + seconds
        poll = select.poll()
        poll.register(self.launched.line.fileno(), select.POLLIN)
        while not self._ended and (left_s := limit_s - time.monotonic()) > 0:
            seconds = self.plan.minutes * 60
            self._show(min(time.monotonic() - self._began_s, seconds), seconds)
            if poll.poll(min(left_s, SHOW_SECONDS) * 1e3) and next(self._reports, None) is None:
                self._ended = True

    def _settle(self) -> None:
        """Wait until both replicas stand, and nothing is under way. Raises HarnessError."""
        limit_s = time.monotonic() + SETTLE_SECONDS_MAX
        status, missing = {}, []
        while not self._ended:
            with contextlib.suppress(ConfigError):  # it still starts, or has just ended
                status = self._ask(control_client.StatusQuery())
                missing = self._missing()
                if status["backup"] and not (status["busy"] or status["adapting"] or missing):
                    return
            if time.monotonic() > limit_s:
                raise HarnessError(
                    f"not settled within {SETTLE_SECONDS_MAX:g} s: backup {status.get('backup') or 'none'},"
                    f" missing {missing}, under way {status.get('busy')}"
                )
            self._wait(POLL_SECONDS)

    def _missing(self) -> list[str]:
        """Nodes that are dead; it may be a while before a Watchdog reports it."""
        graph = msgspec.convert(self._ask(control_client.GraphQuery()), Graph)
        return sorted(set(graph.nodes) - {row.name for row in self._rows()})

    def _ask(self, request: control_client.ControlRequest) -> dict[str, object]:
        return control_client.ask(self.launched.private, request, SETTLE_SECONDS_MAX)

    def _crash(self) -> None:
        total = self.crashes.total()
        target = PRIMARY
        if total % 2:
            nodes = sorted(row.name for row in self._rows() if row.node and row.name != "supervisor")
            chains = [name for name in nodes if name not in GROUPS]
            rarest = min(chains, key=lambda name: self.crashes[name])
            others = [BACKUP, rarest, *(name for name in nodes if name in GROUPS)]
            target = others[total // 2 % len(others)]
        self.deaths.append(Death(time.monotonic_ns(), death_ms()))
        self._settle()  # where the machine stood still meanwhile, a replica may have been lost
        fault = Fault(Crash(), target, Trigger())
        self._ask(control_client.InjectCommand(fault))
        self.crashes[target] += 1

    def _adapt(self) -> None:
        """To the next mechanism. One that is refused or rolled back is the judge's affair."""
        self._asked += 1
        goal = DUPLEX_EXPRESSIONS[self._asked % len(DUPLEX_EXPRESSIONS)]
        command = control_client.AdaptCommand(Goal(expression=goal))
        with contextlib.suppress(ConfigError):  # refused
            outcome = control_client.ask(self.launched.private, command, control_client.ADAPT_SECONDS_MAX)
            self.adaptations[goal] += outcome["outcome"] == DONE
        if self._asked % len(DUPLEX_EXPRESSIONS) == 0:
            tours, crashes = self._asked // len(DUPLEX_EXPRESSIONS), self.crashes.total()
            self._log(f"{tours} tours of {len(DUPLEX_EXPRESSIONS)} mechanisms, {crashes} crashes")
        self._settle()
        self._sample()

    def _rows(self) -> list[ProcessRow]:
        return msgspec.convert(self._ask(control_client.ProcessesQuery())["processes"], list[ProcessRow])

    def _sample(self) -> None:
        if not self._ended:
            rows = [*self._rows(), ProcessRow("warden", "", self.launched.warden, False)]
            self.samples.append(Sample(time.monotonic_ns(), _sizes(rows, self.launched.record)))


def _agenda(plan: SoakPlan, began_s: float) -> Iterator[tuple[float, str]]:
    """What begins when, without an end."""
    every_s = {"crash": plan.crash_every_s, "adapt": plan.adapt_every_s}
    if not plan.adapt_every_s:
        every_s["sample"] = SAMPLE_SECONDS
    due_s = {what: began_s + seconds for what, seconds in every_s.items() if seconds}
    while True:
        what = min(due_s, key=due_s.__getitem__)
        yield due_s[what], what
        due_s[what] += every_s[what]


def _sizes(rows: list[ProcessRow], record: Path) -> dict[str, float]:
    """Of processes that are there; one that has ended meanwhile counts for nothing.

    RSS and not PSS: the supervisor is a fork of this process, and PSS rises, up to RSS, as one of the two
    writes to pages that both have. There are more spares or fewer from moment to moment, as is intended, so
    "all" is without them, and the supervisor's descriptors are without the two for each of them.
    """
    import psutil  # noqa: PLC0415 - it costs 15 ms, and the supervisor is a fork of this process

    found: defaultdict[str, float] = defaultdict(float)
    spares = 0
    for row in rows:
        group = REPLICAS if row.node and row.name not in GROUPS else GROUPS.get(row.name, row.name)
        with contextlib.suppress(psutil.Error):
            process = psutil.Process(row.pid)
            rss_mb, descriptors = process.memory_info().rss / 1e6, process.num_fds()
            found[f"RSS of {group}"] += rss_mb
            found[f"descriptors of {group}"] += descriptors
            if group == SPARES:
                spares += 1
                continue
            found["processes"] += 1
            found["RSS of all"] += rss_mb
            found["descriptors of all"] += descriptors
            found["threads of all"] += process.num_threads()
    for name in ("descriptors of supervisor", "descriptors of all"):
        found[name] -= DESCRIPTORS_OF_SPARE * spares
    if spares:
        found["RSS of a spare"] = found[f"RSS of {SPARES}"] / spares
    found["objects in /dev/shm"] = sum(1 for _ in Path("/dev/shm").iterdir())
    found["record"] = _bytes_on_disk(record)
    return dict(found)


def _bytes_on_disk(folder: Path) -> int:
    with os.scandir(folder) as entries:
        return sum(
            _bytes_on_disk(Path(e.path)) if e.is_dir(follow_symlinks=False) else 512 * e.stat().st_blocks
            for e in entries
        )


# -- what came of it ------------------------------------------------------------------------------


def _result(soak: Soak, history: History, verdict: Verdict, judged_s: float) -> SoakResult:
    trends = [*_size_trends(soak), *_record_trends(soak, history, verdict)]
    word, reasons = with_trends(verdict.verdict, trends)
    recovered = [one.recovered_ms for one in verdict.failovers if one.recovered_ms is not None]
    return SoakResult(
        placement=soak.plan.placement,
        rate_hz=soak.plan.rate_hz,
        seconds=verdict.seconds or 0.0,
        verdict=word,
        judged=verdict.verdict,
        reasons=[*verdict.reasons, *reasons],
        requests=verdict.requests,
        crashes=dict(sorted(soak.crashes.items())),
        failovers=len(verdict.failovers),
        adaptations=dict(soak.adaptations),
        recovery_ms=percentiles(recovered) if recovered else None,
        death_ms=percentiles([one.ms for one in soak.deaths]) if soak.deaths else None,
        trends=trends,
        record_mb=round(_bytes_on_disk(soak.launched.record) / 1e6, 1),
        judge_seconds=round(judged_s, 1),
        judge_rss_mb=round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3, 1),
    )


def with_trends(judged: Word, trends: Sequence[Trend]) -> tuple[Word, list[str]]:
    """The verdict of the judge, unless there is more to say; and what there is."""
    growing = [f"{one.what} grows" for one in trends if one.finding == "grows"]
    open_ = [f"{one.what}: the run was too short to tell" for one in trends if one.finding == "unknown"]
    word: Word = "fail" if growing else "inconclusive" if open_ else "pass"
    worst: tuple[Word, ...] = ("fail", "inconclusive", "pass")
    return min(word, judged, key=worst.index), [*growing, *open_]


def _size_trends(soak: Soak) -> Iterator[Trend]:
    tours = [soak.samples[at : at + soak.tour] for at in range(soak.tour, len(soak.samples), soak.tour)]
    tours = [one for one in tours if len(one) == soak.tour]
    for figure in SIZES:
        points = [
            (_mean([s.t_ns for s in tour]), _mean([s.sizes[figure.name] for s in tour]))
            for tour in ([s for s in tour if figure.name in s.sizes] for tour in tours)
            if tour
        ]
        yield trend(figure, points)


def _record_trends(soak: Soak, history: History, verdict: Verdict) -> Iterator[Trend]:
    """Bytes of the record per request, and the times of failovers and of other things that interrupt."""
    sent_ns = [e.t_ns for e in history.dialogue if e.kind is EntryKind.SENT]
    ends = soak.samples[soak.tour - 1 :: soak.tour]
    points = []
    for before, after in pairwise(ends):
        requests = bisect_left(sent_ns, after.t_ns) - bisect_left(sent_ns, before.t_ns)
        grown = after.sizes["record"] - before.sizes["record"]
        points.append(((before.t_ns + after.t_ns) / 2, grown / max(1, requests)))
    yield trend(Quantity("record per request", "B", RECORD_BOUND), points)
    if not soak.crashes:
        return
    promoted = history.events(Event.REPLICA_PROMOTED)
    failovers = [
        (record.t_ns, one.recovered_ms)
        for record, one in zip(promoted, verdict.failovers, strict=True)
        if one.recovered_ms is not None and one.fault
    ]
    yield in_deaths("primary", FAILOVER_BOUND, failovers, soak.deaths)
    for target in ("client", "proxy"):
        yield in_deaths(target, REPLACEMENT_BOUND, replacements(history, verdict.faults, target), soak.deaths)


def replacements(history: History, faults: Sequence[FaultReport], target: str) -> list[tuple[int, float]]:
    """When each crash of `target` struck (ns), and how long after it the next reply came (ms)."""
    answered_ns = [e.t_ns for e in history.dialogue if e.kind is EntryKind.ANSWERED]
    crashes = {report.number for report in faults if report.fault == f"crash {target}"}
    struck_ns = [s.t_ns for s in history.events(Event.FAULT_APPLIED) if number_of(s) in crashes]
    places = [(t_ns, bisect_left(answered_ns, t_ns)) for t_ns in struck_ns]
    return [(t_ns, (answered_ns[at] - t_ns) / 1e6) for t_ns, at in places if at < len(answered_ns)]


def in_deaths(
    target: str, bound: float, times: Sequence[tuple[int, float]], deaths: Sequence[Death]
) -> Trend:
    """Of `times` (ns, ms) from a crash of `target` to the next reply, by the median of the deaths around."""
    points = []
    for t_ns, ms in times:
        last = bisect_left(deaths, (t_ns, 0.0)) - 1
        first = max(0, min(last - DEATHS_AROUND // 2, len(deaths) - DEATHS_AROUND))
        around = [death.ms for death in deaths[first : first + DEATHS_AROUND]]
        points.append((float(t_ns), ms / quantile(around, 0.5)))
    return trend(Quantity(f"crash to next reply, {target}", "x", bound), points)


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def trend(figure: Quantity, points: list[tuple[float, float]]) -> Trend:
    """Of `points`, each a time (ns) and a value."""
    if len(points) < VALUES_MIN:
        return Trend(figure.name, figure.unit, len(points), None, None, None, None, figure.bound, "unknown")
    from scipy import stats  # noqa: PLC0415 - heavy: see `campaign.statistics.quantile`

    times, values = [t_ns / 1e12 for t_ns, _ in points], [value for _, value in points]
    found = stats.theilslopes(values, times, CONFIDENCE)
    slope, low, high = (round(float(one), 3) for one in (found.slope, found.low_slope, found.high_slope))
    median, bound = round(quantile(values, 0.5), 3), figure.bound
    finding: Finding = "flat" if high <= bound else "grows" if low > bound else "unknown"
    return Trend(figure.name, figure.unit, len(points), median, slope, low, high, bound, finding)


# -- for people -----------------------------------------------------------------------------------


def text(found: SoakResult) -> Iterator[str]:
    """The verdict, and a table of all figures."""
    counts = found.requests
    yield (
        f"{found.seconds:.0f} s at {found.rate_hz:g} requests/s, placement {found.placement}:"
        f" {counts.sent} requests, {counts.lost} lost, {counts.duplicated} doubled, {counts.wrong} wrong,"
        f" {counts.late} late"
    )
    yield (
        f"{sum(found.crashes.values())} crashes, {found.failovers} failovers:"
        f" {', '.join(f'{target} {count}' for target, count in found.crashes.items()) or 'none'}"
    )
    yield (
        f"{sum(found.adaptations.values())} adaptations:"
        f" {', '.join(f'{ftm} {count}' for ftm, count in found.adaptations.items()) or 'none'}"
    )
    for what, times_ms in (("crash to next reply", found.recovery_ms), (DEATH, found.death_ms)):
        if times_ms is not None:
            times = msgspec.structs.asdict(times_ms)
            yield f"{what}: {', '.join(f'{name} {ms:g}' for name, ms in times.items())} ms"
    yield (
        f"record of {found.record_mb:g} MB, judged in {found.judge_seconds:g} s"
        f" with {found.judge_rss_mb:g} MB: {found.judged}"
    )
    yield ""
    yield f"{'figure':32} {'median':>10}    slope per 1000 s, 95 %          bound"
    for one in found.trends:
        slope = "too few values"
        if one.slope is not None:
            slope = f"{one.slope:+10.3f} [{one.low:+.3f}, {one.high:+.3f}]"
        median = f"{one.median:10.2f} {one.unit:2}" if one.median is not None else f"{'':13}"
        yield f"{one.what:32} {median} {slope:32} {one.bound:6g}  {one.finding}"
    yield ""
    yield from found.reasons
    yield f"verdict: {found.verdict}"

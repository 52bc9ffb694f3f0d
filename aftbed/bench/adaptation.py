"""Adaptations under load, there and back: how long no request is served, and what becomes of the requests.

The load has a fixed rate, because a closed loop would hide requests that wait. `blackout_ms` is the time
from the order to stop taking requests to the last acknowledgement that they are taken again: what a request
meets that arrives at the worst moment. `worst_request_ms` is what the client saw, from the journals.
`steps_ms` has what the steps of the commit take of the blackout, each from its begin to that of the next one.

An update exchanges the function, under the same mechanism: two versions with a state of some size (`ballast`)
replace each other.

The limit is that of a failover, SIGKILL to a pidfd readable elsewhere (`recovery`): no brick can be replaced
by another process sooner than the kernel takes to tell of the end of one. The two alternate, when the spares
that the last adaptation took are forked anew. For a death the load pauses, in every third turn of 40 ms; an
adaptation is ordered when it goes on. Each round has a run of its own.

The paper's recipe may leave a request in a brick that is killed, and then nothing is served any more. So
each of its adaptations has a run of its own; those that never answer again are counted as `stuck`.
"""

import itertools
import math
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated, Final, NamedTuple

import msgspec
from msgspec import Meta

from aftbed.adapt.planner import APPLICATION, plan
from aftbed.bench import ballast
from aftbed.bench.cycle import RING_BYTES, ring_of, ring_us
from aftbed.bench.recovery import DEATH, OF_DEATHS, death_at_rest_ms
from aftbed.bench.rounds import ROUNDS, BesideLimit, Meanwhile, beside_limit, shares, together
from aftbed.bench.runs import (
    PAUSE_SECONDS,
    EndlessRun,
    Log,
    Percentiles,
    endless_run,
    latencies_us,
    percentiles,
    tried,
    wait_until_ready,
)
from aftbed.core.errors import ConfigError, HarnessError
from aftbed.core.events import Event
from aftbed.core.graph import PLACEMENTS, Graph
from aftbed.core.journal import EntryKind, Record
from aftbed.core.messages import Goal
from aftbed.core.progress import Show, unshown
from aftbed.core.script import RECIPES, Stage, flat, verb_of
from aftbed.core.yaml_file import read_yaml
from aftbed.ftm.compose import build, parse, protected_by
from aftbed.judge import checks
from aftbed.judge.isolated import reference_of
from aftbed.judge.record import RunRecord
from aftbed.runtime.unix import control_client

RATE_HZ: Final = 200.0
OF_LOAD: Final = msgspec.structs.replace(OF_DEATHS, number=0, share=OF_DEATHS.of - 1)  # all the others
RING_COUNT: Final = 500

Outcomes = list[dict[str, object]]


class AdaptationTimes(BesideLimit, frozen=True):
    """Of the adaptations in one direction; `ratio` is that of `blackout_ms`."""

    prepare_ms: Percentiles
    blackout_ms: Percentiles
    steps_ms: dict[str, Percentiles]
    total_ms: Percentiles
    bricks_changed: int
    bricks_total: int


class AdaptationResult(AdaptationTimes, frozen=True, kw_only=True):
    """The document of `aftbed bench adapt`. `requests`: counts by what became of them."""

    old: str = msgspec.field(name="from")
    new: str = msgspec.field(name="to")
    update_bytes: int | msgspec.UnsetType = msgspec.UNSET  # of the state of the function that is updated
    placement: str
    recipe: str
    adaptations: int
    rate_hz: float
    back: AdaptationTimes | msgspec.UnsetType = msgspec.UNSET  # the paper's recipe goes one way
    requests: dict[str, int]
    stuck: int
    worst_request_ms: float
    ring_us: Percentiles
    machine: Meanwhile


class _Way(NamedTuple):
    """An adaptation from one graph to another, and the goal that asks for it."""

    old: Graph
    new: Graph
    goal: Goal


class _Commit(NamedTuple):
    """The steps of a commit: how many are staged before it, and the name of each; several may have one."""

    staged: int
    names: tuple[str, ...]


class _Round(NamedTuple):
    """What the runs of a round gave."""

    there: Outcomes
    back: Outcomes
    records: list[RunRecord]


def bench_adapt(
    old: str,
    new: str,
    placement: str,
    recipe: str,
    count: int,
    *,
    update_bytes: int = 0,
    pin: bool = True,
    rounds: int = ROUNDS,
    show: Show = unshown,
) -> AdaptationResult:
    """Adapt `count` times, and back as often. Raises HarnessError.

    With `update_bytes`, `old` is `new`, and a function whose state has so many bytes is updated.
    """
    ways = _versions(old, placement, update_bytes) if update_bytes else _mechanisms(old, new, placement)
    if recipe != RECIPES[0]:
        ways = [way._replace(goal=msgspec.structs.replace(way.goal, recipe=recipe)) for way in ways[:1]]
    ring = ring_us(ring_of(ways[0].old), RING_BYTES, RING_COUNT, pin=pin)
    share = shares(count, rounds)

    def adaptations(number: int) -> tuple[_Round, list[float]]:
        if recipe == RECIPES[0]:
            return _there_and_back(ways, share[number], pin=pin)
        return _each_in_a_run(ways[0], share[number], pin=pin)

    found = together(len(share), adaptations, show)
    there, back = ([one.there for one in found.figures], [one.back for one in found.figures])
    records = [record for one in found.figures for record in one.records]
    counts = [_requests(record) for record in records]
    commits = [_commit_of(way) for way in ways]
    steps = [one for record in records for one in _steps_ms(record, commits)]
    return AdaptationResult(
        **msgspec.structs.asdict(_times(there, found.limits, steps[:: len(ways)])),
        machine=found.machine,
        old=old,
        new=new,
        update_bytes=update_bytes or msgspec.UNSET,
        placement=placement,
        recipe=recipe,
        adaptations=sum(map(len, there)) + sum(map(len, back)),
        rate_hz=RATE_HZ,
        back=_times(back, found.limits, steps[1::2]) if all(back) else msgspec.UNSET,
        requests={name: sum(count[name] for count in counts) for name in counts[0]},
        stuck=sum(count["lost"] > 0 for count in counts),
        worst_request_ms=round(max(max(latencies_us(r), default=0.0) for r in records) / 1e3, 3),
        ring_us=percentiles(ring, 1),
    )


def _mechanisms(old: str, new: str, placement: str) -> list[_Way]:
    """From one mechanism to another, and back."""
    first, second = build(old, placement), build(new, placement)
    return [_Way(first, second, Goal(expression=new)), _Way(second, first, Goal(expression=old))]


def _versions(ftm: str, placement: str, size_bytes: int) -> list[_Way]:
    """From one version of a function with so much state to the next one, and back."""
    sources = [ballast.source_of(size_bytes, version) for version in ballast.VERSIONS]
    first, second = (build(ftm, placement, application=source) for source in sources)
    return [
        _Way(first, second, Goal(part=APPLICATION, source=sources[1])),
        _Way(second, first, Goal(part=APPLICATION, source=sources[0])),
    ]


def _run_of(way: _Way, *, pin: bool) -> AbstractContextManager[EndlessRun]:
    graph = way.old
    return endless_run(
        graph.ftm, graph.placement, RATE_HZ, application=protected_by(graph), pin=pin, turns=OF_LOAD
    )


def _there_and_back(ways: Sequence[_Way], count: int, *, pin: bool) -> tuple[_Round, list[float]]:
    """In one run, with a death (ms) before each adaptation."""
    found, deaths_ms = _Round([], [], []), list[float]()
    with _run_of(ways[0], pin=pin) as run:
        wait_until_ready(run.private)
        for _ in range(count):
            for way, outcomes in zip(ways, (found.there, found.back), strict=True):
                deaths_ms.append(death_at_rest_ms(run.private, OF_LOAD, pin=pin))
                outcomes.append(adapted(run.private, way.goal))
                time.sleep(PAUSE_SECONDS)
    found.records.append(run.record)
    return found, deaths_ms


def _each_in_a_run(way: _Way, count: int, *, pin: bool) -> tuple[_Round, list[float]]:
    """There only, since it may be the last thing that the run does."""
    found, deaths_ms = _Round([], [], []), list[float]()
    for _ in range(count):
        with _run_of(way, pin=pin) as run:
            wait_until_ready(run.private)
            deaths_ms.append(death_at_rest_ms(run.private, OF_LOAD, pin=pin))
            found.there.append(adapted(run.private, way.goal))
            time.sleep(PAUSE_SECONDS)
        found.records.append(run.record)
    return found, deaths_ms


def _commit_of(way: _Way) -> _Commit:
    """The steps of its commit."""
    script = plan(way.old, way.new, way.goal.recipe).script
    staged = sum(isinstance(step, Stage) for step in flat(script.prepare))
    kinds = [dict.fromkeys(verb_of(one) for one in flat((step,))) for step in script.commit]
    return _Commit(staged, tuple(map("+".join, kinds)))


def _steps_ms(record: RunRecord, ways: Sequence[_Commit]) -> list[dict[str, float]]:
    """How long each step of the commit took (ms), for each adaptation of a run; they went `ways` in turn."""
    of_each: list[list[Record]] = []
    for one in record.history.events(Event.ADAPT_STEP_ENTER, Event.ADAPT_STEP_EXIT):
        if one.event is Event.ADAPT_STEP_ENTER and one.detail == 1:
            of_each.append([])
        of_each[-1].append(one)
    found = []
    for records, way in zip(of_each, itertools.cycle(ways), strict=False):
        enters = [r.t_ns for r in records if r.event is Event.ADAPT_STEP_ENTER and r.detail > way.staged]
        times: dict[str, float] = dict.fromkeys(way.names, 0.0)
        for name, (begin_ns, end_ns) in zip(
            way.names, itertools.pairwise([*enters, records[-1].t_ns]), strict=True
        ):
            times[name] += (end_ns - begin_ns) / 1e6
        found.append(times)
    return found


def _times(
    rounds: list[Outcomes], deaths: list[list[float]], steps: list[dict[str, float]]
) -> AdaptationTimes:
    outcomes = [outcome for one in rounds for outcome in one]

    def part(name: str) -> Percentiles:
        return percentiles([float(str(outcome[name])) for outcome in outcomes])

    changed, total = (int(str(outcomes[0][name])) for name in ("bricks_changed", "bricks_total"))
    blackouts = [[float(str(outcome["blackout_ms"])) for outcome in one] for one in rounds]
    beside = beside_limit(DEATH, blackouts, deaths)
    return AdaptationTimes(
        part("prepare_ms"),
        part("blackout_ms"),
        {name: percentiles([one[name] for one in steps]) for name in steps[0]},
        part("total_ms"),
        changed,
        total,
        limit=beside.limit,
        ratio=beside.ratio,
    )


def _requests(record: RunRecord) -> dict[str, int]:
    """What became of the requests of a run; `reordered`: replies that came after one of a later request."""
    counts = checks.requests(record.history, reference_of(record))
    ids = [e.request_id for e in record.history.dialogue if e.kind is EntryKind.ANSWERED]
    reordered = sum(after < before for before, after in itertools.pairwise(ids))
    return {
        "sent": counts.sent,
        "lost": counts.lost,
        "duplicated": counts.duplicated,
        "reordered": reordered,
        "late": counts.late,
        "wrong": counts.wrong,
    }


def adapted(private: Path, goal: Goal) -> dict[str, object]:
    """How the adaptation ended. Raises HarnessError unless it is done."""
    outcome = control_client.ask(private, control_client.AdaptCommand(goal), control_client.ADAPT_SECONDS_MAX)
    if outcome["outcome"] != "done":
        raise HarnessError(f"an adaptation of the bench ended {outcome['outcome']}: {outcome['reason']}")
    return outcome


# -- of many pairs --------------------------------------------------------------------------------


class AdaptationTime(msgspec.Struct, frozen=True):
    """Medians of so many adaptations from one mechanism to another: without service, and to the end."""

    blackout_ms: float
    total_ms: float
    adaptations: int


Pair = tuple[str, str]


def bench_pairs(
    pairs: Sequence[Pair], count: int, log: Log, show: Show = unshown
) -> dict[Pair, AdaptationTime]:
    """Each adaptation of `pairs` at least `count` times, under load, in one run. Raises HarnessError."""
    if not pairs:
        return {}
    found = tried(f"{len(pairs)} adaptations, {count} times each", lambda: _walk(pairs, count, show), log)
    return {pair: _time(found[pair]) for pair in pairs}


def _walk(pairs: Sequence[Pair], count: int, show: Show) -> dict[Pair, Outcomes]:
    """From one to the next; where none begins at what runs, there is an adaptation between them."""
    found: dict[Pair, Outcomes] = {}
    with endless_run(pairs[0][0], PLACEMENTS[0], RATE_HZ) as run:
        wait_until_ready(run.private)
        running = pairs[0][0]

        def adapt(new: str) -> None:
            nonlocal running
            found.setdefault((running, new), []).append(adapted(run.private, Goal(expression=new)))
            running = new
            time.sleep(PAUSE_SECONDS)

        for number in range(count):
            left = [pair for pair in pairs if len(found.get(pair, ())) <= number]
            while left:
                old, new = next((pair for pair in left if pair[0] == running), left[0])
                if running != old:
                    adapt(old)
                adapt(new)
                show(sum(min(count, len(found.get(pair, ()))) for pair in pairs), count * len(pairs))
                left = [pair for pair in left if len(found.get(pair, ())) <= number]
    return found


def _time(outcomes: Outcomes) -> AdaptationTime:
    blackout_ms, total_ms = (
        percentiles([float(str(outcome[name])) for outcome in outcomes]).p50
        for name in ("blackout_ms", "total_ms")
    )
    return AdaptationTime(blackout_ms, total_ms, len(outcomes))


class _Median(msgspec.Struct, frozen=True):
    p50: Annotated[float, Meta(ge=0)]


class _OneWay(msgspec.Struct, frozen=True):
    """What is read of the times of one direction."""

    blackout_ms: _Median
    total_ms: _Median


class _ResultFile(_OneWay, frozen=True, kw_only=True):
    """What is read of the document of `aftbed bench adapt`."""

    old: str = msgspec.field(name="from")
    new: str = msgspec.field(name="to")
    recipe: str
    placement: str
    adaptations: Annotated[int, Meta(ge=1)]
    back: _OneWay | None = None


def read_times(path: Path) -> dict[Pair, AdaptationTime]:
    """Of a file with the document of `aftbed bench adapt --json`: there, and back. Raises ConfigError."""
    try:
        found = read_yaml(path, _ResultFile)  # JSON is YAML
    except ConfigError as error:
        allowed = "allowed is a file with the document of `aftbed bench adapt --json`"
        raise ConfigError(f"{error}; {allowed}") from None
    where = f"{path}: from {found.old} to {found.new}"
    for name in (found.old, found.new):
        try:
            parse(name)
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from None
    if found.old == found.new:
        raise ConfigError(f"{where}: an update; allowed is an adaptation to another mechanism")
    if (found.recipe, found.placement) != (RECIPES[0], PLACEMENTS[0]):
        raise ConfigError(
            f"{where}: found recipe {found.recipe}, placement {found.placement};"
            f" allowed are {RECIPES[0]} and {PLACEMENTS[0]}"
        )
    ways: list[tuple[Pair, _OneWay]] = [((found.old, found.new), found)]
    if found.back is not None:
        ways.append(((found.new, found.old), found.back))
    each = math.ceil(found.adaptations / len(ways))
    return {pair: AdaptationTime(one.blackout_ms.p50, one.total_ms.p50, each) for pair, one in ways}

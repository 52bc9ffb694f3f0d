"""`aftbed bench paper`: every figure of the paper's Section IV that is sourced here, beside ours, measured
now.

A row is one figure: the paper's range, our quantiles, and the bare ring of 12 hops (the hops of a request
under `pbr`) measured in the same run. The ratio of our median to the ring's is the one number that another
machine can be compared by. Each time is told as what it is on the road (`road`).

Differences in method, said openly: their recovery does not count detection, so ours is told with it and
without it; their adaptation stops the service while it lasts, so their one figure stands beside our
blackout and beside our whole duration, in which requests are served but for the blackout (and 0.1 s of
which is the observation that may still undo it); they measured on a machine of 2014.

A measurement that fails, as it may on a machine that is busy with other things, is begun anew, TRIES times
at most.
"""

import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Final, TypeVar

import msgspec

from aftbed.bench import placements, published
from aftbed.bench.adapt import bench_adapt
from aftbed.bench.launch import bench_launch
from aftbed.bench.paperdocument import Count, Figure, Paper, figure
from aftbed.bench.placements import Cycle, Loaded, Placed, Times, times
from aftbed.bench.recovery import bench_recovery
from aftbed.bench.road import DECELERATION_MS2, SPEED_KMH
from aftbed.bench.sweep import PLACEMENT, Sized, sized, sweep_sizes
from aftbed.campaign.ledger import here
from aftbed.core.errors import ConfigError, HarnessError
from aftbed.core.graph import PLACEMENTS
from aftbed.core.script import RECIPES

TRIES: Final = 3
CYCLES: Final = ("pbr", "lfr", "pbr+tr", "lfr+tr")
BASE: Final = "pbr"
COMPOSED: Final = "pbr+tr"
SWITCHED: Final = "lfr"
UPDATED_BYTES: Final = 1000  # the state that moves when the function is updated
STATE_FTMS: Final = ("pbr", "lfr")
LOAD_PLACEMENTS: Final = PLACEMENTS[:2]

Tell = Callable[[str], None]
Found = TypeVar("Found")


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
    rounds=5,
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


def bench_paper(effort: Effort, tell: Tell) -> Paper:
    """Measure all of it; `tell` hears what is measured next. Raises HarnessError."""
    began = time.monotonic()
    cycles = {ftm: _cycle(ftm, PLACEMENT, effort, tell) for ftm in CYCLES}
    figures = [
        *_launch(effort, tell),
        *(_of_cycle(cycle) for cycle in cycles.values()),
        *_recoveries(effort, tell),
        *_adaptations(effort, tell),
    ]
    by_recipe, fate = _recipe(effort.recipe_runs, tell)
    side_by_side = tuple(_placed(name, cycles[BASE], effort, tell) for name in PLACEMENTS)
    return Paper(
        title=published.TITLE,
        source=f"{published.PLACE}, {published.IDENTIFIER}",
        their_machine=published.MACHINE,
        environment=here(),
        quick=effort is QUICK,
        figures=(*figures, *by_recipe),
        processes=_processes(side_by_side, tell),
        placements=side_by_side,
        state=tuple(row for ftm in STATE_FTMS for row in _sizes(ftm, effort, tell)),
        load=tuple(_load(p, hz, effort, tell) for p in LOAD_PLACEMENTS for hz in effort.rates_hz),
        speed_kmh=SPEED_KMH,
        deceleration_ms2=DECELERATION_MS2,
        rospy_cycle_ms=published.ROSPY_CYCLE_MS,
        notes=(*published.NOT_SOURCED, fate),
        seconds=round(time.monotonic() - began, 1),
    )


def tried(what: str, measure: Callable[[], Found], tell: Tell) -> Found:
    """What `measure` gives. Raises HarnessError when it has failed TRIES times."""
    reason = ""
    for _ in range(TRIES):
        tell(f"{what}, again ({reason})" if reason else what)
        try:
            return measure()
        except (HarnessError, ConfigError) as error:  # a run that died refuses like one that never was
            reason = str(error)
    raise HarnessError(f"{what}: failed {TRIES} times, the last time: {reason}")


# -- the figures ----------------------------------------------------------------------------------


def _ring_us() -> float:
    return placements.ring_p50_us(BASE, PLACEMENT)


def _launch(effort: Effort, tell: Tell) -> list[Figure]:
    found = tried("initialisation", lambda: bench_launch(BASE, PLACEMENT, effort.launches), tell)
    ring_us = _ring_us()
    graph, whole = (_times(found, key) for key in ("graph_ms", "launch_ms"))
    warm = "its zygote is warm and its spares are parked"
    return [
        figure(
            "initialisation.graph",
            "initialisation: the whole graph",
            graph,
            effort.launches,
            ring_us,
            note=warm,
        ),
        figure(
            "initialisation.reply", "initialisation: command to first reply", whole, effort.launches, ring_us
        ),
    ]


def _cycle(ftm: str, placement: str, effort: Effort, tell: Tell) -> Cycle:
    return tried(
        f"cycle of {ftm}, placement {placement}",
        lambda: placements.cycle(ftm, placement, effort.requests, effort.rounds),
        tell,
    )


def _of_cycle(cycle: Cycle) -> Figure:
    ours_ms = Times(*(round(us / 1e3, 4) for us in msgspec.structs.astuple(cycle.cycle_us)))
    paper = published.CYCLE_PBR if cycle.ftm == BASE else published.CYCLE
    what = f"cycle of {cycle.ftm}, {cycle.hops} hops"
    return figure(f"cycle.{cycle.ftm}", what, ours_ms, cycle.requests, cycle.ring_us.p50, paper)


def _recoveries(effort: Effort, tell: Tell) -> list[Figure]:
    figures = []
    for ftm in STATE_FTMS:
        what = f"recovery under {ftm}"
        found = tried(what, partial(bench_recovery, ftm, PLACEMENT, effort.kills), tell)
        ring_us = _ring_us()
        whole, after = (_times(found, key) for key in ("recovery_ms", "after_detection_ms"))
        figures += [
            figure(
                f"recovery.{ftm}.after_detection",
                f"{what}, detection to the next good reply",
                after,
                effort.kills,
                ring_us,
                published.RECOVERY,
            ),
            figure(
                f"recovery.{ftm}", f"{what}, SIGKILL to the next good reply", whole, effort.kills, ring_us
            ),
        ]
    return figures


def _adaptations(effort: Effort, tell: Tell) -> list[Figure]:
    compose, switch = f"composition {BASE} to {COMPOSED}", f"switch {BASE} to {SWITCHED}"
    return [
        *_adaptation("compose", compose, COMPOSED, effort.adaptations, tell),
        *_adaptation("switch", switch, SWITCHED, effort.adaptations, tell),
        *_update(effort, tell),
    ]


def _adaptation(name: str, what: str, new: str, count: int, tell: Tell) -> list[Figure]:
    found = tried(what, lambda: bench_adapt(BASE, new, PLACEMENT, RECIPES[0], count), tell)
    return _both(name, what, _times(found, "blackout_ms"), _times(found, "total_ms"), count, _fate(found))


def _recipe(runs: int, tell: Tell) -> tuple[list[Figure], str]:
    """Each in a run of its own: it kills what is in use, so what became of it is part of the figure."""
    what = f"composition {BASE} to {COMPOSED} by the paper's recipe"
    if not runs:
        return [], f"{what}: not measured in a quick run."
    tell(what)
    blackouts, totals, ends = [], [], Counter[str]()
    for _ in range(runs):
        try:
            found = bench_adapt(BASE, COMPOSED, PLACEMENT, RECIPES[1], 1)
        except (HarnessError, ConfigError):
            ends["failed"] += 1
            continue
        blackouts.append(_times(found, "blackout_ms").p50)
        totals.append(_times(found, "total_ms").p50)
        ends["never served again"] += bool(found["stuck"])
    said = ", ".join(f"{count} {end}" for end, count in ends.items() if count) or "all served again"
    figures = _both("recipe", what, times(blackouts), times(totals), len(blackouts), "") if blackouts else []
    return figures, f"{what}: {runs} runs: {said}."


def _update(effort: Effort, tell: Tell) -> list[Figure]:
    what = f"update of the function, {UPDATED_BYTES} bytes of state"
    count = effort.adaptations
    found = tried(what, lambda: sized(BASE, UPDATED_BYTES, count, effort.state_seconds), tell)
    assert found.blackout_ms is not None and found.total_ms is not None, found.refused
    return _both("update", what, found.blackout_ms, found.total_ms, count, "under a closed loop")


def _both(name: str, what: str, blackout: Times, total: Times, count: int, note: str) -> list[Figure]:
    ring_us = _ring_us()
    return [
        figure(
            f"adapt.{name}.blackout",
            f"{what}: nobody is served",
            blackout,
            count,
            ring_us,
            published.ADAPTATION,
            note,
        ),
        figure(
            f"adapt.{name}.total",
            f"{what}: from order to end",
            total,
            count,
            ring_us,
            published.ADAPTATION,
            served=True,
        ),
    ]


def _fate(found: dict[str, object]) -> str:
    """What became of the requests meanwhile."""
    counts = msgspec.convert(found["requests"], dict[str, int])
    bad = {name: n for name, n in counts.items() if n and name != "sent"}
    said = ", ".join(f"{n} {name}" for name, n in bad.items()) or "none lost, doubled, out of order or wrong"
    stuck = f"; {found['stuck']} of {found['adaptations']} never served again" if found["stuck"] else ""
    return f"{counts['sent']} requests: {said}{stuck}"


def _times(found: dict[str, object], key: str) -> Times:
    """Of a bench's document. Of the starts it has p50 and max alone: of so few the p95 is the max."""
    given = msgspec.convert(found[key], dict[str, float])
    return msgspec.convert({"p95": given["max"], "p99": given["max"], **given}, Times)


# -- side by side, and the sweeps -----------------------------------------------------------------


def _placed(placement: str, base: Cycle, effort: Effort, tell: Tell) -> Placed:
    cycle = base if placement == PLACEMENT else _cycle(BASE, placement, effort, tell)
    seconds = effort.placement_seconds
    return tried(
        f"CPU and memory, placement {placement}",
        lambda: placements.placed(BASE, placement, seconds, cycle),
        tell,
    )


def _processes(side_by_side: tuple[Placed, ...], tell: Tell) -> tuple[Count, ...]:
    composed = tried(f"processes of {COMPOSED}", lambda: placements.processes(COMPOSED, PLACEMENT), tell)
    theirs = published.PROCESSES
    return (
        *(
            Count(BASE, p.placement, p.loaded.processes, theirs[BASE] if p.placement == PLACEMENT else None)
            for p in side_by_side
        ),
        Count(COMPOSED, PLACEMENT, composed, theirs[COMPOSED]),
    )


def _sizes(ftm: str, effort: Effort, tell: Tell) -> list[Sized]:
    updates = max(2, effort.adaptations // 4)
    return sweep_sizes(
        ftm,
        effort.sizes_bytes,
        lambda size_bytes: tried(
            f"state of {size_bytes} bytes under {ftm}",
            lambda: sized(ftm, size_bytes, updates, effort.state_seconds),
            tell,
        ),
    )


def _load(placement: str, rate_hz: float, effort: Effort, tell: Tell) -> Loaded:
    return tried(
        f"{rate_hz:g} requests a second, placement {placement}",
        lambda: placements.under_load(BASE, placement, rate_hz, effort.load_seconds),
        tell,
    )

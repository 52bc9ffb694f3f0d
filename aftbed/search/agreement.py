"""Does the simulator agree with real runs? The same experiments on both, put side by side.

Real records are grouped by what was done in them (mechanism, placement, source, faults, adaptations). For
each group the same is simulated under as many seeds as are asked for. Two things are compared: the classes of
what the faults did, and the times of recovery. They agree if no real run has a class that no seed has, and if
the real median lies between the shortest and the longest simulated time, or the simulated median between the
real ones. Where they do not, the report has the reason; what is left out here is in `docs/simulation.md`.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.errors import ConfigError
from aftbed.core.messages import Scheduled
from aftbed.core.progress import Show, unshown
from aftbed.functions.load import OWN_CODE
from aftbed.functions.request_file import GivenRequests
from aftbed.judge import checks
from aftbed.judge.checks import Evidence
from aftbed.judge.outcome import outcome_of
from aftbed.judge.record import RunRecord, read_record
from aftbed.judge.simulated import evidence_of_run
from aftbed.judge.verdict import evidence_of
from aftbed.runtime.sim.world import Run, Setup, simulate
from aftbed.runtime.unix.options import CarRun, LoadRun
from aftbed.runtime.unix.trust import NOBODY, Trust, vetted

SEEDS: Final = 20


class RecoveryRange(msgspec.Struct, frozen=True):
    """Of recoveries: fault to the first reply of the new master, in ms."""

    count: int
    low_ms: float
    median_ms: float
    high_ms: float


class Agreement(msgspec.Struct, frozen=True):
    """One group. `why_not` is empty where both agree."""

    experiment: str
    real: dict[str, int]  # classes, and how many runs have each
    simulated: dict[str, int]
    real_recovery: RecoveryRange | None
    simulated_recovery: RecoveryRange | None
    why_not: tuple[str, ...]


def against(
    paths: Iterable[Path], seeds: int = SEEDS, trust: Trust = NOBODY, show: Show = unshown
) -> list[Agreement]:
    """Compare the records in `paths`; `show` gets how many of the simulations are done.

    Raises ConfigError where one is none, cannot be simulated, or names a function that is not trusted.
    """
    groups: dict[Setup, list[RunRecord]] = {}
    for path in paths:
        record = read_record(path)
        if record.options.application:
            vetted(record.options.application, trust)
        groups.setdefault(setup_of(record), []).append(record)
    return [
        _compare(setup, records, seeds, trust, partial(_shown, show, number * seeds, len(groups) * seeds))
        for number, (setup, records) in enumerate(groups.items())
    ]


def _shown(show: Show, before: int, total: int, done: int) -> None:
    show(before + done, total)


def setup_of(record: RunRecord) -> Setup:
    """The same experiment for the simulator, its seed left out."""
    options = record.options
    adaptations = tuple(Scheduled(a.goal, a.at_request, a.after_ms) for a in options.adaptations)
    if any(a.goal.part or a.goal.script for a in adaptations):
        raise ConfigError(f"{record.path}: an update or a hand-written script is not simulated")
    same = Setup(
        options.ftm,
        options.placement,
        faults=options.faults,
        adaptations=adaptations,
        application=options.application,
    )
    match options.work:
        case LoadRun(count, rate_hz) as load:
            given = _given(record, load.requests) if load.requests else None
            return msgspec.structs.replace(same, count=count, rate_hz=rate_hz, given=given)
        case CarRun(duration_ms=int()):
            raise ConfigError(f"{record.path}: a drive of --duration is not simulated")
        case CarRun() as car:
            return msgspec.structs.replace(same, scenario=car.scenario)
        case _:
            raise ConfigError(f"{record.path}: a replay is not simulated")


def _given(record: RunRecord, source: str) -> GivenRequests:
    if record.given is None:
        raise ConfigError(f"{record.path}: its requests are missing, so it is not simulated")
    return GivenRequests(source, record.given)


def _compare(
    setup: Setup, records: list[RunRecord], seeds: int, trust: Trust, show: Callable[[int], None]
) -> Agreement:
    def simulated() -> Iterator[Run]:
        for seed in range(seeds):
            yield simulate(msgspec.structs.replace(setup, seed=seed), OWN_CODE)
            show(seed + 1)

    real_classes, real_times = _summed(evidence_of(record, trust=trust) for record in records)
    sim_classes, sim_times = _summed(evidence_of_run(run, OWN_CODE) for run in simulated())
    found = [
        f"no seed ends {word}, as {n} real runs do"
        for word, n in real_classes.items()
        if word not in sim_classes
    ]
    return Agreement(
        _words(setup),
        dict(sorted(real_classes.items())),
        dict(sorted(sim_classes.items())),
        real_times,
        sim_times,
        (*found, *apart(real_times, sim_times)),
    )


def _summed(runs: Iterable[Evidence]) -> tuple[Counter[str], RecoveryRange | None]:
    """The classes of outcomes, and the times of recovery."""
    classes, times_ms = Counter[str](), list[float]()
    for run in runs:
        classes[outcome_of(run)[0]] += 1
        failovers = checks.failovers(run.record.history, run.record.faults)
        times_ms += [f.recovered_ms for f in failovers if f.recovered_ms is not None]
    if not times_ms:
        return classes, None
    times_ms.sort()
    median_ms = times_ms[len(times_ms) // 2]
    return classes, RecoveryRange(len(times_ms), times_ms[0], median_ms, times_ms[-1])


def apart(real: RecoveryRange | None, simulated: RecoveryRange | None) -> list[str]:
    """Why the times do not agree; empty if they do."""
    if real is None or simulated is None:
        return [] if real is simulated else ["only one of them has failovers"]
    inside = simulated.low_ms <= real.median_ms <= simulated.high_ms
    if inside or real.low_ms <= simulated.median_ms <= real.high_ms:
        return []
    return [
        f"recovery: real median {real.median_ms} ms, simulated {simulated.low_ms} to {simulated.high_ms} ms"
    ]


def _words(setup: Setup) -> str:
    source = setup.scenario or f"{setup.count} requests" + (
        f" at {setup.rate_hz:g} Hz" if setup.rate_hz else ""
    )
    changes = [f"to {a.goal.expression} at request {a.at_request}" for a in setup.adaptations]
    return "; ".join((f"{setup.ftm} {setup.placement}, {source}", *map(str, setup.faults), *changes))

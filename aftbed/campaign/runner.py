"""A campaign carried out: its plan, or what is left of it, over some processes, until enough is known.

A worker is a process that performs one experiment after the other and appends each result to the ledger
itself. What ends a campaign early (its own stop rule, an interrupt, a `kill -9`) leaves a ledger that can be
gone on with.

A simulated experiment has all replicas and the judge in its worker. A function of the user that crashes in
native code, or hangs, ends or blocks all of them; so its experiment is performed on real processes instead,
where only a replica fails, and the mechanism has to act.
"""

import itertools
import os
import time
from collections import Counter
from collections.abc import Generator, Iterator
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import Final

import msgspec

from aftbed.campaign import ledger
from aftbed.campaign.experiment import REQUESTS_PER_SECOND_MIN, Experiment, Result, carry_out
from aftbed.campaign.plan import CampaignPlan
from aftbed.core.errors import ConfigError, HarnessError
from aftbed.runtime.unix.worker_pool import SECONDS_MAX, each, once, own_seconds_max

REALLY_MAX: Final = 200  # experiments of a simulated campaign; each takes a second
SIMULATOR_ENDED: Final = "the function ends or blocks the simulator"


class CampaignRunOptions(msgspec.Struct, frozen=True):
    """How to go about it; `out` is the directory of the campaign."""

    out: Path
    jobs: int = 1
    shard: int = 1
    shards: int = 1
    resume: bool = False
    scheduler: str = ""  # address of a Dask scheduler, in the place of `jobs` processes

    def has(self, index: int, strata: int) -> bool:
        """Whether an experiment is of this shard: each shard has its part of every stratum."""
        number, place = divmod(index, strata)
        return (number + place) % self.shards == self.shard - 1


def run(plan: CampaignPlan, asked: CampaignRunOptions) -> Generator[Result, None, None]:
    """Each result as soon as it is in the ledger. Raises ConfigError before anything runs."""
    stop = plan.spec.stop
    if asked.shards > 1 and (stop.half_width is not None or stop.first_failure):
        key = "half_width" if stop.half_width is not None else "first_failure"
        raise ConfigError(
            f"--shard: stop.{key} looks at all results, a shard sees only its own: leave it out"
        )
    if asked.scheduler:
        from aftbed.campaign import dask  # noqa: PLC0415 - an extra

        dask.connect(asked.scheduler).close()  # before anything is written
    path = asked.out / ledger.NAME
    head = ledger.head_of(plan, asked.shard, asked.shards)
    if asked.resume:
        ledger.resume(path, head)
    else:
        try:
            asked.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"--out {asked.out}: cannot be made: {error.strerror}") from None
        ledger.begin(path, head)
    return _results(plan, asked, path)


def _results(plan: CampaignPlan, asked: CampaignRunOptions, path: Path) -> Generator[Result, None, None]:
    stop = plan.spec.stop
    limit_s = time.monotonic() + stop.minutes * 60 if stop.minutes is not None else None
    state = _Progress(plan, path)
    looks = min(stop.looks, stop.experiments) if stop.half_width is not None else 1
    edges = [round(stop.experiments * look / looks) for look in range(looks + 1)]
    for first, last in itertools.pairwise(edges):  # parts of the numbers of each stratum, a look after each
        todo = (e for e in state.open(first, last) if asked.has(e.index, len(plan.strata)))
        with closing(performed(todo, path, asked, plan)) as results:
            for result in results:
                state.add(result)
                yield result
                late = limit_s is not None and time.monotonic() > limit_s
                if late or (stop.first_failure and result.unexpected):
                    return


def performed(
    todo: Iterator[Experiment], path: Path, asked: CampaignRunOptions, plan: CampaignPlan
) -> Generator[Result, None, None]:
    """Each result, which is in the ledger by then."""
    if not asked.scheduler:
        perform = partial(_perform, os.fspath(path))
        system = plan.spec.system
        # An experiment that takes more hangs; real ones have deadlines of their own, and end before.
        seconds_max = SECONDS_MAX + 2 * system.requests / (system.rate_hz or REQUESTS_PER_SECOND_MIN)
        fresh = system.runtime == "unix"
        apart = bool(system.app)
        if apart and not fresh:
            seconds_max = own_seconds_max(system.requests)
        really = _Really(path, plan, seconds_max) if apart and not fresh else None
        found = each(
            perform,
            todo,
            asked.jobs,
            alone=_alone,
            seconds_max=seconds_max,
            fresh=fresh,
            apart=apart,
            instead=really,
        )
        with closing(found):
            for _, _, result in found:
                yield result
        return
    from aftbed.campaign import dask  # noqa: PLC0415 - an extra

    descriptor = ledger.opened(path)
    try:
        with dask.connect(asked.scheduler) as client, closing(dask.over(client, todo)) as results:
            for result in results:
                ledger.append(descriptor, result)
                yield result
    finally:
        os.close(descriptor)


def _alone(number: int, experiment: Experiment) -> str:
    return experiment.command()


def _perform(path: str, experiment: Experiment) -> Result:
    """In a worker."""
    descriptor = ledger.opened(Path(path))
    try:
        keep = partial(ledger.append, descriptor)
        return carry_out(experiment, keep, records=Path(path).parent / ledger.RECORDS)
    finally:
        os.close(descriptor)


class _Really:
    """Performs on real processes what has ended, or blocked, its simulator."""

    def __init__(self, path: Path, plan: CampaignPlan, seconds_max: float) -> None:
        self._path, self._plan, self._seconds_max = path, plan, seconds_max
        self._left = REALLY_MAX

    def __call__(self, experiment: Experiment, how: str) -> Result:
        """Raises HarnessError."""
        kept = (r for r in ledger.read(self._path).results if r.experiment.id == experiment.id)
        if (result := next(kept, None)) is not None:  # it ended behind its experiment
            return result
        if not self._left:
            raise HarnessError(
                f"{self._plan.spec.system.app}: it has ended, or blocked, more than {REALLY_MAX} simulations;"
                f" that of `{experiment.command()}` {how}: `--runtime unix` runs all on real processes"
            )
        self._left -= 1
        real = msgspec.structs.replace(experiment, runtime="unix")
        perform = partial(_perform_really, os.fspath(self._path), how)
        return once(perform, real, self._seconds_max, fresh=True, alone=_alone)


def _perform_really(path: str, how: str, experiment: Experiment) -> Result:
    """In a worker."""
    reason = f"{SIMULATOR_ENDED}: its process {how}; this is of a run of real processes"
    with ExitStack() as standing:
        descriptor = ledger.opened(Path(path))
        standing.callback(os.close, descriptor)
        kept: list[Result] = []

        def keep(result: Result) -> None:
            kept.append(msgspec.structs.replace(result, reasons=(reason, *result.reasons)))
            ledger.append(descriptor, kept[0])

        carry_out(experiment, keep)
        return kept[0]


class _Progress:
    """What has been done, and which strata are known well enough."""

    def __init__(self, plan: CampaignPlan, path: Path) -> None:
        self._plan = plan
        results = ledger.read(path).results
        self._earlier = frozenset(result.experiment.id for result in results)
        self._count = Counter[str]()
        self._unexpected = Counter[str]()
        for result in results:
            self.add(result)

    def add(self, result: Result) -> None:
        self._count[result.experiment.stratum] += 1
        self._unexpected[result.experiment.stratum] += result.unexpected

    def open(self, first: int, last: int) -> Iterator[Experiment]:
        """What is left to do with numbers from `first` to before `last`."""
        strata = [(i, s) for i, s in enumerate(self._plan.strata) if not self._settled(s.name, first)]
        for number in range(first, last):
            for place, stratum in strata:
                index = number * len(self._plan.strata) + place
                experiment = self._plan.experiment(index, number, stratum)
                if experiment.id not in self._earlier:
                    yield experiment

    def _settled(self, name: str, looked_at: int) -> bool:
        wanted = self._plan.spec.stop.half_width
        if wanted is None or not looked_at:
            return False
        from aftbed.campaign.statistics import half_width, proportion  # noqa: PLC0415 - not for workers
        from aftbed.campaign.summary import confidence_of  # noqa: PLC0415

        confidence = confidence_of(self._plan.spec)
        interval = proportion(self._unexpected[name], self._count[name], confidence)
        return half_width(interval) <= wanted

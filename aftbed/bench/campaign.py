"""The number of experiments a minute of a campaign: 100 requests, one crash of the primary, and the verdict.

Everything counts, from the start of the workers to the last line in the ledger. `cpu_ms` is the CPU time of
all processes of an experiment: it distinguishes a slow machine from one that has other work, too.

Each round is a campaign of its own, with its own seed. The limit is what an experiment cannot do without, in
as many processes side by side as the campaign has jobs:

- on real processes, to fork as many processes as the graph has nodes, and the supervisor, and to wait for
  their end;
- in the simulator, to have the bare function answer as many requests as an experiment has.

Both are in ms for each experiment, as `experiment_ms` is: with two jobs on two cores, it is half of what one
experiment takes.
"""

import os
import resource
import signal
import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, Literal, NamedTuple

from aftbed.bench.rounds import ROUNDS, InRounds, beside_limit, in_turn, shares
from aftbed.campaign import runner
from aftbed.campaign.experiment import Result
from aftbed.campaign.plan import plan
from aftbed.campaign.spec import FaultEntry, Spec, StopRule, System, check
from aftbed.campaign.statistics import quantile
from aftbed.core.errors import HarnessError
from aftbed.core.progress import Show, unshown
from aftbed.ftm.compose import build
from aftbed.runtime.unix import interrupts, linux
from aftbed.runtime.unix.interrupts import scratch_directory
from aftbed.vehicle.aeb.function import default_application, sample_requests

LIMIT_SECONDS_MAX: Final = 60.0
LIMIT_TIMES_MAX: Final = 400  # that it is done for a round, so that one of any size keeps to the deadline
BARE_TIMES: Final = 10  # that the requests of a simulated experiment are answered: once takes a millisecond
CRASH: Final = FaultEntry("crash primary", "crash primary at server.exit nth {nth}", draw={"nth": (1, 90)})


class CampaignResult(InRounds, frozen=True):
    """The document of `aftbed bench campaign`; `cpu_ms` per experiment, `experiment_ms` the median round."""

    ftm: str
    placement: str
    runtime: str
    jobs: int
    cpus: int
    experiments: int
    outcomes: dict[str, int]
    noisy: int  # experiments during which the machine was too busy for times to mean anything
    seconds: float
    per_minute: int
    cpu_ms: float
    experiment_ms: float


class _Part(NamedTuple):
    """A round: a campaign of some experiments."""

    results: list[Result]
    seconds: float
    cpu_s: float


def bench_campaign(
    ftm: str,
    placement: str,
    runtime: Literal["unix", "sim"],
    experiments: int,
    jobs: int,
    *,
    rounds: int = ROUNDS,
    show: Show = unshown,
) -> CampaignResult:
    """Carry out campaigns of one stratum, a round each. Raises ConfigError."""
    share = shares(experiments, rounds)
    system = System(placements=(placement,), runtime=runtime)
    specs = [
        Spec("bench", (ftm,), (CRASH,), system=system, stop=StopRule(count), seed=seed)
        for seed, count in enumerate(share, 1)
    ]
    check(specs[0])
    processes = len(build(ftm, placement).nodes) + 1

    def limit(number: int) -> float:
        times = min(share[number], LIMIT_TIMES_MAX)
        if runtime == "unix":
            return limit_ms(partial(fork_and_wait, processes), times, jobs)
        return limit_ms(partial(answer, sample_requests(0, system.requests)), BARE_TIMES * times, jobs)

    found = in_turn(len(share), lambda number: _carried_out(specs[number], jobs), limit, show=show)
    times = [1e3 * one.seconds / len(one.results) for one in found.figures]
    name = f"fork and wait of {processes} processes" if runtime == "unix" else "its requests, bare"
    beside = beside_limit(name, [[ms] for ms in times], [[ms] for ms in found.limits])
    results = [result for one in found.figures for result in one.results]
    seconds, cpu_s = sum(one.seconds for one in found.figures), sum(one.cpu_s for one in found.figures)
    return CampaignResult(
        ftm,
        placement,
        runtime,
        jobs,
        cpus=len(os.sched_getaffinity(0)),
        experiments=experiments,
        outcomes=dict(Counter(result.outcome for result in results)),
        noisy=sum(result.noisy for result in results),
        seconds=round(seconds, 1),
        per_minute=round(60 * experiments / seconds),
        cpu_ms=round(cpu_s / experiments * 1e3, 1),
        experiment_ms=round(quantile(times, 0.5), 2),
        limit=beside.limit,
        ratio=beside.ratio,
        machine=found.machine,
    )


def _carried_out(spec: Spec, jobs: int) -> _Part:
    planned = plan(spec)
    with scratch_directory("aftbed-bench-") as folder:
        began_s, began_cpu_s = time.monotonic(), _cpu_s()
        asked = runner.CampaignRunOptions(folder / "campaign", jobs)
        results = list(runner.run(planned, asked))
        seconds, cpu_s = time.monotonic() - began_s, _cpu_s() - began_cpu_s
    if len(results) != spec.stop.experiments:
        raise HarnessError(f"{len(results)} of {spec.stop.experiments} experiments have a result")
    return _Part(results, seconds, cpu_s)


def limit_ms(once: Callable[[], None], times: int, jobs: int) -> float:
    """Do `once` so many times, by `jobs` processes: ms for each time.

    Raises HarnessError if one of them fails.
    """
    parent = os.getpid()
    began_s = time.monotonic()
    workers = [_fork_worker(parent, once, count) for count in shares(times, jobs)]
    statuses = [os.waitpid(worker, 0)[1] for worker in workers]
    seconds = time.monotonic() - began_s
    if any(statuses):
        raise HarnessError(f"the limit: not done within {LIMIT_SECONDS_MAX:g} s, or no process was left")
    return 1e3 * seconds / times


def _fork_worker(parent: int, once: Callable[[], None], times: int) -> int:
    pid = interrupts.fork()
    if pid:
        return pid
    code = 1
    try:
        linux.die_with(parent)
        signal.setitimer(signal.ITIMER_REAL, LIMIT_SECONDS_MAX)  # ends the process: the signal has no handler
        for _ in range(times):
            once()
        code = 0
    finally:
        os._exit(code)


def fork_and_wait(processes: int) -> None:
    """Fork so many processes, which end at once, and wait for them."""
    children = []
    for _ in range(processes):
        child = os.fork()
        if child == 0:
            os._exit(0)
        children.append(child)
    for child in children:
        os.waitpid(child, 0)


def answer(requests: Sequence[bytes]) -> None:
    """Have a fresh built-in function answer these."""
    function = default_application()
    for request in requests:
        function.execute(request)


def _cpu_s() -> float:
    """Of this process, and of all its descendants that have ended."""
    used = (resource.getrusage(scope) for scope in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(one.ru_utime + one.ru_stime for one in used)

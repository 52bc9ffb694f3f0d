"""The number of experiments a minute of a campaign: 100 requests, one crash of the primary, and the verdict.

Everything counts, from the start of the workers to the last line in the ledger. `cpu_ms` is the CPU time of
all processes of an experiment: it distinguishes a slow machine from one that has other work, too.
"""

import os
import resource
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Final, Literal

import msgspec

from aftbed.campaign import runner
from aftbed.campaign.plan import plan
from aftbed.campaign.spec import FaultEntry, Spec, StopRule, System, check

CRASH: Final = FaultEntry("crash primary", "crash primary at server.exit nth {nth}", draw={"nth": (1, 90)})


class CampaignResult(msgspec.Struct, frozen=True):
    """The document of `aftbed bench campaign`; `cpu_ms` per experiment."""

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


def bench_campaign(
    ftm: str, placement: str, runtime: Literal["unix", "sim"], experiments: int, jobs: int
) -> CampaignResult:
    """Carry out a campaign of one stratum. Raises ConfigError."""
    system = System(placements=(placement,), runtime=runtime)
    spec = Spec("bench", (ftm,), (CRASH,), system=system, stop=StopRule(experiments))
    check(spec)
    planned = plan(spec)
    with tempfile.TemporaryDirectory(prefix="aftbed-bench-") as folder:
        began_s, began_cpu_s = time.monotonic(), _cpu_s()
        asked = runner.CampaignRunOptions(Path(folder) / "campaign", jobs)
        results = list(runner.run(planned, asked))
        seconds, cpu_s = time.monotonic() - began_s, _cpu_s() - began_cpu_s
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
    )


def _cpu_s() -> float:
    """Of this process, and of all its descendants that have ended."""
    used = (resource.getrusage(scope) for scope in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(one.ru_utime + one.ru_stime for one in used)

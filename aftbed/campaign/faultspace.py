"""From the experiments of a campaign to the whole fault space: failure counts, and coverage.

The fault space is all faults that the fault model allows: every event at which a crash can be aimed, every
bit of every request. A campaign samples it, a stratum at a time (a target, a place, an event), and rarely
each stratum in proportion to its size. So what was seen is weighed by the `population` of its stratum, the
faults that it holds; the sum is the unbiased estimate (Powell, Martins, Arlat and Crouzet, "Estimators for
Fault Tolerance Coverage Evaluation", IEEE Trans. Computers 44, 1995).

**Counts beside coverage.** Coverage is the share of the faults that does no harm. It may be compared
between campaigns over one and the same fault space only: a mechanism that doubles the state, or the time,
doubles the faults, most of them harmless, and so "improves" its coverage while as many faults as before do
harm. What compares is the number of failures, extrapolated to the fault space (Schirmeier, Borchert and
Spinczyk, "Avoiding Pitfalls in Fault-Injection Based Comparison of Program Susceptibility to Soft Errors",
DSN 2015). Coverage is one minus that number over the population; both come with the same interval.

**The interval of the sum** is made out of those of the strata (MOVER, the method of variance estimates
recovery: Zou, Huang and Zhang, "A note on confidence interval estimation for a linear function of binomial
proportions", Computational Statistics and Data Analysis 53, 2009): the distances from each estimate to its
bound are added as independent errors are, by their squares, each bound by itself. With one stratum it is the
interval of that stratum; with none failed it still has a width, which a normal approximation has not (Cukier,
Powell and Arlat, "Coverage Estimation Methods for Stratified Fault Injection", IEEE Trans. Computers 48,
1999). It is no guarantee, as the Clopper-Pearson intervals are that it is made of: enumerated over 14 400
cases of two strata, nominal 95 % are 98.5 % on average, less than 95 % in one case of a thousand, and 92.7 %
at worst (30 experiments a stratum, 1 % failures). That is the lower bound's; the upper one of the failures,
which a gate is about, left out 2.4 % at most where no more than half of a stratum fails. Where every bound
has to hold for certain, put the gate on the strata.

A stratum that was not sampled can hold anything between no failure and nothing else: its whole population is
added to the upper bound, and there is no estimate. Experiments that are known to be `distinct` faults (drawn
without replacement, on a deterministic system) can be counted on: a stratum tried whole has no width left.
"""

import math
from collections.abc import Sequence

import msgspec

from aftbed.campaign.statistics import CONFIDENCE, METHOD, Interval, proportion


class Stratum(msgspec.Struct, frozen=True):
    """`failures` of `sampled` experiments failed, which were drawn out of `population` faults."""

    failures: int
    sampled: int
    population: int


class Count(msgspec.Struct, frozen=True):
    """How many faults of the fault space do harm; `failures` is None if a stratum was not sampled."""

    failures: float | None
    interval: Interval


class Coverage(msgspec.Struct, frozen=True):
    """Which share of the fault space does no harm; `share` is None if a stratum was not sampled."""

    share: float | None
    interval: Interval


def extrapolated(
    failures: int,
    sampled: int,
    population: int,
    confidence: float = CONFIDENCE,
    method: str = METHOD,
    distinct: bool = False,
) -> Count:
    """The failures in a fault space that was sampled as one."""
    return extrapolated_sum([Stratum(failures, sampled, population)], confidence, method, distinct)


def extrapolated_sum(
    strata: Sequence[Stratum], confidence: float = CONFIDENCE, method: str = METHOD, distinct: bool = False
) -> Count:
    """The failures in a fault space that was sampled by strata."""
    known = [stratum for stratum in strata if stratum.sampled > 0]
    intervals = [_failures(stratum, confidence, method, distinct) for stratum in known]
    estimates = [stratum.population * stratum.failures / stratum.sampled for stratum in known]
    unknown = sum(stratum.population for stratum in strata if stratum.sampled == 0)
    total, pairs = math.fsum(estimates), list(zip(estimates, intervals, strict=True))
    low = total - math.hypot(*(estimate - interval.low for estimate, interval in pairs))
    high = total + math.hypot(*(interval.high - estimate for estimate, interval in pairs)) + unknown
    population = sum(stratum.population for stratum in strata)
    within = Interval(max(0.0, low), min(float(population), high))
    return Count(None if unknown else total, within)


def coverage(
    strata: Sequence[Stratum], confidence: float = CONFIDENCE, method: str = METHOD, distinct: bool = False
) -> Coverage:
    """The share of a fault space, sampled by strata, that does no harm; of no faults at all, it is 0 to 1."""
    population = sum(stratum.population for stratum in strata)
    if population == 0:
        return Coverage(None, Interval(0.0, 1.0))
    count = extrapolated_sum(strata, confidence, method, distinct)
    within = Interval(1 - count.interval.high / population, 1 - count.interval.low / population)
    return Coverage(None if count.failures is None else 1 - count.failures / population, within)


def _failures(stratum: Stratum, confidence: float, method: str, distinct: bool) -> Interval:
    """How many faults of one stratum do harm."""
    assert 0 <= stratum.failures <= stratum.sampled and stratum.population >= 0, stratum
    share = proportion(stratum.failures, stratum.sampled, confidence, method)
    low, high = share.low * stratum.population, share.high * stratum.population
    if not distinct:
        return Interval(low, high)
    assert stratum.sampled <= stratum.population, f"not distinct: {stratum}"
    harmless = stratum.sampled - stratum.failures
    return Interval(max(low, stratum.failures), min(high, stratum.population - harmless))

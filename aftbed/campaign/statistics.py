"""What a sample of experiments says about all of them: intervals of shares and of quantiles.

A campaign tries some faults out of very many, so its numbers are estimates, and a gate judges the bound
of an interval and never the estimate. What is estimated is mostly close to 0 or to 1 (a mechanism that
holds fails seldom), where the normal approximation (Wald) is wrong: 0 of 1000 would have no width at all,
"so the mechanism never fails". So it does not exist here (Brown, Cai and DasGupta, "Interval estimation
for a binomial proportion", Statistical Science 16, 2001; Newcombe, Statistics in Medicine 17, 1998).

Shares:
- `clopper-pearson`, the default, inverts the exact binomial test (Biometrika 26, 1934). It holds its
  confidence for every share there may be, and pays with some width: what a gate needs.
- `wilson` inverts the score test (JASA 22, 1927). It is narrower and holds its confidence on the average
  over the shares: for reports and for planning.
Both bounds leave out (1 - confidence) / 2, so each is a one-sided bound as well, of 97.5 % for 95 %.

Quantiles of times, of which little can be assumed (two modes, a long tail):
- `quantile_interval` takes two of the measured values as bounds, by their ranks: how many of n values lie
  below the true quantile is binomial, whatever the distribution is (David and Nagaraja, "Order Statistics",
  section 7.1; Hahn and Meeker, "Statistical Intervals", chapter 5). It needs no chance and holds its
  confidence at every n; equal values make it wider, never wrong. So it is the default.
- `bootstrap_interval` is the percentile bootstrap (Efron, Annals of Statistics 7, 1979). It is a bit
  narrower, since it promises less: of nominal 95 %, a p99 of 500 values gets 87 %, of 1000 values 93 %, of
  10 000 values 95 %. For reports that are to be compared with such.
Both are None where no value can bound the quantile: of 367 values all are below the p99 with more than
2.5 % probability, so nothing that was measured is an upper bound, at 95 %. `quantile_needs` says how many.

Looks: a campaign that looks K times and stops when it has enough errs more often than stated.
`look_confidence` is Bonferroni's (Dunn, JASA 56, 1961): at each of K looks, declared beforehand, the
intervals have confidence 1 - (1 - confidence) / K, so that all K hold at once with `confidence`, and the one
at which the campaign stops is among them, whatever made it stop. Pocock's and O'Brien and Fleming's bounds
are less strict (5 looks: Pocock 0.0158 where Bonferroni takes 0.01), but assume a normal statistic and looks
at equal distances, which counts of rare failures are not (Jennison and Turnbull, "Group Sequential
Methods", 2000).

Limits: the experiments of a sample are independent and alike. Those of different strata are not alike:
`faultspace` weighs them.
"""

import math
from bisect import bisect_left
from collections.abc import Callable, Sequence
from random import Random
from statistics import NormalDist
from typing import Final, TypeVar

import msgspec

from aftbed.core.errors import ConfigError, unknown

CONFIDENCE: Final = 0.95
METHOD: Final = "clopper-pearson"
RESAMPLES: Final = 2000
BEYOND_MIN: Final = 5  # resamples beyond each bound of a bootstrap interval; fewer say nothing
HALF_WIDTH_MIN: Final = 1e-5  # narrower takes up to 10^10 experiments and more

Value = TypeVar("Value", int, float)


class Interval(msgspec.Struct, frozen=True):
    """From `low` to `high`, both of them within."""

    low: float
    high: float


def proportion(count: int, of: int, confidence: float = CONFIDENCE, method: str = METHOD) -> Interval:
    """The interval of a share of which `count` in `of` experiments were seen; of none, it is 0 to 1."""
    assert 0 <= count <= of, f"{count} of {of}"
    return _share_interval(count, of, tail(confidence), method)


def half_width(interval: Interval) -> float:
    """Half the width: what a stop rule is about. The estimate need not lie in the middle."""
    return (interval.high - interval.low) / 2


def needed(
    expected_share: float, half_width: float, confidence: float = CONFIDENCE, method: str = METHOD
) -> int:
    """How many experiments it takes until the interval has this half-width, if the share is as expected.

    For a plan: what is counted is a whole number and seldom exactly what was expected.
    """
    if not 0 <= expected_share <= 1:
        raise ConfigError(f"expected_share {expected_share:g}: 0 to 1 is allowed")
    if not HALF_WIDTH_MIN <= half_width < 0.5:
        raise ConfigError(f"half_width {half_width:g}: {HALF_WIDTH_MIN:g} to less than 0.5 is allowed")
    beyond = tail(confidence)

    def narrow(of: int) -> bool:
        interval = _share_interval(expected_share * of, of, beyond, method)
        return (interval.high - interval.low) / 2 <= half_width

    enough = 1
    while not narrow(enough):
        enough *= 2
    return 1 + bisect_left(range(1, enough + 1), True, key=narrow)


def look_confidence(confidence: float, looks: int) -> float:
    """The confidence that the interval at each of `looks` looks takes, for all to hold with `confidence`."""
    beyond = 2 * tail(confidence)
    if looks < 1:
        raise ConfigError(f"looks {looks}: at least 1 is allowed")
    return 1 - beyond / looks


def quantile(values: Sequence[Value], share: float) -> Value:
    """The value that `share` of `values` do not exceed, by nearest rank: always one of the values.

    Of share 0 it is the least one. The benches take it too, and they fork the supervisors that they measure.
    So this module imports scipy (30 MB) only inside of the functions that need it.
    """
    assert values and 0 <= share <= 1
    ordered = sorted(values)
    return ordered[max(0, math.ceil(share * len(ordered)) - 1)]


def quantile_interval(values: Sequence[float], q: float, confidence: float = CONFIDENCE) -> Interval | None:
    """The interval of the q-quantile, between two of the values; None if there are too few for one."""
    from scipy import special  # noqa: PLC0415 - heavy: see `quantile`

    beyond, ordered = tail(confidence), _ordered(values, q)
    size = len(ordered)
    # The true quantile lies below the value of rank r if fewer than r of all values lie below it.
    below = bisect_left(range(size), True, key=lambda k: bool(special.bdtr(k, size, q) > beyond))
    above = bisect_left(range(size), True, key=lambda k: bool(special.bdtrc(k, size, q) <= beyond))
    return Interval(ordered[below - 1], ordered[above]) if below >= 1 and above < size else None


def quantile_needs(q: float, confidence: float = CONFIDENCE) -> int:
    """The smallest number of values of which `quantile_interval` is not None."""
    _check_quantile(q)
    return math.ceil(math.log(tail(confidence)) / math.log(max(q, 1 - q)))


def bootstrap_interval(
    values: Sequence[float],
    q: float,
    chance: Random,
    confidence: float = CONFIDENCE,
    resamples: int = RESAMPLES,
) -> Interval | None:
    """The interval of the q-quantile by percentile bootstrap; None if there are too few values for one.

    A resample need not be drawn whole: its quantile is a value of the sample, and the rank of that value is
    drawn at once, from the distribution that the m-th smallest of n draws has (a beta distribution).
    """
    beyond, ordered = tail(confidence), _ordered(values, q)
    check_resamples(resamples, confidence)
    size = len(ordered)
    if size < quantile_needs(q, confidence):
        return None
    smallest = 1 + place(size, q)
    drawn = (chance.betavariate(smallest, size + 1 - smallest) for _ in range(resamples))
    found = [ordered[min(size - 1, math.floor(share * size))] for share in drawn]
    return Interval(quantile(found, beyond), quantile(found, 1 - beyond))


def place(size: int, q: float) -> int:
    """The index of the q-quantile among `size` values in order: that of `quantile`."""
    return quantile(range(size), q)


def tail(confidence: float) -> float:
    """What an interval of this confidence leaves out on each side."""
    if not 0 < confidence < 1:
        raise ConfigError(f"confidence {confidence:g}: more than 0 and less than 1 is allowed, 0.95 is usual")
    return (1 - confidence) / 2


def check_resamples(resamples: int, confidence: float) -> None:
    """Raises ConfigError if there are too few resamples for this confidence."""
    least = math.ceil(BEYOND_MIN / tail(confidence) - 1e-6)  # 100 at 0.9, whose tail is 0.0499...
    if resamples < least:
        raise ConfigError(f"resamples {resamples}: at least {least} are allowed at confidence {confidence:g}")


def _check_quantile(q: float) -> None:
    if not 0 < q < 1:
        raise ConfigError(f"quantile {q:g}: more than 0 and less than 1 is allowed, 0.99 for p99")


def _ordered(values: Sequence[float], q: float) -> list[float]:
    _check_quantile(q)
    assert not any(math.isnan(value) for value in values), "a time that is no number"
    return sorted(values)


def _share_interval(count: float, of: int, beyond: float, method: str) -> Interval:
    if method not in _METHODS:
        raise unknown("interval method", method, _METHODS)
    if of == 0:
        return Interval(0.0, 1.0)
    interval = _METHODS[method](count, of, beyond)
    return Interval(interval.low if count > 0 else 0.0, interval.high if count < of else 1.0)


def _clopper_pearson(count: float, of: int, beyond: float) -> Interval:
    from scipy import special  # noqa: PLC0415 - heavy: see `quantile`

    low = special.betaincinv(count, of - count + 1, beyond) if count > 0 else 0.0
    high = 1 - special.betaincinv(of - count, count + 1, beyond) if count < of else 1.0
    return Interval(float(low), float(high))


def _wilson(count: float, of: int, beyond: float) -> Interval:
    share, z = count / of, NormalDist().inv_cdf(1 - beyond)
    middle = share + z * z / (2 * of)
    reach = z * math.sqrt(share * (1 - share) / of + z * z / (4 * of * of))
    scale = 1 + z * z / of
    return Interval((middle - reach) / scale, (middle + reach) / scale)


_METHODS: Final[dict[str, Callable[[float, int, float], Interval]]] = {
    "clopper-pearson": _clopper_pearson,
    "wilson": _wilson,
}


# -- From the experiments of a campaign to the whole fault space: failure counts, and coverage.
#
# The fault space is all faults that the fault model allows: every event at which a crash can be aimed,
# every
# bit of every request. A campaign samples it, a stratum at a time (a target, a place, an event), and rarely
# each stratum in proportion to its size. So what was seen is weighed by the `population` of its stratum,
# the
# faults that it holds; the sum is the unbiased estimate (Powell, Martins, Arlat and Crouzet, "Estimators
# for
# Fault Tolerance Coverage Evaluation", IEEE Trans. Computers 44, 1995).
#
# **Counts beside coverage.** Coverage is the share of the faults that does no harm. It may be compared
# between campaigns over one and the same fault space only: a mechanism that doubles the state, or the time,
# doubles the faults, most of them harmless, and so "improves" its coverage while as many faults as before
# do
# harm. What compares is the number of failures, extrapolated to the fault space (Schirmeier, Borchert and
# Spinczyk, "Avoiding Pitfalls in Fault-Injection Based Comparison of Program Susceptibility to Soft
# Errors",
# DSN 2015). Coverage is one minus that number over the population; both come with the same interval.
#
# **The interval of the sum** is made out of those of the strata (MOVER, the method of variance estimates
# recovery: Zou, Huang and Zhang, "A note on confidence interval estimation for a linear function of
# binomial
# proportions", Computational Statistics and Data Analysis 53, 2009): the distances from each estimate to
# its
# bound are added as independent errors are, by their squares, each bound by itself. With one stratum it is
# the
# interval of that stratum; with none failed it still has a width, which a normal approximation has not
# (Cukier,
# Powell and Arlat, "Coverage Estimation Methods for Stratified Fault Injection", IEEE Trans. Computers 48,
# 1999). It is no guarantee, as the Clopper-Pearson intervals are that it is made of: enumerated over 14 400
# cases of two strata, nominal 95 % are 98.5 % on average, less than 95 % in one case of a thousand, and
# 92.7 %
# at worst (30 experiments a stratum, 1 % failures). That is the lower bound's; the upper one of the
# failures,
# which a gate is about, left out 2.4 % at most where no more than half of a stratum fails. Where every
# bound
# has to hold for certain, put the gate on the strata.
#
# A stratum that was not sampled can hold anything between no failure and nothing else: its whole population
# is
# added to the upper bound, and there is no estimate. Experiments that are known to be `distinct` faults
# (drawn
# without replacement, on a deterministic system) can be counted on: a stratum tried whole has no width
# left.


class StratumCounts(msgspec.Struct, frozen=True):
    """`failures` of `sampled` experiments failed, which were drawn out of `population` faults."""

    failures: int
    sampled: int
    population: int


class FailureCount(msgspec.Struct, frozen=True):
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
) -> FailureCount:
    """The failures in a fault space that was sampled as one."""
    return extrapolated_sum([StratumCounts(failures, sampled, population)], confidence, method, distinct)


def extrapolated_sum(
    strata: Sequence[StratumCounts],
    confidence: float = CONFIDENCE,
    method: str = METHOD,
    distinct: bool = False,
) -> FailureCount:
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
    return FailureCount(None if unknown else total, within)


def coverage(
    strata: Sequence[StratumCounts],
    confidence: float = CONFIDENCE,
    method: str = METHOD,
    distinct: bool = False,
) -> Coverage:
    """The share of a fault space, sampled by strata, that does no harm; of no faults at all, it is 0 to 1."""
    population = sum(stratum.population for stratum in strata)
    if population == 0:
        return Coverage(None, Interval(0.0, 1.0))
    count = extrapolated_sum(strata, confidence, method, distinct)
    within = Interval(1 - count.interval.high / population, 1 - count.interval.low / population)
    return Coverage(None if count.failures is None else 1 - count.failures / population, within)


def _failures(stratum: StratumCounts, confidence: float, method: str, distinct: bool) -> Interval:
    """How many faults of one stratum do harm."""
    assert 0 <= stratum.failures <= stratum.sampled and stratum.population >= 0, stratum
    share = proportion(stratum.failures, stratum.sampled, confidence, method)
    low, high = share.low * stratum.population, share.high * stratum.population
    if not distinct:
        return Interval(low, high)
    assert stratum.sampled <= stratum.population, f"not distinct: {stratum}"
    harmless = stratum.sampled - stratum.failures
    return Interval(max(low, stratum.failures), min(high, stratum.population - harmless))

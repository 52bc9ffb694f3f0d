"""What follows from a sample of experiments for all of them: intervals of shares, of counts and of quantiles.

A campaign tries some faults out of very many, so its numbers are estimates, and a gate judges the bound
of an interval and never the estimate. What is estimated is mostly close to 0 or to 1 (a mechanism that
holds fails seldom), where the normal approximation (Wald) is wrong: 0 of 1000 would have no width at all,
"so the mechanism never fails". So it does not exist here (Brown, Cai and DasGupta, "Interval estimation
for a binomial proportion", Statistical Science 16, 2001; Newcombe, Statistics in Medicine 17, 1998).

Shares: the interval of Clopper and Pearson (Biometrika 26, 1934) inverts the exact binomial test. It holds
its confidence for every share there may be, and pays with some width: what a gate needs. Both bounds leave
out (1 - confidence) / 2, so each is a one-sided bound as well, of 97.5 % for 95 %.

Counts: what compares two mechanisms is the number of faults that do harm, extrapolated to the fault space:
the interval of the share times the size of the space. The share of faults that do no harm (coverage) does
not: a mechanism that doubles the state, or the time, doubles the faults, most of them harmless, and so
"improves" its coverage while as many faults as before do harm (Schirmeier, Borchert and Spinczyk, "Avoiding
Pitfalls in Fault-Injection Based Comparison of Program Susceptibility to Soft Errors", DSN 2015).

Quantiles of times, of which little can be assumed (two modes, a long tail): two of the measured values are
the bounds, by their ranks. How many of n values lie below the true quantile is binomial, whatever the
distribution is (David and Nagaraja, "Order Statistics", section 7.1; Hahn and Meeker, "Statistical
Intervals", chapter 5). It needs no chance and holds its confidence at every n; equal values make it wider,
never wrong. There is none where no value can bound the quantile: of 367 values all are below the p99 with
more than 2.5 % probability, so nothing that was measured is an upper bound, at 95 %.

Looks: a campaign that looks K times and stops when it has enough errs more often than stated.
`look_confidence` is Bonferroni's (Dunn, JASA 56, 1961): at each of K looks, declared beforehand, the
intervals have confidence 1 - (1 - confidence) / K, so that all K hold at once with `confidence`, and the one
at which the campaign stops is among them, whatever made it stop. Pocock's and O'Brien and Fleming's bounds
are less strict (5 looks: Pocock 0.0158 where Bonferroni takes 0.01), but assume a normal statistic and looks
at equal distances, which counts of rare failures are not (Jennison and Turnbull, "Group Sequential
Methods", 2000).

Limits: the experiments of a sample are independent and alike; those of different strata are not alike.
"""

import math
from bisect import bisect_left
from collections.abc import Sequence
from typing import Final, TypeVar

import msgspec

from aftbed.core.errors import ConfigError

CONFIDENCE: Final = 0.95

Value = TypeVar("Value", int, float)


class Interval(msgspec.Struct, frozen=True):
    """From `low` to `high`, both of them within."""

    low: float
    high: float


class FailureCount(msgspec.Struct, frozen=True):
    """How many faults of the fault space do harm; `failures` is None where none was sampled."""

    failures: float | None
    interval: Interval


def proportion(count: int, of: int, confidence: float = CONFIDENCE) -> Interval:
    """The interval of a share of which `count` in `of` experiments were seen; of none, it is 0 to 1."""
    from scipy import special  # noqa: PLC0415 - heavy: see `quantile`

    assert 0 <= count <= of, f"{count} of {of}"
    beyond = tail(confidence)
    low = special.betaincinv(count, of - count + 1, beyond) if count > 0 else 0.0
    high = 1 - special.betaincinv(of - count, count + 1, beyond) if count < of else 1.0
    return Interval(float(low), float(high))


def half_width(interval: Interval) -> float:
    """Half the width: what a stop rule is about. The estimate need not lie in the middle."""
    return (interval.high - interval.low) / 2


def extrapolated(
    failures: int, sampled: int, population: int, confidence: float = CONFIDENCE
) -> FailureCount:
    """`failures` of `sampled` experiments failed, which were drawn out of `population` faults."""
    share = proportion(failures, sampled, confidence)
    estimate = population * failures / sampled if sampled else None
    return FailureCount(estimate, Interval(share.low * population, share.high * population))


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

    assert not any(math.isnan(value) for value in values), "a time that is no number"
    if len(values) < quantile_needs(q, confidence):
        return None
    beyond, ordered, size = tail(confidence), sorted(values), len(values)
    # The true quantile lies below the value of rank r if fewer than r of all values lie below it.
    below = bisect_left(range(size), True, key=lambda k: bool(special.bdtr(k, size, q) > beyond))
    above = bisect_left(range(size), True, key=lambda k: bool(special.bdtrc(k, size, q) <= beyond))
    return Interval(ordered[below - 1], ordered[above])


def quantile_bound(values: Sequence[float], q: float, confidence: float = CONFIDENCE) -> float | None:
    """The value that the q-quantile does not exceed, with `confidence` on this one side.

    None: there are too few values. Of 299 the greatest bounds the p99 at 95 %.
    """
    found = quantile_interval(values, q, 2 * confidence - 1)
    return None if found is None else found.high


def quantile_needs(q: float, confidence: float = CONFIDENCE) -> int:
    """The smallest number of values of which `quantile_interval` is not None."""
    if not 0 < q < 1:
        raise ConfigError(f"quantile {q:g}: more than 0 and less than 1 is allowed, 0.99 for p99")
    return math.ceil(math.log(tail(confidence)) / math.log(max(q, 1 - q)))


def tail(confidence: float) -> float:
    """What an interval of this confidence leaves out on each side."""
    if not 0 < confidence < 1:
        raise ConfigError(f"confidence {confidence:g}: more than 0 and less than 1 is allowed, 0.95 is usual")
    return (1 - confidence) / 2

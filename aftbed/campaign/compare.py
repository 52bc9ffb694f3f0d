"""Is the new campaign worse than the base? Both ran the same plan, so they are compared pair by pair.

Experiment i of both campaigns had the same seed, so the same fault at the same point of the same drive.
What the fault and the drive do to the outcome is in both of a pair and cancels out; compared as two
independent samples, it would hide the difference.

- Shares (failed or not): only the pairs that differ count. If nothing has changed, each of them is
  as likely to have failed only before as to fail only now: a fair coin. `mcnemar` is the exact test of that
  (McNemar, Psychometrika 12, 1947; exact: Liddell, Journal of Epidemiology and Community Health 37, 1983).
  It is conservative (Fagerland, Lydersen and Laake, BMC Medical Research Methodology 13:91, 2013): a change
  is missed rather than invented, so a build does not fail without a reason.
- Times: `paired_quantile_shift` draws whole pairs, with replacement, and takes the difference of the two
  quantiles in each resample (percentile bootstrap: Efron and Tibshirani, "An Introduction to the Bootstrap",
  1993). The difference of the quantiles, not the quantile of the differences: what was promised is the p99
  of recovery, and the slow drives of today need not be those of yesterday. An interval without 0 is a shift.
  Simulated, nominal 95 % are 93 % to over 99 %, but 86 % for the p99 of 500 pairs that agree closely: a p99
  wants thousands of pairs.

Limits: of real processes the same seed gives the same fault, but not the same timing: then pairing gains
little, and costs nothing. Each of many comparisons is wrong with 1 - confidence: `statistics.look_confidence`
divides it among them.
"""

import math
import re
from collections.abc import Sequence
from random import Random
from typing import Final

import msgspec
import numpy as np
from scipy import special

from aftbed.campaign.experiment import Result, failed
from aftbed.campaign.ledger import Ledger
from aftbed.campaign.statistics import (
    CONFIDENCE,
    Interval,
    look_confidence,
    quantile,
    quantile_needs,
    tail,
)
from aftbed.core.errors import ConfigError
from aftbed.judge.outcome import UNKNOWN

BITS: Final = 32  # of chance for each draw; with at most PAIRS_MAX pairs no pair is favoured by over 0.1 %
PAIRS_MAX: Final = 1 << 22
RESAMPLES: Final = 2000
BEYOND_MIN: Final = 5  # resamples beyond each bound of an interval; fewer mean nothing


def mcnemar(only_base: int, only_new: int) -> float:
    """The two-sided p-value of the pairs of which only one failed: the base's, or the new one."""
    assert only_base >= 0 and only_new >= 0
    differing = only_base + only_new
    return min(1.0, 2 * float(special.bdtr(min(only_base, only_new), differing, 0.5)))


def resamples_least(confidence: float) -> int:
    """How many resamples it takes until enough of them lie beyond each bound."""
    return math.ceil(BEYOND_MIN / tail(confidence) - 1e-6)  # 100 at 0.9, whose tail is 0.0499...


def paired_quantile_shift(
    base: Sequence[float],
    new: Sequence[float],
    q: float,
    chance: Random,
    confidence: float = CONFIDENCE,
    resamples: int = RESAMPLES,
) -> Interval | None:
    """By how much the q-quantile of `new` lies above that of `base`; values at one index are a pair.

    None if there are too few pairs to bound that quantile at all (`statistics.quantile_needs`).
    """
    assert len(base) == len(new) <= PAIRS_MAX, f"{len(base)} and {len(new)} are no pairs"
    beyond, pairs = tail(confidence), len(base)
    if resamples < (least := resamples_least(confidence)):
        raise ConfigError(f"resamples {resamples}: at least {least} are allowed at confidence {confidence:g}")
    if pairs < quantile_needs(q, confidence):
        return None
    before, after = np.asarray(base, dtype=np.float64), np.asarray(new, dtype=np.float64)
    assert not (np.isnan(before).any() or np.isnan(after).any()), "a time that is no number"
    at, shifts = quantile(range(pairs), q), list[float]()
    for _ in range(resamples):  # all chance is that of the seed: numpy's own is not used
        words = np.frombuffer(chance.randbytes(pairs * BITS // 8), dtype="<u4").astype(np.uint64)
        drawn = words * np.uint64(pairs) >> np.uint64(BITS)
        shifts.append(float(np.partition(after[drawn], at)[at] - np.partition(before[drawn], at)[at]))
    return Interval(quantile(shifts, beyond), quantile(shifts, 1 - beyond))


# -- Two campaigns of one plan, experiment by experiment --------------------------------------------
#
# They are paired by what was to be run (stratum, number, seed, faults), whatever the code was, and wherever
# the files of a function, of requests or of a scenario lay. A stratum is *worse* if significantly more of its
# pairs fail only in the new campaign, or if the interval of the shift of its p99 recovery lies above 0, and
# above `SHIFT_MS_MIN`.


SHIFT_MS_MIN: Final = 0.1  # less is of no consequence, however certain
Q: Final = 0.99
SEED: Final = 1
_FOLDERS: Final = re.compile(r"[^\s'\"]*/")


class Change(msgspec.Struct, frozen=True):
    """`p` of McNemar's test over the pairs of which only one failed; `shift_ms` of the p99 recovery.

    `other_outcome`: how many pairs came to two classes of outcome, whether one failed or not; `unknown`: of
    these, how many of whose experiments one is inconclusive, or had trouble with the harness.
    """

    stratum: str
    pairs: int
    other_outcome: int
    unknown: int
    only_base: int
    only_new: int
    p: float
    shift_ms: Interval | None
    worse: bool


class Comparison(msgspec.Struct, frozen=True):
    """`unpaired`: experiments that only one of the two has; `missing`: those of the base."""

    base: str
    new: str
    unpaired: int
    missing: int
    changes: tuple[Change, ...]
    worse: bool

    @property
    def same_outcomes(self) -> bool:
        """Whether each experiment of the base was run again, and came to the same class."""
        return not self.missing and not any(change.other_outcome for change in self.changes)


def compare(base: Ledger, new: Ledger) -> Comparison:
    """All strata that both have. Raises ConfigError where no pair is found."""
    before, after = _keyed(base), _keyed(new)
    common = [key for key in before if key in after]
    if not common:
        raise ConfigError(f"{base.path} and {new.path} have no experiment in common: not of one plan")
    strata = list(dict.fromkeys(before[key].experiment.stratum for key in common))
    confidence = look_confidence(base.head.spec.confidence, 2 * len(strata))
    pairs: dict[str, list[tuple[Result, Result]]] = {name: [] for name in strata}
    for key in common:
        pairs[before[key].experiment.stratum].append((before[key], after[key]))
    changes = tuple(_change(name, found, confidence) for name, found in pairs.items())
    missing = len(before) - len(common)
    unpaired = missing + len(after) - len(common)
    codes = (base.head.code, new.head.code)
    return Comparison(*codes, unpaired, missing, changes, any(change.worse for change in changes))


def _keyed(ledger: Ledger) -> dict[bytes, Result]:
    found = {}
    for result in ledger.results:
        experiment = result.experiment
        same = msgspec.structs.replace(
            experiment,
            id="",
            expected=(),
            app=_FOLDERS.sub("", experiment.app),
            request_file=_FOLDERS.sub("", experiment.request_file),
            scenario=_FOLDERS.sub("", experiment.scenario),
            adaptations=tuple(_FOLDERS.sub("", text) for text in experiment.adaptations),
        )
        found[msgspec.json.encode(same)] = result
    return found


def _change(stratum: str, pairs: list[tuple[Result, Result]], confidence: float) -> Change:
    only_base = sum(failed(b) and not failed(n) for b, n in pairs)
    only_new = sum(failed(n) and not failed(b) for b, n in pairs)
    p = mcnemar(only_base, only_new)
    timed = [
        (b.recovery_ms, n.recovery_ms)
        for b, n in pairs
        if b.recovery_ms is not None and n.recovery_ms is not None
    ]
    shift = None
    if timed:
        chance, before, after = Random(f"{SEED}/{stratum}"), [t for t, _ in timed], [t for _, t in timed]
        resamples = max(RESAMPLES, resamples_least(confidence))  # many strata share the confidence
        shift = paired_quantile_shift(before, after, Q, chance, confidence, resamples)
    worse = (only_new > only_base and p < 1 - confidence) or (shift is not None and shift.low > SHIFT_MS_MIN)
    other = [{b.outcome, n.outcome} for b, n in pairs if b.outcome != n.outcome]
    unknown = sum(not outcomes.isdisjoint(UNKNOWN) for outcomes in other)
    return Change(stratum, len(pairs), len(other), unknown, only_base, only_new, p, shift, worse)

"""Two campaigns of one plan, experiment by experiment: what a change of the code has made better or worse.

Paired by what was to be run (stratum, number, seed, faults), whatever the code was. See `comparison` for the
two tests and their limits. A stratum is *worse* if significantly more of its pairs fail only in the new
campaign, or if the interval of the shift of its p99 recovery lies above 0, and above `SHIFT_MS_MIN`.
"""

from random import Random
from typing import Final

import msgspec

from aftbed.campaign.comparison import mcnemar, paired_quantile_shift
from aftbed.campaign.experiment import Result, failed
from aftbed.campaign.ledger import Ledger
from aftbed.campaign.statistics import Interval, look_confidence
from aftbed.core.errors import ConfigError

SHIFT_MS_MIN: Final = 0.1  # less is of no consequence, however certain
Q: Final = 0.99
SEED: Final = 1


class Change(msgspec.Struct, frozen=True):
    """`p` of McNemar's test over the pairs of which only one failed; `shift_ms` of the p99 recovery."""

    stratum: str
    pairs: int
    only_base: int
    only_new: int
    p: float
    shift_ms: Interval | None
    worse: bool


class Comparison(msgspec.Struct, frozen=True):
    """`unpaired`: experiments that only one of the two has."""

    base: str
    new: str
    unpaired: int
    changes: tuple[Change, ...]
    worse: bool


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
    unpaired = len(before) + len(after) - 2 * len(common)
    codes = (base.head.code, new.head.code)
    return Comparison(*codes, unpaired, changes, any(change.worse for change in changes))


def _keyed(ledger: Ledger) -> dict[bytes, Result]:
    found = {}
    for result in ledger.results:
        same = msgspec.structs.replace(result.experiment, id="", expected=())
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
        chance = Random(f"{SEED}/{stratum}")
        shift = paired_quantile_shift([t for t, _ in timed], [t for _, t in timed], Q, chance, confidence)
    worse = (only_new > only_base and p < 1 - confidence) or (shift is not None and shift.low > SHIFT_MS_MIN)
    return Change(stratum, len(pairs), only_base, only_new, p, shift, worse)

"""What a campaign has come to: its strata, its gates, and whether it passes.

A gate on a share is judged by the bound of the interval that the number of experiments allows, so "0 of 10"
proves only that the share is below 31 %; a gate on a time by the bound of the quantile's interval. A stratum
with a fault in which nothing ever struck fails whatever else is well, and so do too many faults that did not
strike: a campaign that could not have failed proves nothing (G8). And so does a single experiment that broke
what no fault excuses.
"""

import fnmatch
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Final, Literal

import msgspec

from aftbed.campaign.experiment import Result, failed
from aftbed.campaign.ledger import Ledger
from aftbed.campaign.plan import population, strata_of
from aftbed.campaign.spec import ANY, FHTI_MARGIN, Gate, Spec
from aftbed.campaign.states import RunState
from aftbed.campaign.statistics import (
    FailureCount,
    Interval,
    extrapolated,
    look_confidence,
    proportion,
    quantile,
    quantile_bound,
    quantile_interval,
    quantile_needs,
)
from aftbed.campaign.weaknesses import Weakness, weaknesses
from aftbed.judge.intervals import HandlingIntervals, Reaction
from aftbed.judge.outcome import LATENT, OUTCOMES, UNKNOWN

Word = Literal["pass", "fail"]
NOT_ACTIVATED: Final = "not_activated"
NOT_ALL: Final = "not all"  # of the faults of a stratum may miss
BROKEN: Final = "broken"
COVERAGE: Final = "coverage"
COVERED: Final = ("masked", "tolerated", "degraded", "detected_stop")  # the client got what was promised
FHTI_BOUND: Final = "fhti_bound"
SOMETIMES: Final = "sometimes"
QUANTILES: Final = {"p50": 0.5, "p99": 0.99}
SHARES: Final[dict[str, Callable[[Result], bool]]] = {
    "unexpected": lambda r: r.unexpected,
    "failed": failed,
    "unknown": lambda r: r.outcome in UNKNOWN,
    NOT_ACTIVATED: lambda r: not r.activated,
    BROKEN: lambda r: bool(r.broken),
    "collision": lambda r: bool(r.collision),
    COVERAGE: lambda r: r.detected or r.outcome in COVERED,
    **{name: (lambda r, name=name: r.outcome == name) for name in OUTCOMES},  # type: ignore[misc]
}

OF: Final[dict[str, Callable[[Result], bool]]] = {  # which experiments a share is a share of, where not all
    "unexpected": lambda r: r.activated and r.outcome not in UNKNOWN,
    NOT_ACTIVATED: lambda r: bool(r.experiment.faults),
    COVERAGE: lambda r: (
        bool(r.experiment.faults) and r.activated and not r.noisy and r.outcome not in UNKNOWN
    ),
}


class TimeSummary(msgspec.Struct, frozen=True):
    """Milliseconds; `p99_interval` is None where there are too few values to bound it.

    `p99_bound`: what the p99 does not exceed, with the confidence of the campaign on this one side.
    """

    count: int
    p50: float
    p99: float
    max: float
    p50_interval: Interval | None
    p99_interval: Interval | None
    p99_bound: float | None = None


class Coverage(msgspec.Struct, frozen=True):
    """Diagnostic coverage: of the `activated` experiments that are known, the share that was covered.

    Covered is what was `detected`, and what was `tolerated` without being detected. `latent`: undetected, and
    a state is wrong behind right replies. All others are `uncovered`: the client got less than was promised.
    """

    activated: int
    detected: int
    tolerated: int
    latent: int
    uncovered: int
    interval: Interval


class Handling(msgspec.Struct, frozen=True):
    """How the faults of a stratum were handled. `reactions`: how many faults by each of them.

    `bound_ms`: the greatest bound of an FHTI; `of_bound`: the greatest FHTI as a share of its own bound.
    """

    fdti_ms: TimeSummary | None
    frti_ms: TimeSummary | None
    fhti_ms: TimeSummary | None
    reactions: dict[str, int]
    coverage: Coverage | None
    bound_ms: float | None
    of_bound: float | None


class FhtiFigures(msgspec.Struct, frozen=True):
    """Of one mechanism, in ms; `bound` None: there is none."""

    p50: float
    p99: float
    bound: float | None


class StratumSummary(msgspec.Struct, frozen=True):
    """`unexpected_interval`: of the share of experiments that came out otherwise than expected."""

    name: str
    experiments: int
    activated: int
    outcomes: dict[str, int]
    expected: tuple[str, ...]
    failed: int
    population: int
    failures: FailureCount  # extrapolated to the population
    unexpected: int
    unexpected_interval: Interval
    recovery_ms: TimeSummary | None
    blackout_ms: TimeSummary | None
    adapt_blackout_ms: TimeSummary | None
    handling: Handling | None = None  # None where no fault was handled


class GateResult(msgspec.Struct, frozen=True):
    """`value` is what was measured, `bound` what the gate was judged by; both None where nothing was."""

    metric: str
    strata: str
    limit: str
    value: float | None
    bound: float | None
    word: Word
    reason: str


class Summary(msgspec.Struct, frozen=True):
    """The one document of `aftbed campaign run --json`."""

    campaign: str
    seed: int
    code: str
    experiments: int
    planned: int
    outcomes: dict[str, int]
    strata: tuple[StratumSummary, ...]
    gates: tuple[GateResult, ...]
    gate: Word
    seconds: float
    weaknesses: tuple[Weakness, ...] = ()  # of a function of the user (`system.app`), and of its mechanisms
    really: tuple[str, ...] = ()  # the stratum of each experiment that ended its simulator, so ran for real


def summarise(ledger: Ledger, planned: int, seconds: float) -> Summary:
    """All of it. `planned`: how many experiments there should be at most."""
    spec, results = ledger.head.spec, ledger.results
    groups: dict[str, list[Result]] = {}
    for result in results:
        groups.setdefault(result.experiment.stratum, []).append(result)
    confidence = confidence_of(spec)
    asked = tuple(judged(gate, groups, confidence) for gate in spec.gates)
    missable = {stratum.name for stratum in strata_of(spec) if stratum.fault.may_miss}
    struck = {
        name: group
        for name, group in groups.items()
        if name not in missable or any(result.activated for result in group)
    }
    always = tuple(judged(gate, struck, confidence) for gate in _always(spec))
    gates = (
        *asked,
        *always,
        _unexcused(results),
        *_within_bound(spec, results),
        *_sometimes(spec, results),
        *_vacuous(spec, struck),
    )
    sizes = {stratum.name: population(stratum.fault) for stratum in strata_of(spec)}
    broken = not results or any(g.word == "fail" for g in gates)
    return Summary(
        spec.campaign,
        spec.seed,
        ledger.head.code,
        len(results),
        planned,
        _counted(results),
        tuple(_stratum(name, group, sizes.get(name, 1), confidence) for name, group in groups.items()),
        gates,
        "fail" if broken else "pass",
        round(seconds, 3),
        weaknesses(spec, groups, confidence) if spec.system.app else (),
        tuple(r.experiment.stratum for r in results if r.experiment.runtime != spec.system.runtime),
    )


def confidence_of(spec: Spec) -> float:
    """Of each interval: higher where the data were looked at more than once to decide when to stop."""
    looks = spec.stop.looks if spec.stop.half_width is not None else 1
    return look_confidence(spec.confidence, looks)


def _stratum(name: str, group: list[Result], size: int, confidence: float) -> StratumSummary:
    told = list(filter(OF["unexpected"], group))
    unexpected, harm = sum(r.unexpected for r in told), sum(map(failed, group))
    return StratumSummary(
        name,
        len(group),
        sum(r.activated for r in group),
        _counted(group),
        group[0].experiment.expected,
        harm,
        size,
        extrapolated(harm, len(group), size, confidence),
        unexpected,
        proportion(unexpected, len(told), confidence),
        times([r.recovery_ms for r in group], confidence),
        times([r.blackout_ms for r in group], confidence),
        times([r.adapt_blackout_ms for r in group], confidence),
        handling(group, confidence),
    )


def handling(group: Sequence[Result], confidence: float) -> Handling | None:
    """None of experiments without a fault that has intervals."""
    found = [one for r in group for one in r.intervals if one.of_fault]
    if not found:
        return None
    return Handling(
        times([one.fdti_ms for one in found], confidence),
        times([one.frti_ms for one in found], confidence),
        times([one.fhti_ms for one in found], confidence),
        {reaction.value: sum(one.reaction is reaction for one in found) for reaction in Reaction},
        coverage(group, confidence),
        max((one.bound_ms for one in found if one.bound_ms is not None), default=None),
        max((r.of_bound for r in group if r.of_bound is not None), default=None),
    )


def coverage(group: Iterable[Result], confidence: float) -> Coverage | None:
    """None where no fault was activated, or nothing is known."""
    known = list(filter(OF[COVERAGE], group))
    if not known:
        return None
    undetected = [r for r in known if not r.detected]
    tolerated = sum(r.outcome in COVERED for r in undetected)
    latent = sum(r.outcome == LATENT for r in undetected)
    detected = len(known) - len(undetected)
    interval = proportion(detected + tolerated, len(known), confidence)
    uncovered = len(undetected) - tolerated - latent
    return Coverage(len(known), detected, tolerated, latent, uncovered, interval)


def fhti_figures(results: Iterable[Result]) -> dict[str, FhtiFigures]:
    """By mechanism, of all faults that were handled."""
    groups: dict[str, list[HandlingIntervals]] = {}
    for result in results:
        groups.setdefault(result.experiment.ftm, []).extend(one for one in result.intervals if one.of_fault)
    found = {}
    for ftm, group in groups.items():
        times_ms = [one.fhti_ms for one in group if one.fhti_ms is not None]
        bound = max((one.bound_ms for one in group if one.bound_ms is not None), default=None)
        if times_ms:
            found[ftm] = FhtiFigures(quantile(times_ms, 0.5), quantile(times_ms, 0.99), bound)
    return found


def times(values: Iterable[float | None], confidence: float) -> TimeSummary | None:
    """Quantiles with their intervals; None of nothing."""
    found = sorted(v for v in values if v is not None)
    if not found:
        return None
    return TimeSummary(
        len(found),
        quantile(found, 0.5),
        quantile(found, 0.99),
        found[-1],
        quantile_interval(found, 0.5, confidence),
        quantile_interval(found, 0.99, confidence),
        quantile_bound(found, 0.99, confidence),
    )


def _counted(results: Iterable[Result]) -> dict[str, int]:
    found = Counter(r.outcome for r in results)
    return {name: found[name] for name in OUTCOMES if found[name]}


# -- gates ----------------------------------------------------------------------------------------


def judged(gate: Gate, groups: dict[str, list[Result]], confidence: float) -> GateResult:
    """`gate` over the strata that it means."""
    group = [r for name, results in groups.items() if fnmatch.fnmatch(name, gate.strata) for r in results]
    limit = f"at most {gate.max:g}" if gate.max is not None else f"at least {gate.min:g}"
    if not group:
        reason = f"no stratum is called {gate.strata!r}"
        return GateResult(gate.metric, gate.strata, limit, None, None, "fail", reason)
    interval: Interval | None
    if gate.metric == FHTI_MARGIN:
        return _margin(gate, limit, group, confidence)
    if gate.metric in SHARES:
        of = OF.get(gate.metric)
        group = list(filter(of, group)) if of is not None else group
        count = sum(map(SHARES[gate.metric], group))
        value, interval = count / max(1, len(group)), proportion(count, len(group), confidence)
    else:
        name, _, which = gate.metric.rpartition("_")
        times, q = [v for r in group if (v := getattr(r, name)) is not None], QUANTILES[which]
        interval = quantile_interval(times, q, confidence)
        if interval is None:
            needed = quantile_needs(q, confidence)
            reason = f"{len(times)} values; {needed} are needed to bound it at {confidence:.1%}"
            return GateResult(gate.metric, gate.strata, limit, None, None, "fail", reason)
        value = quantile(times, q)
    bound = interval.high if gate.max is not None else interval.low
    if gate.max == 0 and gate.metric in SHARES:
        bound = value  # no number of experiments bounds a share by 0
    kept = bound <= gate.max if gate.max is not None else bound >= (gate.min or 0.0)
    range_ = f", and it may be {bound:.4g}" if bound != value else ""
    reason = "" if kept else f"{value:.4g} was measured{range_}"
    if not kept and gate.metric == "unknown":
        reason += next((f"; experiment {r.experiment.id}: {r.reasons[0]}" for r in group if _untold(r)), "")
    return GateResult(gate.metric, gate.strata, limit, value, bound, "pass" if kept else "fail", reason)


def _margin(gate: Gate, limit: str, group: list[Result], confidence: float) -> GateResult:
    """Of the longest handling, and judged by the upper bound of the p99 where there are enough values.

    Each adaptation counts as well: for its blackout nothing is answered. A fault that was not handled leaves
    no margin.
    """
    found = [(r, one) for r in group for one in r.intervals]
    values = [one.fhti_ms for _, one in found if one.fhti_ms is not None]
    unhandled = [
        (r, one)
        for r, one in found
        if one.fhti_ms is None and one.asked and not (one.latent or r.noisy or r.outcome in UNKNOWN)
    ]
    if unhandled or not values:
        reason = "no fault was handled"
        if unhandled:
            result, one = unhandled[0]
            reason = f"experiment {result.experiment.id}: {one.fault}: never handled"
        return GateResult(gate.metric, gate.strata, limit, None, None, "fail", reason)
    ftti_ms = min(r.experiment.ftti_ms for r in group)
    bound_ms = quantile_bound(values, 0.99, confidence)
    judged_ms = max(values) if bound_ms is None else bound_ms
    margin, judged_by = 1 - max(values) / ftti_ms, 1 - judged_ms / ftti_ms
    kept = judged_by <= gate.max if gate.max is not None else judged_by >= (gate.min or 0.0)
    which = "the longest" if bound_ms is None else f"the p99 is below, at {confidence:.1%}:"
    reason = "" if kept else f"{which} {judged_ms:.4g} ms of {ftti_ms:g} ms"
    return GateResult(gate.metric, gate.strata, limit, margin, judged_by, "pass" if kept else "fail", reason)


def _within_bound(spec: Spec, results: Iterable[Result]) -> Iterator[GateResult]:
    """A fault that was handled later than can be: the bound or the code is wrong, or the machine stood still.

    Noisy experiments have no times. A machine that others use, too, keeps no deadline, and not each of its
    stops is seen. So on real processes the gate fails a campaign that asks for it by `bounded`.
    """
    shares = [(r.of_bound, r) for r in results if r.of_bound is not None]
    if not shares:
        return
    most, worst = max(shares, key=lambda pair: pair[0])
    strict = spec.bounded or spec.system.runtime == "sim"
    word: Word = "fail" if most > 1 and strict else "pass"
    reason = ""
    if most > 1:
        late = max(
            (one for one in worst.intervals if one.bound_ms and one.fhti_ms),
            key=lambda one: (one.fhti_ms or 0.0) / (one.bound_ms or 1.0),
        )
        words = f"{late.fault}: handled after {late.fhti_ms:g} ms, the bound is {late.bound_ms:g}"
        reason = f"experiment {worst.experiment.id}: {words}" + ("" if strict else "; judged with `bounded`")
    yield GateResult(FHTI_BOUND, ANY, "at most 1", most, None, word, reason)


def _sometimes(spec: Spec, results: Sequence[Result]) -> Iterator[GateResult]:
    """A state that the campaign is about, and that no experiment was in."""
    for state in dict.fromkeys(map(RunState, spec.sometimes)):
        count = sum(state in result.states for result in results)
        reason = "" if count else f"none of {len(results)} experiments was in it: nothing is shown of it"
        word: Word = "pass" if count else "fail"
        yield GateResult(SOMETIMES, ANY, f"{state.value}: in at least one", float(count), None, word, reason)


def _untold(result: Result) -> bool:
    """Whether nothing is known of the mechanism, and why."""
    return result.outcome in UNKNOWN and bool(result.reasons)


def _always(spec: Spec) -> Iterator[Gate]:
    """G8: what did not happen, and what is not known, is no pass."""
    if any(entry.texts for entry in spec.faults):
        yield Gate(NOT_ACTIVATED, max=spec.not_activated_max)
    yield Gate("unknown", max=spec.unknown_max)


def _unexcused(results: Iterable[Result]) -> GateResult:
    """Not a share: what no fault excuses must not happen once."""
    found = [r for r in results if r.broken]
    word: Word = "fail" if found else "pass"
    reason = f"experiment {found[0].experiment.id}: {found[0].broken[0]}" if found else ""
    return GateResult(BROKEN, ANY, "none", float(len(found)), None, word, reason)


def _vacuous(spec: Spec, groups: dict[str, list[Result]]) -> Iterator[GateResult]:
    """Strata that could not have failed. With an `unknown_max` of 1, nothing needs to be known."""
    for name, group in groups.items():
        reason = ""
        if group[0].experiment.faults and not any(r.activated for r in group):
            metric, reason = NOT_ACTIVATED, f"none of {len(group)} faults struck"
        elif spec.unknown_max < 1 and all(r.outcome in UNKNOWN for r in group):
            metric, reason = "unknown", f"of none of {len(group)} experiments anything is known"
        if reason:
            reason += ": this stratum could not have failed"
            yield GateResult(metric, name, NOT_ALL, 1.0, None, "fail", reason)

"""What a campaign has found against a function and its mechanisms, and what would have held.

A *weakness* is a kind of fault (or none at all) with experiments that ended neither `masked` nor `tolerated`,
and the strata where. Some are limits of a mechanism, which does not promise to hold such a fault, so that the
outcome was expected; the mechanisms under which all experiments with the same fault ended well are named, if
there are enough of them to rule out chance. Others are not expected: then the function does not do what it
declares, and what it has to change follows from where it shows:

| bad without a fault              | the function                                                     |
|----------------------------------|------------------------------------------------------------------|
| under `none`                     | fails by itself, or is not deterministic                         |
| where it is executed twice (TR)  | `capture` or `restore` forgets something, or not deterministic   |
| where two replicas execute (LFR) | is not deterministic, or its instances share something           |

What is bad only behind a failover or an adaptation, where a replica begins with a captured state, is
forgotten by `capture` or `restore`. Under a mechanism that is bad without a fault, faults tell nothing more.
"""

import math
import shlex
from collections import Counter
from collections.abc import Iterable, Iterator, Set
from typing import Final

import msgspec

from aftbed.adapt.suitability import AMPLE, FaultModel, demand, problems
from aftbed.campaign.experiment import Result
from aftbed.campaign.plan import Stratum, strata_of, unknown_words
from aftbed.campaign.spec import Spec
from aftbed.campaign.statistics import Interval, proportion
from aftbed.core.application import Characteristics
from aftbed.ftm.compose import NONE, expressions, parse, replication_of
from aftbed.ftm.registry import MECHANISMS
from aftbed.inject.model import parse as parse_fault
from aftbed.judge.outcome import OUTCOMES, UNKNOWN

HELD: Final = ("masked", "tolerated")
RESTORED: Final = "a replica has a captured state"
FORGETS: Final = "capture() or restore() forgets something"
NUMBER_MAX: Final = 1000  # of experiments that are asked for
EFFECTS: Final = {
    "masked": "the fault has no effect, which was not expected",
    "latent": "the replicas end with different, or wrong, states",
    "tolerated": "the mechanism has to act, which was not expected",
    "degraded": "replies are late, or no redundancy is left",
    "detected_stop": "a replica ends itself rather than answer",
    "omission": "requests get no reply",
    "duplicate_effect": "requests take effect twice",
    "unavailable": "no replica is left",
    "hang": "no reply comes any more",
    "sdc": "wrong replies reach the client",
    "inconclusive": "nothing is known",
    "harness_error": "nothing is known",
}


class SeenPlace(msgspec.Struct, frozen=True):
    """`count` of `experiments` under a mechanism; `place` has the adaptation, too."""

    place: str
    count: int
    experiments: int
    interval: Interval


class Weakness(msgspec.Struct, frozen=True):
    """`fault`: the names of its entries: those that show one cause are one weakness.

    `held`: where all experiments with it ended well; `advice`: what else would hold.
    """

    fault: str
    effect: str
    expected: bool
    seen: tuple[SeenPlace, ...]
    held: tuple[SeenPlace, ...]
    advice: str


class _Group(msgspec.Struct, frozen=True):
    """The experiments of a stratum."""

    stratum: Stratum
    results: tuple[Result, ...]

    @property
    def bad(self) -> list[Result]:
        return [r for r in self.results if r.outcome not in HELD or r.unexpected]

    @property
    def unexpected(self) -> bool:
        unknown = any(r.outcome in UNKNOWN for r in self.results)
        return unknown or any(r.unexpected for r in self.results)

    @property
    def calm(self) -> bool:
        """Without a fault or an adaptation."""
        return not self.stratum.fault.texts and not self.stratum.adaptation.texts

    @property
    def struck(self) -> int:
        return sum(result.activated for result in self.results)

    @property
    def place(self) -> str:
        """The mechanism, and the adaptation if there is one."""
        more = f" {self.stratum.adaptation.name}" if self.stratum.adaptation.texts else ""
        return self.stratum.ftm + more


def weaknesses(spec: Spec, groups: dict[str, list[Result]], confidence: float) -> tuple[Weakness, ...]:
    """Those of a campaign, the unexpected ones first. `groups`: its results by stratum."""
    known = {stratum.name: stratum for stratum in strata_of(spec)}
    told_of = {name: tuple(filter(_tells, group)) for name, group in groups.items() if name in known}
    found = [_Group(known[name], group) for name, group in told_of.items() if group]
    calm_bad = {g.stratum.ftm: g for g in found if g.calm and g.unexpected}
    told = list(_calm(spec, found, calm_bad, confidence))
    causes: dict[str, list[_Group]] = {}
    sound = [group for group in found if group.stratum.ftm not in calm_bad]
    faulty = {group.stratum.ftm for group in found if group.unexpected}  # of them, nothing is recommended
    for fault in spec.faults:
        alike = [group for group in sound if group.stratum.fault.name == fault.name and not group.calm]
        bad = [group for group in alike if group.bad]
        able = [group for group in alike if group.stratum.ftm not in faulty]
        if wrong := [group for group in bad if group.unexpected]:
            causes.setdefault(_of_function(spec, wrong), []).extend(wrong)
        if limits := [group for group in bad if not group.unexpected]:
            held = list(_held(able, bad, confidence))
            advice = "" if held else _of_suitability(spec, limits, able, calm_bad.keys() | faulty, confidence)
            told.append(_weakness(limits, held, advice, confidence, expected=True))
    for advice, groups_of_it in causes.items():
        told.append(_weakness(groups_of_it, (), advice, confidence, expected=False))
    return tuple(sorted(told, key=lambda weakness: weakness.expected))


def _tells(result: Result) -> bool:
    """Not of a run on a machine that was too busy."""
    return not (result.noisy and result.outcome in UNKNOWN)


def _weakness(
    groups: list[_Group], held: Iterable[SeenPlace], advice: str, confidence: float, *, expected: bool
) -> Weakness:
    places: dict[str, list[_Group]] = {}
    for group in groups:
        places.setdefault(group.place, []).append(group)
    seen = tuple(_seen(place, alike, confidence) for place, alike in places.items())
    faults = "; ".join(dict.fromkeys(group.stratum.fault.name for group in groups))
    return Weakness(faults, _effect(groups), expected, seen, tuple(held), advice)


def _seen(place: str, groups: list[_Group], confidence: float) -> SeenPlace:
    """Over all kinds of fault."""
    count, of = sum(len(group.bad) for group in groups), sum(len(group.results) for group in groups)
    return SeenPlace(place, count, of, proportion(count, of, confidence))


def _held(able: Iterable[_Group], bad: list[_Group], confidence: float) -> Iterator[SeenPlace]:
    """Where all that struck ended well, and surely more often than in `bad`."""
    for group in able:
        struck = group.struck
        share = proportion(struck, struck, confidence)
        if not group.bad and 1 - share.low < _least(bad, confidence):
            yield SeenPlace(group.place, struck, struck, share)


def _least(bad: list[_Group], confidence: float) -> float:
    """The least that the share of those in `bad` that ended badly may be."""
    count, of = sum(len(group.bad) for group in bad), sum(len(group.results) for group in bad)
    return proportion(count, of, confidence).low


def _effect(groups: Iterable[_Group]) -> str:
    """The most frequent outcomes of the bad ones, in words, the worst first."""
    counts = Counter(result.outcome for group in groups for result in group.bad)
    words = [EFFECTS[name] for name in reversed(OUTCOMES) if counts[name]]
    return "; ".join(dict.fromkeys(words))


# -- what the function has to change --------------------------------------------------------------


def _calm(
    spec: Spec, found: list[_Group], calm_bad: dict[str, _Group], confidence: float
) -> Iterator[Weakness]:
    """Of strata without a fault: the causes one by one, since one cause shows under several mechanisms."""
    bare = NONE if any(group.stratum.ftm == NONE for group in found) else ""
    by_itself = NONE in calm_bad or (not bare and len(calm_bad) == len({g.stratum.ftm for g in found}))
    causes: dict[str, list[_Group]] = {}
    for ftm, group in calm_bad.items():
        cause = _by_itself(spec, calm_bad.get(NONE, group)) if by_itself else _by_mechanism(spec, ftm, group)
        causes.setdefault(cause, []).append(group)
    for advice, groups in causes.items():
        yield _weakness(groups, (), advice, confidence, expected=False)


def _by_itself(spec: Spec, group: _Group) -> str:
    first = group.bad[0]
    if first.outcome == "sdc":
        return (
            "its replies differ from those of another instance to the same requests: it is not deterministic"
            f" (chance, a clock, an address, a global), but declares that it is; {_check(spec)}"
        )
    return f"it fails by itself: {_reason(first)}"


def _by_mechanism(spec: Spec, ftm: str, group: _Group) -> str:
    first = group.bad[0]
    if first.outcome in UNKNOWN:
        return _reason(first)
    if any(MECHANISMS[name].suitability.exact_state and MECHANISMS[name].innermost for name in parse(ftm)):
        return (
            f"executed again from a captured state, it answers otherwise: {FORGETS},"
            f" or it is not deterministic; {_check(spec)}"
        )
    if demand(ftm).deterministic:
        return (
            "two replicas that execute the same requests come apart: it is not deterministic, or its"
            f" instances share something; {_check(spec)}"
        )
    return f"capture() changes what it answers, or it is not deterministic; {_check(spec)}"


def _of_function(spec: Spec, groups: list[_Group]) -> str:
    first = next(result for group in groups for result in group.bad if result.unexpected or group.unexpected)
    if first.outcome in UNKNOWN:
        return _reason(first)
    if any(result.outcome == "degraded" for group in groups for result in group.bad):
        return f"no new backup came up: restore() refuses, or fails on, what capture() gives; {_check(spec)}"
    adapted = any(group.stratum.adaptation.texts for group in groups)
    return f"behind {'an adaptation' if adapted else 'a failover'}, {RESTORED}: {FORGETS}; {_check(spec)}"


def _check(spec: Spec) -> str:
    """The command that tells what is not as it is declared."""
    system = spec.system
    requests = f" --requests {shlex.quote(system.request_file)}" if system.request_file else ""
    return f"`aftbed app check {shlex.quote(system.app)}{requests}` tells what"


def _reason(result: Result) -> str:
    return result.reasons[0] if result.reasons else result.outcome


# -- what a mechanism would have held -------------------------------------------------------------


def _of_suitability(
    spec: Spec, groups: list[_Group], able: list[_Group], faulty: Set[str], confidence: float
) -> str:
    """Where nothing surely held: what does not know such a fault, what may hold it, what was not tried.

    `able`: groups with the same fault whose mechanisms do what they should. `faulty`: mechanisms under which
    the function does not do what it declares.
    """
    stratum, bad = groups[0].stratum, {group.stratum.ftm for group in groups}
    duplex = any(replication_of(ftm) for ftm in bad)
    tried = [ftm for ftm in spec.mechanisms if ftm not in bad and bool(replication_of(ftm)) == duplex]
    immune = [ftm for ftm in tried if unknown_words(spec, stratum.fault, ftm) is not None]
    if immune:
        return f"it does not occur under {', '.join(immune)}"
    faults = [parse_fault(text) for text in groups[0].results[0].experiment.faults]
    asked = FaultModel(
        crash=any(fault.action.stops_process for fault in faults),
        value=any(fault.action.alters_value for fault in faults),
    )
    promised = [ftm for ftm in expressions() if not problems(ftm, asked, Characteristics(), AMPLE)]
    tried = [ftm for ftm in promised if ftm in faulty]
    others = [ftm for ftm in promised if ftm not in spec.mechanisms]
    if tried:
        return f"{', '.join(tried)} would hold it, once the function does there what it declares"
    good = [group for group in able if not group.bad and group.struck and group.stratum.ftm in promised]
    if good:
        return f"{', '.join(group.place for group in good)} held it, {_too_few(groups, good, confidence)}"
    if not others:
        return "no mechanism that promises to hold it did" if promised else "no mechanism promises to hold it"
    wanted = demand(others[0])
    needs = "; ".join((*wanted.deterministic, *wanted.state_access, *wanted.exact_state))
    return f"{', '.join(others)} would hold it, not tried" + (f": {needs}" if needs else "")


def _too_few(bad: list[_Group], good: list[_Group], confidence: float) -> str:
    """How many experiments rule out chance, if they end as those that there are."""
    least = _least(bad, confidence)
    numbers = (n for n in range(1, NUMBER_MAX) if 1 - proportion(n, n, confidence).low < least)
    struck = min(group.struck / len(group.results) for group in good)
    number = next(numbers, NUMBER_MAX)
    return f"which may be chance: `--experiments {math.ceil(number / struck)}` or more tell"

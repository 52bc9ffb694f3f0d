"""The FT/A/R table, measured: what each mechanism assumes, and what comes of it where that does not hold.

The paper's Fig. 1 has which mechanism suits which faults (FT) and which function (A). `adapt.suitability`
has that as a table; here is what was measured. For each stratum of a campaign over mechanisms, variants of
the function and faults: the verdict of the table, and the share of experiments in which the client got wrong
replies or none, or the replicas came apart, with its interval. Where the table is right, it says "holds" if
nothing broke, and names the assumption if something did. It can be wrong in both ways: a cell where it says
"holds" and something broke, and one where it names an assumption and nothing did.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import Final

import msgspec

from aftbed.adapt.commands import read
from aftbed.adapt.planner import APPLICATION
from aftbed.adapt.suitability import AMPLE, FaultModel, problems
from aftbed.campaign.experiment import Experiment, Result
from aftbed.campaign.ledger import Ledger
from aftbed.campaign.statistics import Interval, proportion
from aftbed.core.application import Characteristics
from aftbed.inject.grammar import Permanent
from aftbed.inject.model import parse
from aftbed.judge.isolated import declared_by
from aftbed.judge.outcome import FAILED, UNKNOWN
from aftbed.runtime.unix.trust import NOBODY, Trust
from aftbed.vehicle.aeb.function import default_application

BROKEN: Final = (*FAILED, "latent", "detected_stop")
ROLLED_BACK: Final = "rolled back"
REFUSED: Final = "refused by the self-test"


class AssumptionCell(msgspec.Struct, frozen=True):
    """`assumption`: the one that is broken there by the table, `""` where the mechanism holds by it."""

    stratum: str
    assumption: str
    experiments: int
    broken: int
    interval: Interval
    outcomes: dict[str, int]
    agrees: bool


def cells(ledger: Ledger, trust: Trust = NOBODY) -> Iterator[AssumptionCell]:
    """One for each stratum, of the experiments whose faults happened and of which something is known.

    Where an update was rolled back, some requests were served by one version and some by the other: left out.
    Raises ConfigError where a function is not trusted: what it declares is not known then.
    """
    declared = cache(partial(declared_by, trust=trust))
    groups: dict[str, list[Result]] = {}
    for result in ledger.results:
        known = result.activated and result.outcome not in UNKNOWN
        if known and ROLLED_BACK not in result.adapted:
            groups.setdefault(result.experiment.stratum, []).append(result)
    for name, group in groups.items():
        outcomes = Counter(_came_to(result) for result in group)
        broken = sum(count for outcome, count in outcomes.items() if outcome in BROKEN)
        assumption = assumed_wrongly(group[0], declared)
        yield AssumptionCell(
            name,
            assumption,
            len(group),
            broken,
            proportion(broken, len(group), ledger.head.spec.confidence),
            dict(outcomes),
            bool(assumption) == bool(broken or outcomes[REFUSED]),
        )


def _came_to(result: Result) -> str:
    return REFUSED if "refused" in result.adapted else result.outcome


def assumed_wrongly(result: Result, declared: Callable[[str], Characteristics]) -> str:
    """Why the table has this mechanism fail under these faults and with this function; "" if it holds.

    `declared`: what a function declares, by its source.
    """
    experiment = result.experiment
    faults = [parse(text) for text in experiment.faults]
    flips = [fault for fault in faults if fault.action.alters_value]
    asked = FaultModel(
        crash=any(fault.action.stops_process for fault in faults),
        value=bool(flips),
    )
    found = problems(experiment.ftm, asked, _characteristics(experiment, declared), AMPLE)
    if not found and any(isinstance(fault.persistence, Permanent) for fault in flips):
        found = [f"{experiment.ftm} takes a value fault for transient: this one is in every execution"]
    if not found and any(fault.action.strikes_stored_state for fault in flips):
        found = [f"{experiment.ftm} compares executions: a state that is wrong before is in all of them"]
    return "; ".join(found)


def _characteristics(experiment: Experiment, declared: Callable[[str], Characteristics]) -> Characteristics:
    """Of the last version of the function."""
    wishes = [read(text).wish for text in experiment.adaptations]
    updates = [wish.source for wish in wishes if wish.verb == "update" and wish.name == APPLICATION]
    source = updates[-1] if updates else experiment.app
    return declared(source) if source else default_application().characteristics


def markdown(ledger: Ledger, trust: Trust = NOBODY) -> str:
    """The table for people."""
    head = ledger.head
    found = list(cells(ledger, trust))
    lines = [
        "| stratum | what the table says | broke | outcomes | |",
        "|---|---|---|---|---|",
    ]
    for cell in found:
        outcomes = ", ".join(f"{name} {count}" for name, count in sorted(cell.outcomes.items()))
        share = f"{cell.broken} of {cell.experiments} ({cell.interval.low:.0%} to {cell.interval.high:.0%})"
        agrees = "agrees" if cell.agrees else "**differs**"
        lines.append(f"| {cell.stratum} | {cell.assumption or 'holds'} | {share} | {outcomes} | {agrees} |")
    about = (
        f"{len(ledger.results)} experiments, {len(found)} strata, seed {head.spec.seed}, code {head.code};"
        f" intervals of {head.spec.confidence:.0%} (Clopper-Pearson)."
    )
    return "\n".join([*lines, "", about, ""])

"""The runs that a person should look at first, and what happened in one of them.

Runs that broke a promise come first, then the unexpected ones; among these and after them, the worst outcome;
then the slowest. One run of a stratum represents it: forty runs that fail in the same way are one finding.

A ledger keeps no messages, so a run is simulated to draw it: with the same bricks, scripts, faults and
seed. A run of real processes need not have the same outcome there (the times differ, so a fault may strike
another request); then the report notes it, and the drawing shows what the simulator did.
"""

from collections.abc import Iterable
from typing import Final

import msgspec

from aftbed.campaign.experiment import Experiment, Result, carry_out, setup_of
from aftbed.core.errors import AftbedError
from aftbed.functions.load import NO_CODE
from aftbed.judge.outcome import OUTCOMES
from aftbed.runtime.sim.trace import Trace, traced

REASON_MAX: Final = 300  # characters


class Rerun(msgspec.Struct, frozen=True):
    """A run simulated once more: its outcome and its trace; or why it cannot be simulated."""

    outcome: str
    trace: Trace | None
    why_not: str = ""


def by_badness(results: Iterable[Result]) -> list[Result]:
    """One of each stratum, the worst first. A run with the best outcome, as expected, is left out."""
    found: dict[str, Result] = {}
    for result in sorted(results, key=_badness, reverse=True):
        if result.broken or result.unexpected or result.outcome != OUTCOMES[0] or not result.activated:
            found.setdefault(result.experiment.stratum, result)
    return list(found.values())


def slowness_ms(result: Result) -> float:
    """The longest of its times."""
    times = (result.recovery_ms, result.blackout_ms, result.adapt_blackout_ms, result.fhti_ms)
    return max((t for t in times if t is not None), default=0.0)


def worst_of(results: Iterable[Result]) -> Result:
    """The first to look at. `results` are not empty."""
    return max(results, key=_badness)


def rerun(experiment: Experiment) -> Rerun:
    """Simulate it, whatever runtime it had."""
    simulated = msgspec.structs.replace(experiment, runtime="sim")
    again = carry_out(simulated, lambda _: None, NO_CODE)
    try:
        return Rerun(again.outcome, traced(setup_of(simulated)))
    except (AftbedError, AssertionError, LookupError, ValueError) as error:
        return Rerun(again.outcome, None, str(error)[:REASON_MAX] or type(error).__name__)


def _badness(result: Result) -> tuple[bool, bool, int, float, int]:
    """For sorting; of two that are equally bad the earlier is the worse."""
    place = OUTCOMES.index(result.outcome) if result.outcome in OUTCOMES else len(OUTCOMES)
    return bool(result.broken), result.unexpected, place, slowness_ms(result), -result.experiment.index

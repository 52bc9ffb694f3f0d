"""The smallest experiment with the same outcome, by the simulator."""

import itertools

import msgspec

from aftbed.campaign.experiment import Experiment, Result, carry_out, setup_of
from aftbed.core.errors import ConfigError
from aftbed.core.progress import Show, unshown
from aftbed.functions.load import NO_CODE
from aftbed.judge.verdict import Breach
from aftbed.runtime.sim.world import Setup
from aftbed.search.shrink import shrink


def smallest(result: Result, show: Show = unshown) -> Experiment:
    """In the simulator; `show` gets how many runs were tried.

    Raises ConfigError where the experiment does not come to the same there.
    """
    first = msgspec.structs.replace(result.experiment, runtime="sim")
    setup = setup_of(first)

    tries = itertools.count(1)

    def same(simpler: Setup) -> tuple[Breach, ...]:
        show(next(tries), 0)
        found = carry_out(_as(first, simpler), lambda _: None, NO_CODE)
        return (Breach(found.outcome, "; ".join(found.reasons)),) if found.outcome == result.outcome else ()

    if not same(setup):
        raise ConfigError(
            f"experiment {result.experiment.id}: the simulator does not come to {result.outcome} with it,"
            " so it cannot be shrunk there: `aftbed campaign replay` runs it again as it was"
        )
    return _as(first, shrink(setup, same))


def _as(first: Experiment, setup: Setup) -> Experiment:
    """`first` with what `setup` has."""
    return msgspec.structs.replace(
        first,
        ftm=setup.ftm,
        placement=setup.placement,
        requests=setup.count,
        rate_hz=setup.rate_hz,
        scenario=setup.scenario,
        faults=tuple(map(str, setup.faults)),
        adaptations=first.adaptations if setup.adaptations else (),
    )

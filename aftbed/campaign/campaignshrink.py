"""The smallest experiment with the same outcome: `shrink`, told that an outcome is what is broken."""

import msgspec

from aftbed.campaign.executing import carry_out, setup_of
from aftbed.campaign.experiment import Experiment, Result
from aftbed.campaign.shrink import shrink
from aftbed.campaign.simulated import Breach
from aftbed.core.errors import ConfigError
from aftbed.runtime.sim.world import Setup


def smallest(result: Result) -> Experiment:
    """In the simulator. Raises ConfigError where the experiment does not come to the same there."""
    first = msgspec.structs.replace(result.experiment, runtime="sim")
    setup = setup_of(first)

    def same(simpler: Setup) -> tuple[Breach, ...]:
        found = carry_out(_as(first, simpler), lambda _: None)
        return (Breach(found.outcome, "; ".join(found.reasons)),) if found.outcome == result.outcome else ()

    if not same(setup):
        raise ConfigError(
            f"experiment {result.experiment.id}: the simulator does not come to {result.outcome} with it,"
            " so it cannot be shrunk there: `aftbed campaign replay` runs it again as it was"
        )
    return _as(first, shrink(setup, same))


def _as(first: Experiment, setup: Setup) -> Experiment:
    """The words of `setup`."""
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

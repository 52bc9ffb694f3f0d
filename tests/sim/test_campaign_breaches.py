"""What no fault excuses is seen by an experiment, whatever class it comes to: told of planted bugs."""

import msgspec
import pytest
from executivemutants import EXECUTIVE
from mutants import MECHANISMS

from aftbed.campaign.experiment import Experiment, Result, carry_out

MUTANTS = {mutant.name: mutant for mutant in (*MECHANISMS, *EXECUTIVE)}
CALM = Experiment("0" * 16, 0, 0, "s", 5, "pbr", "process", "sim", "", 40, 400.0, ())
DYING = msgspec.structs.replace(CALM, faults=("crash a/proceed at server.exit nth 9",))
CHANGING = msgspec.structs.replace(CALM, adaptations=("switch lfr at request 10",))


def carried_out(experiment: Experiment) -> Result:
    return carry_out(experiment, lambda _: None)


@pytest.mark.parametrize(
    ("name", "experiment", "reason"),
    [
        ("epoch not checked", DYING, "epoch"),
        ("old class staged", CHANGING, "missing"),
    ],
)
def test_a_breach_is_told_beside_the_class(name: str, experiment: Experiment, reason: str) -> None:
    assert carried_out(experiment).broken == ()
    with MUTANTS[name].plant():
        wrong = carried_out(experiment)
    assert wrong.broken and reason in wrong.broken[0], wrong

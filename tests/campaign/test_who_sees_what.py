"""The campaign `supervision`: what each kind of mechanism does about a step skipped, doubled or late."""

import pytest

from aftbed.campaign.experiment import carry_out
from aftbed.campaign.plan import plan, resolved
from aftbed.campaign.spec import read_spec
from aftbed.runtime.unix.trust import OWN_RUN

pytestmark = pytest.mark.simulation

SEEN_BY_SUPERVISION = ("skipped step", "doubled step", "slow replica")
SERVED = ("masked", "tolerated", "detected_stop")


def test_three_faults_are_seen_by_supervision_alone() -> None:
    found = plan(resolved(read_spec("supervision"), OWN_RUN), OWN_RUN)
    first = {e.stratum: e for e in reversed(list(found.experiments()))}
    outcomes = {name: carry_out(e, lambda _: None) for name, e in first.items()}
    assert [name for name, result in outcomes.items() if result.unexpected] == []
    for fault in SEEN_BY_SUPERVISION:
        served = {
            e.ftm
            for name, e in first.items()
            if fault == name.split(" · ")[1] and outcomes[name].outcome in SERVED
        }
        assert served == {"pbr+sup", "lfr+sup"}, fault

"""`sometimes`: a campaign that never was in a state that it is about has shown nothing of it."""

from pathlib import Path

import msgspec
import pytest
from campaigns import CRASHES, planned

from aftbed.campaign.experiment import carry_out
from aftbed.campaign.ledger import Ledger, head_of
from aftbed.campaign.states import RunState, states_of
from aftbed.campaign.summary import SOMETIMES, summarise
from aftbed.core.messages import Goal, Scheduled
from aftbed.inject.model import parse
from aftbed.judge.simulated import record_of
from aftbed.runtime.sim.world import Setup, simulate

SILENCE = "omission bus AEB_REQ after 1s for 100ms"
TO_TR = Scheduled(Goal(expression="pbr+tr"), at_request=20)


@pytest.mark.parametrize(
    ("setup", "states"),
    [
        (Setup("pbr"), set()),
        (Setup("pbr", faults=(parse("crash primary at server.exit nth 9"),)), {"failover", "new backup"}),
        (Setup("pbr+tr", faults=(parse("bitflip result nth 9"),)), {"vote differs"}),
        (Setup("lfr", faults=(parse("bitflip state.counter bit 0 nth 9"),)), {"divergence noticed"}),
        (Setup("pbr", adaptations=(TO_TR,)), set()),
        (
            Setup("pbr", adaptations=(TO_TR,), faults=(parse("crash primary at adapt.step.act nth 9"),)),
            {"failover", "new backup", "failover in an adaptation", "adaptation rolled back"},
        ),
        (Setup("pbr", scenario="ccrs-20", faults=(parse(SILENCE),)), {"fallback of the brakes"}),
        (Setup("pbr", scenario="ccrs-20"), set()),
    ],
    ids=["none", "crash", "vote", "divergence", "adaptation", "crash in an adaptation", "brakes", "drive"],
)
def test_the_states_of_a_run_are_read_off_its_record(setup: Setup, states: set[str]) -> None:
    found = set(map(str, states_of(record_of(simulate(msgspec.structs.replace(setup, count=60))))))
    assert states <= found
    assert bool(found) == bool(states), "nothing happened"


def test_a_failover_behind_an_adaptation_is_not_in_it() -> None:
    crash = parse("crash primary at server.exit nth 150")
    run = simulate(Setup("pbr", count=200, rate_hz=500, adaptations=(TO_TR,), faults=(crash,)))
    found = states_of(record_of(run))
    assert RunState.FAILOVER in found and RunState.IN_ADAPTATION not in found


def test_a_state_that_no_experiment_was_in_fails_the_campaign(tmp_path: Path) -> None:
    text = CRASHES.replace("system:", "sometimes: [failover, vote differs]\nsystem:")
    found = planned(tmp_path, text)
    results = tuple(carry_out(experiment, lambda _: None) for experiment in found.experiments())
    summary = summarise(Ledger(tmp_path / "x", head_of(found), results), len(results), 1.0)
    gates = [gate for gate in summary.gates if gate.metric == SOMETIMES]
    assert [(gate.limit, gate.word) for gate in gates] == [
        ("failover: in at least one", "pass"),
        ("vote differs: in at least one", "fail"),
    ]
    assert gates[0].value == sum(RunState.FAILOVER in result.states for result in results) > 0
    assert gates[1].reason == f"none of {len(results)} experiments was in it: nothing is shown of it"
    assert summary.gate == "fail"

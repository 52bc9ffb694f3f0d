"""A live fault that is refused: what strikes later is told by its own name, and by no other's."""

from typing import Final

from aftbed.inject.model import parse
from aftbed.inject.receipts import ReceiptState
from aftbed.judge.simulated import evidence_of_run
from aftbed.judge.verdict import judge
from aftbed.runtime.sim.world import Setup, World

MS: Final = 1_000_000
NO_HOST: Final = "hang backup at checkpoint.applied nth 1"  # while there is no backup
CRASH: Final = "crash primary"


def test_a_refused_fault_leaves_its_number_behind() -> None:
    """Of three faults, the one in the middle is refused: there was no backup."""
    world = World(Setup("pbr", seed=3, count=200, rate_hz=500.0))
    world.start()
    world.advance(world.loop.ns + 20 * MS)
    world.inject(parse("crash backup"))
    world.advance(world.loop.ns + MS)
    world.inject(parse(NO_HOST))
    assert [text for _, event, text in world.logged if event == "refused"] == [
        f"{NO_HOST}: no process emits checkpoint.applied now"
    ]
    world.advance(world.loop.ns + 150 * MS)
    world.inject(parse(CRASH))
    world.end()
    run = world.outcome()
    assert [(one.fault, one.number) for one in run.faults] == [("crash backup", 0), (CRASH, 2)]
    assert all(one.receipt is ReceiptState.ACTIVATED and one.live for one in run.faults)
    evidence = evidence_of_run(run)
    verdict = judge(evidence.record, evidence)
    assert [(one.cause, one.fault) for one in verdict.failovers] == [("fault", CRASH)]
    assert [one.fault for one in verdict.intervals] == ["crash backup", CRASH]
    assert verdict.checks["one_master"] == "pass"

"""A switch while the follower is behind: its requests are worked off before anything is exchanged."""

from typing import Final

import pytest

from aftbed.core.messages import Goal
from aftbed.inject.grammar import Trigger
from aftbed.inject.hang import Hang
from aftbed.inject.model import Fault
from aftbed.judge.simulated import breaches
from aftbed.runtime.sim.world import Run, Setup, World

MS: Final = 1_000_000
CAUGHT_UP_MS: Final = 10  # longer than the preparation takes, shorter than a follower is waited for behind it
STOPPED_MS: Final = 40  # longer than a follower is waited for, shorter than a drain may take


def switched(node: str, stopped_ms: int = STOPPED_MS) -> Run:
    """From LFR to PBR; `node` of the follower is stopped from the order on."""
    world = World(Setup("lfr", "process", 0, 60, 1000.0))
    world.start()
    world.advance(world.loop.ns + 5 * MS)
    world.adapt(Goal(expression="pbr"))
    world.inject(Fault(Hang(stopped_ms), node, Trigger()))
    world.end()
    return world.outcome()


@pytest.mark.parametrize("node", ["b/before", "b/proceed", "b/after"])
def test_a_follower_that_was_stopped_works_off_its_requests_and_is_switched(node: str) -> None:
    run = switched(node)
    assert [a.outcome for a in run.adaptations] == ["done"]
    assert run.adaptations[0].blackout_ms > CAUGHT_UP_MS, "it is drained while requests wait"
    assert breaches(run) == ()


def test_a_follower_that_is_a_little_behind_is_waited_for_while_requests_are_served() -> None:
    run = switched("b/before", CAUGHT_UP_MS)
    (adaptation,) = run.adaptations
    assert adaptation.outcome == "done"
    assert adaptation.prepare_ms > CAUGHT_UP_MS
    assert adaptation.blackout_ms < 2


def test_an_adaptation_is_under_way_while_it_is_observed_though_it_has_no_task() -> None:
    """A run that ends then has the old bricks beside the new ones, and its graph is not judged."""
    world = World(Setup("pbr", "process", 0, 200, 1000.0))
    world.start()
    world.advance(world.loop.ns + 5 * MS)
    world.adapt(Goal(expression="pbr+tr"))
    controller, seen = world.controller, 0
    while controller.adaptations.busy:
        world.advance(world.loop.ns + MS)
        if controller.adaptations.busy and not world.loop.tasks.names():
            assert controller.under_way() == ["a script"]
            seen += 1
    assert seen > 10  # ms of the observation
    assert controller.under_way() == []

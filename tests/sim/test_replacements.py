"""A node of no replica dies, and its replacement dies while a neighbour that it is bound to is stopped."""

import itertools
from typing import Final

import pytest
from sampling import sampled

from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Trigger
from aftbed.inject.hang import Hang
from aftbed.inject.model import Fault
from aftbed.judge.simulated import breaches
from aftbed.runtime.sim.world import Setup, World

STOPPED_MS: Final = 110  # longer than a replacement takes
AFTER_MS: Final = (2, 12, 60, 108)  # before, while and behind the binding


def begun(placement: str) -> World:
    world = World(Setup("pbr", placement, 0, 40, 500.0))
    world.start()
    world.advance(world.loop.ns + 5_000_000)
    return world


@pytest.mark.parametrize(("after_ms", "placement"), sampled(AFTER_MS, ("process", "replica")))
def test_a_replacement_that_dies_is_replaced(after_ms: int, placement: str) -> None:
    deployment = begun(placement).controller.deployment
    pairs = itertools.product(deployment.singles, deployment.graph.nodes)
    for node, neighbour in (pair for pair in pairs if pair[0] != pair[1]):
        world = begun(placement)
        world.inject(Fault(Hang(STOPPED_MS), neighbour, Trigger()))
        world.inject(Fault(Crash(), node, Trigger()))
        world.advance(world.loop.ns + after_ms * 1_000_000)
        world.inject(Fault(Crash(), node, Trigger()))
        world.end()
        assert breaches(world.outcome()) == (), f"{node} died twice while {neighbour} was stopped"

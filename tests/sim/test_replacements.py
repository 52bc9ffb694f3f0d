"""A node of no replica dies, and its replacement dies at any step of the renewal, beside a stopped neighbour.

A step is an event of the simulation: a message, an order, its answer, a timer. The renewal lasts from the
first death until the neighbour goes on and nothing is under way any more. Whatever dies when, the graph is
whole in the end, and all is answered.
"""

from collections.abc import Iterator
from typing import Final

import pytest

from aftbed.core.messages import Goal
from aftbed.ftm.compose import build
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Trigger
from aftbed.inject.hang import Hang
from aftbed.inject.model import Fault
from aftbed.judge.simulated import breaches
from aftbed.runtime.deployment import Deployment
from aftbed.runtime.sim.processes import SimProcess
from aftbed.runtime.sim.world import Setup, World

pytestmark = pytest.mark.simulation

STOPPED_MS: Final = 110  # longer than a replacement takes
SPREAD: Final = 200  # steps over which those that are tried each time are spread; the deep form tries all
PLACEMENTS: Final = ("process", "replica")
SINGLES: Final = ("client", "proxy", "recovery", "engine", "a/watchdog", "b/watchdog")


def test_a_start_waits_for_a_watchdog_that_gets_no_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """For longer than a step of a script may take."""
    pin_watchers = Deployment.pin_watchers

    def stall(deployment: Deployment) -> None:
        process = deployment.nodes["a/watchdog"]
        assert isinstance(process, SimProcess) and process.io is not None
        process.io.freeze()
        world.loop.after(5.0, process.io.thaw)
        pin_watchers(deployment)

    monkeypatch.setattr(Deployment, "pin_watchers", stall)
    world = World(Setup("pbr"))
    run = world.run()
    assert world.loop.ns > 5_000_000_000 and not breaches(run)


def test_nodes_of_replicas_are_looked_at_while_an_adaptation_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their Watchdogs look at them at any time, and a look costs CPU; an undo asks which of them hang."""
    looked: list[tuple[bool, str]] = []
    hangs = SimProcess.hangs

    def hangs_and_tells(process: SimProcess, now_ns: int, deadline_ns: int) -> bool:
        looked.append((world.controller.adaptations.busy, process.name))
        return hangs(process, now_ns, deadline_ns)

    monkeypatch.setattr(SimProcess, "hangs", hangs_and_tells)
    world = World(Setup("pbr", "process", 0, 60, 500.0))
    world.start()
    world.advance(world.loop.ns + 50_000_000)
    world.adapt(Goal(expression="lfr"))
    world.end()
    assert {name for adapting, name in looked if not adapting} == set(SINGLES)
    assert {name for adapting, name in looked if adapting} >= {*SINGLES, "a/server", "b/after"}


def struck(placement: str, node: str, neighbour: str) -> tuple[World, SimProcess]:
    """A run in which `neighbour` was just stopped and `node` killed; and the process that was `node`."""
    world = World(Setup("pbr", placement, 0, 40, 500.0))
    world.start()
    world.advance(world.loop.ns + 5_000_000)
    world.inject(Fault(Hang(STOPPED_MS), neighbour, Trigger()))
    world.inject(Fault(Crash(), node, Trigger()))
    process = world.controller.deployment.nodes[node]
    assert isinstance(process, SimProcess)
    return world, process


def step(world: World, count: int = 1) -> World:
    for _ in range(count):
        world.loop.step()
        world.loop.watch_jobs()
    return world


def steps_of_renewal(placement: str, node: str, neighbour: str) -> int:
    world, _ = struck(placement, node, neighbour)
    thawed_ns, count = world.loop.ns + STOPPED_MS * 1_000_000, 0
    while world.loop.ns <= thawed_ns or world.controller.unrest():
        step(world)
        count += 1
    return count


def kill_replacement(placement: str, node: str, neighbour: str, at: int) -> bool:
    """False if there is none at that step."""
    world, first = struck(placement, node, neighbour)
    step(world, at)
    living = [p for p in world.pool.processes if p.name == node and p is not first and not p.dead]
    for process in living:
        process.die()
    if living:
        world.end()
        found = breaches(world.outcome())
        assert found == (), f"{node} died again {at} steps later, while {neighbour} was stopped: {found[0]}"
    return bool(living)


def neighbours(placement: str, node: str) -> Iterator[str]:
    return (other for other in build("pbr", placement).nodes if other != node)


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_a_replacement_that_dies_is_replaced(placement: str) -> None:
    """One step of each pair, or of each third one where there are many."""
    pairs = [(node, other) for node in SINGLES for other in neighbours(placement, node)]
    pairs = pairs[:: 1 if placement == "replica" else 3]
    killed = [
        kill_replacement(placement, node, other, number * 37 % SPREAD)
        for number, (node, other) in enumerate(pairs)
    ]
    assert sum(killed) > len(pairs) * 0.9


@pytest.mark.deep
@pytest.mark.timeout(0)
@pytest.mark.parametrize(("node", "placement"), [(n, p) for n in SINGLES for p in PLACEMENTS])
def test_at_every_step_of_the_renewal(node: str, placement: str) -> None:
    for other in neighbours(placement, node):
        steps = steps_of_renewal(placement, node, other)
        killed = sum(kill_replacement(placement, node, other, at) for at in range(steps))
        assert killed > steps / 2

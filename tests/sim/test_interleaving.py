"""All orders of arrival: how many there are, that they differ, and that a mistake of order is found."""

from collections.abc import Callable
from random import Random

import pytest

from aftbed.adapt.plugins import make_brick
from aftbed.core.brick import Brick, Effect, Note
from aftbed.core.graph import BrickSpec
from aftbed.core.messages import AnyMessage
from aftbed.ftm.registry import Setting
from aftbed.functions.load import NO_CODE
from aftbed.judge.simulated import breaches
from aftbed.runtime.sim.clock import Clock
from aftbed.runtime.sim.interleaving import Chooser, HeldChannel, orders
from aftbed.runtime.sim.world import Doom, Setup, World
from aftbed.search.explore import all_orders, experiments

pytestmark = pytest.mark.simulation


@pytest.mark.parametrize(
    ("ftm", "placement", "count", "expected"),
    [
        ("pbr", "replica", 3, 1),  # whatever the backup does, the leader does not hear of it
        ("lfr", "replica", 1, 2),  # the follower hears of a request and of its execution on two channels
        ("lfr", "replica", 2, 6),
        ("lfr", "replica", 3, 20),
        ("pbr", "process", 2, 2),
        ("lfr", "process", 2, 12),
        ("pbr+tr", "process", 1, 1),  # a chain, and a backup that is not waited for
    ],
)
def test_how_many_orders_there_are(ftm: str, placement: str, count: int, expected: int) -> None:
    found = all_orders(Setup(ftm, placement, count=count))
    assert (found.orders, found.complete, found.broken) == (expected, True, 0)


def test_no_order_is_run_twice() -> None:
    """Nor is one that only differs in what commutes: told by what each node hears, in order."""
    heard = []

    def run(clock: Callable[[Random], Clock]) -> None:
        world = World(Setup("lfr", "replica", count=2), channel=HeldChannel, clock=clock)
        world.run()
        assert isinstance(world.loop, Chooser)
        by_node: dict[str, list[int]] = {}
        for point in world.loop.points:
            for node in point.enabled[point.chosen] or ("executive",):
                by_node.setdefault(node, []).append(point.chosen)
        heard.append(tuple((node, tuple(lines)) for node, lines in sorted(by_node.items())))

    whole = list(orders(run))
    assert whole.count(True) == len(heard) == len(set(heard)) == 6


def test_the_bound_is_said() -> None:
    found = all_orders(Setup("lfr", "process", count=3), runs_max=10)
    assert found.orders + found.cut == 10 and not found.complete


def test_a_crash_of_each_part_is_among_the_experiments() -> None:
    crashed = {s.dooms[0].brick for s in experiments(["pbr"], ["process"], 2) if s.dooms}
    assert {"a/protocol", "a/after", "a/server", "b/after"} <= crashed


def test_under_any_order_a_crash_of_the_leader_is_masked() -> None:
    found = all_orders(Setup("pbr", "replica", count=1, dooms=(Doom("a/after", 2),)), runs_max=60)
    assert found.broken == 0 and found.orders > 30


class Hasty(Brick):
    """A backup's After that says it has applied a checkpoint, and has not: it drops each second one."""

    def __init__(self, inner: Brick) -> None:
        self.inner, self.seen = inner, 0

    def __getattribute__(self, name: str) -> object:
        if name in ("inner", "seen", "step", "__class__", "__dict__"):
            return object.__getattribute__(self, name)
        return getattr(object.__getattribute__(self, "inner"), name)

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        self.seen += port == "aft2aft"
        effects = self.inner.step(port, msg, now_ns)
        lost = port == "aft2aft" and self.seen == 1
        return [e for e in effects if isinstance(e, Note)] if lost else effects


def test_a_mistake_is_found_in_some_order() -> None:
    def made(spec: BrickSpec, setting: Setting) -> Brick:
        brick = make_brick(spec, setting, NO_CODE)
        return Hasty(brick) if spec.name == "b/after" else brick

    broken = 0
    setup = Setup("pbr", "replica", count=2, dooms=(Doom("a/protocol", 8),))

    def run(clock: Callable[[Random], Clock]) -> None:
        nonlocal broken
        broken += bool(breaches(World(setup, channel=HeldChannel, clock=clock, make=made).run()))

    for count, _ in enumerate(orders(run)):
        if broken or count > 300:
            break
    assert broken

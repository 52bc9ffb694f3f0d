"""What the simulator has found, once each: runs that broke a promise, and must never again."""

from typing import Final, NamedTuple

import pytest

from aftbed.core.messages import Goal, Scheduled
from aftbed.ftm.compose import STATEFUL, replication_of
from aftbed.ftm.failover import drop_backup, failover, new_backup
from aftbed.inject.model import parse
from aftbed.judge.simulated import breaches
from aftbed.runtime import control
from aftbed.runtime.sim.world import Doom, Setup, World, simulate

MS: Final = 1_000_000


class Found(NamedTuple):
    """An adaptation from `old` to `new` with these faults."""

    what: str
    old: str
    new: str
    placement: str
    seed: int
    faults: tuple[str, ...]


ADAPTATIONS: Final = (
    Found(
        "who was told first went on while others were not told",
        "pbr",
        "pbr+tr",
        "process",
        0,
        ("crash b/after at adapt.step.act nth 9",),
    ),
    Found(
        "a failover was ordered twice, the second time upon old news",
        "lfr",
        "pbr",
        "replica",
        0,
        ("crash a at adapt.step.act nth 3",),
    ),
    Found(
        "a state that could not be given back was done without",
        "pbr",
        "pbr+tr",
        "replica",
        48,
        ("crash b at adapt.step.exit nth 8", "crash a after 13ms"),
    ),
    Found(
        "the way back led to a leader that was dead",
        "pbr",
        "lfr",
        "replica",
        55,
        ("crash a' at adapt.step.act nth 9", "crash b after 20ms"),
    ),
    Found(
        "the same, at the end of the observation",
        "lfr",
        "pbr",
        "replica",
        69,
        ("crash a' at adapt.step.exit nth 8", "crash b after 110ms"),
    ),
    Found(
        "a death that no Watchdog was there to see was forgotten",
        "pbr",
        "lfr",
        "process",
        89,
        ("crash b/proceed at adapt.step.act nth 9", "crash a/watchdog after 11ms"),
    ),
    Found(
        "a hang at the last step held the request for ever",
        "pbr",
        "lfr",
        "process",
        0,
        ("hang a/after' at adapt.step.enter nth 7",),
    ),
    Found(
        "the same, of what has taken its place",
        "pbr",
        "lfr",
        "process",
        0,
        ("hang a/after at adapt.step.enter nth 9",),
    ),
    Found(
        "a process that is not born yet could not be stopped",
        "lfr",
        "pbr",
        "process",
        0,
        ("hang b/before' at adapt.step.act nth 4",),
    ),
    Found(
        "a Watchdog was replaced for which the new graph has no place",
        "pbr",
        "tr",
        "process",
        106,
        ("crash b/watchdog at adapt.step.enter nth 4",),
    ),
)


@pytest.mark.parametrize("found", ADAPTATIONS, ids=[f.what for f in ADAPTATIONS])
def test_an_adaptation_that_broke_a_promise(found: Found) -> None:
    setup = Setup(
        found.old,
        found.placement,
        seed=found.seed,
        count=40,
        rate_hz=400.0,
        faults=tuple(map(parse, found.faults)),
        adaptations=(Scheduled(Goal(expression=found.new), 4),),
    )
    assert breaches(simulate(setup)) == ()


OTHERS: Final = {
    "a new Client asked before the way back stood": Setup("lfr", count=6, dooms=(Doom("client", 6),)),
    "a Watchdog died before it could tell": Setup(
        "pbr",
        count=40,
        rate_hz=2000.0,
        faults=(parse("crash primary at request.received nth 3"), parse("crash a/watchdog after 1ms")),
    ),
    "a Client that asked twice was answered twice": Setup(
        "pbr",
        count=40,
        rate_hz=2000.0,
        faults=(parse("hang primary at request.received nth 3"), parse("crash client after 2ms")),
    ),
    "an adaptation waited for a request in a Client that was dead": Setup(
        "pbr",
        "replica",
        seed=17,
        count=160,
        rate_hz=1869.0,
        faults=(parse("crash client at adapt.step.act nth 4"),),
        adaptations=(
            Scheduled(Goal(expression="pbr+tr"), 146),
            Scheduled(Goal(expression="lfr+assert"), 160),
        ),
    ),
}


@pytest.mark.parametrize("what", OTHERS)
def test_a_run_that_broke_a_promise(what: str) -> None:
    assert breaches(simulate(OTHERS[what])) == ()


def test_a_script_that_was_ordered_before_the_last_one_was_done_is_not_carried_out() -> None:
    """Recovery decides anew when it hears of the last one: what it ordered before would be the end of all."""
    world = World(Setup("pbr", count=40, rate_hz=400.0, faults=(parse("crash primary after 5ms"),)))
    world.start()
    world.advance(world.loop.ns + 20 * MS)
    deployment = world.controller.deployment
    assert (deployment.leader, deployment.backup, deployment.epoch) == ("b", "a", 2)
    recovery = deployment.nodes["recovery"]
    for old_news in (
        failover("a", "b", 2),
        failover("b", "a", 2),
        drop_backup("a", "b", replication_of("pbr")),
        new_backup("b", "a", replication_of("pbr"), STATEFUL),
    ):
        world.controller.on_report(recovery, control.Ordered("recovery", old_news))
    world.end()
    run = world.outcome()
    assert breaches(run) == () and run.rest.leader == "b"
    assert [text for _, event, text in run.logged if event == "script"] == ["failover (a)", "new backup (a)"]

"""Scripts of Recovery that fail, or come too late, or by what was true before: what is left behind them.

Recovery tries again, so a run with such a script comes to its rest all the same; what counts is what happens
until then.
"""

from collections.abc import Iterator
from itertools import pairwise
from typing import Final

import pytest
from msgspec.structs import replace

from aftbed.core.events import Event
from aftbed.core.journal import EntryKind
from aftbed.core.messages import Goal
from aftbed.core.script import ScriptKind
from aftbed.ftm.failover import failover
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Trigger
from aftbed.inject.hang import Hang
from aftbed.inject.model import Fault, parse
from aftbed.judge.simulated import breaches, needless_stops
from aftbed.runtime.sim.node_io import SimChannel
from aftbed.runtime.sim.world import Run, Setup, World

MS: Final = 1_000_000
RATE_HZ: Final = 1000.0
PAUSE_MS_MAX: Final = 10.0  # between two answers; Recovery tries again after 50 ms
PATIENCE_MS: Final = 10_000
LOSS_MS_MAX: Final = 1000  # a leader that is to be promoted has two seconds


def begun(count: int, ftm: str = "pbr") -> World:
    """A run whose requests are answered."""
    world = World(Setup(ftm, "process", 0, count, RATE_HZ))
    world.start()
    pass_ms(world, 5)
    return world


def pass_ms(world: World, ms: float) -> None:
    world.advance(world.loop.ns + round(ms * MS))


def crash(world: World, node: str) -> None:
    world.inject(Fault(Crash(), node, Trigger()))


def until(world: World, event: str, text: str) -> int:
    """Step to the first such line of the log; when it was written."""
    limit_ns = world.loop.ns + PATIENCE_MS * MS
    while True:
        for at_ns, *line in world.logged:
            if line == [event, text]:
                return at_ns
        assert world.loop.step() and world.loop.ns < limit_ns, f"no {event}: {text}"
        world.loop.watch_jobs()


def test_a_replica_that_is_being_made_is_not_watched_yet() -> None:
    """Its nodes have no journals before they have become what they are; a new Watchdog ended in an error."""
    world = begun(0)
    deployment = world.controller.deployment
    slot = deployment.slots["b"]
    assert next(deployment.watch(slot), None) is not None
    next(deployment.spawn(slot))
    assert list(deployment.watch(slot)) == []


def pauses_ms(world: World) -> Iterator[float]:
    """The times between one answer and the next."""
    answers = [entry.t_ns for entry in world.dialogue if entry.kind is EntryKind.ANSWERED]
    return ((after - before) / MS for before, after in pairwise(answers))


@pytest.mark.parametrize("ftm", ["pbr", "lfr"])
def test_the_leader_goes_on_where_its_new_backup_dies_before_it_is_bound(ftm: str) -> None:
    """At each step of the script: a leader that is suspended for it goes on at once, not at the next try."""
    failures = set()
    for half in range(12):
        world = begun(30, ftm)
        crash(world, "b/server")
        until(world, "script", "new backup (b)")
        pass_ms(world, half / 2)
        crash(world, "b/after")
        world.end()
        run = world.outcome()
        failures |= {script.failure for script in run.scripts}
        assert breaches(run) == ()
        assert max(pauses_ms(world)) < PAUSE_MS_MAX, f"{half / 2} ms after the script has begun"
    assert failures >= {"", "b/after died", "b/after is gone"}


@pytest.mark.parametrize("ftm", ["pbr", "lfr"])
def test_a_leader_to_be_that_is_dead_is_not_waited_for(ftm: str) -> None:
    """Its Watchdog hangs, so Recovery knows nothing of its death, and orders a failover to it."""
    world = begun(60, ftm)
    world.inject(Fault(Hang(), "b/watchdog", Trigger()))
    crash(world, "b/server")
    pass_ms(world, 2)
    crash(world, "a/server")
    began_ns = world.loop.ns
    lost_ns = until(world, "lost", "no replica is left: the service is gone")
    assert world.controller.scripts[0].failure == "b/server died"
    assert lost_ns - began_ns < LOSS_MS_MAX * MS


@pytest.mark.parametrize("ftm", ["pbr", "lfr"])
def test_what_a_fenced_leader_still_says_goes_nowhere_once_the_proxy_follows_another(ftm: str) -> None:
    """It hangs with a reply on its way, and may go on at any time before it is killed."""
    world = begun(60, ftm)
    deployment = world.controller.deployment
    last_words = deployment.channels.get("a/protocol", "pro2pxy", "proxy")
    assert last_words is not None
    world.inject(Fault(Hang(), "a/protocol", Trigger()))
    limit_ns = world.loop.ns + PATIENCE_MS * MS
    while deployment.leader != "b":
        assert isinstance(last_words, SimChannel) and last_words.has_room()
        assert world.loop.step() and world.loop.ns < limit_ns
        world.loop.watch_jobs()
    assert deployment.lives("a/protocol") and not last_words.has_room()


@pytest.mark.parametrize("tenth", range(0, 40, 2))
def test_a_suspicion_of_a_replica_does_not_count_for_the_one_that_comes_after_it(tenth: int) -> None:
    """A new Recovery hears of it again, at a time when the new backup is perhaps being made."""
    world = begun(40)
    crash(world, "a/server")
    pass_ms(world, tenth / 10)
    crash(world, "recovery")
    world.end()
    run = world.outcome()
    assert breaches(run) == ()
    assert [script.kind for script in run.scripts] == [ScriptKind.FAILOVER, ScriptKind.NEW_BACKUP]


@pytest.mark.parametrize("other", ["recovery", "a/watchdog"])
@pytest.mark.parametrize("ms", [0.8, 2.0])
def test_recovery_waits_for_the_way_back_however_late_the_engine_orders_it(other: str, ms: float) -> None:
    """A replica dies while an adaptation is observed, and the Engine hangs: Recovery is asked once more."""
    world = begun(300)
    world.adapt(Goal(expression="lfr"))
    pass_ms(world, 30)
    world.inject(Fault(Hang(), "engine", Trigger()))
    pass_ms(world, 1)
    crash(world, "a/after")
    pass_ms(world, ms)
    crash(world, other)
    world.end()
    run = world.outcome()
    assert breaches(run) == ()
    assert [adaptation.outcome for adaptation in run.adaptations] == ["rolled back"]
    assert [script.kind for script in run.scripts] == [ScriptKind.FAILOVER, ScriptKind.NEW_BACKUP]


def test_a_failover_that_was_ordered_before_the_backup_went_is_stale() -> None:
    """An adaptation to one replica has come in between."""
    world = begun(300)
    ordered = failover("a", "b", world.controller.deployment.epoch + 1)
    assert not world.controller.executor.stale(ordered)
    world.adapt(Goal(expression="tr"))
    world.end()
    assert world.controller.deployment.graph.ftm == "tr"
    assert world.controller.executor.stale(ordered)


def test_a_supervised_replica_may_stop_where_no_watchdog_is_left_to_suspect_it() -> None:
    """Found by test_machine in profile `deep`: its Server is killed while the run goes on."""
    world = World(Setup("lfr+sup", "process", 41532, 96, 500.0))
    world.start()
    crash(world, "client")
    world.inject(Fault(Crash(), "primary", Trigger(Event.SERVER_EXIT.label)))
    crash(world, "a/watchdog")
    world.adapt(Goal(expression="pbr"))
    for node in ("client", "client", "client", "client", "b/watchdog", "b/protocol"):
        crash(world, node)
    world.end()
    run = world.outcome()
    assert breaches(run) == ()
    assert run.struck and run.history.events(Event.FAULT_APPLIED)
    assert [one.check for one in needless_stops(stopped_at_the_start(run))] == ["needless_stop"]


def test_a_fault_excuses_no_stop_before_it_has_struck() -> None:
    """Of a supervised run whose faults are those of its setup."""
    fault = parse("slow primary by 20ms at before.exit nth 10")
    world = World(Setup("lfr+sup", "process", 41532, 96, 500.0, faults=(fault,)))
    world.start()
    world.end()
    run = world.outcome()
    assert breaches(run) == ()
    assert [one.check for one in needless_stops(stopped_at_the_start(run))] == ["needless_stop"]


def stopped_at_the_start(run: Run) -> Run:
    """The same run, whose only stop was before any strike."""
    (stop,) = run.history.events(Event.DETECTED_STOP)
    journals = {
        name: [replace(one, t_ns=0) if one == stop else one for one in records]
        for name, records in run.history.journals.items()
    }
    return replace(run, history=replace(run.history, journals=journals))

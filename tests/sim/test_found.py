"""Experiments that broke a promise once, found by `test_machine` or a swarm and shrunk; each stays mended."""

from typing import Final

import pytest

from aftbed.core.events import Event
from aftbed.core.messages import Goal, Scheduled
from aftbed.inject.channel import ChannelFault, Disturbance
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Bit, Trigger
from aftbed.inject.hang import Hang
from aftbed.inject.model import Fault
from aftbed.inject.value import ValueFlip, ValuePlace
from aftbed.judge.simulated import breaches
from aftbed.runtime.sim.world import Setup, simulate
from aftbed.search.explore import attempt

AT_MS: Final = 5.0


def dies(target: str, after_ms: float) -> Fault:
    """A crash at a time."""
    return Fault(Crash(), target, Trigger(after_ms=after_ms))


def wanted(expression: str) -> tuple[Scheduled, ...]:
    """An adaptation at `AT_MS`."""
    return (Scheduled(Goal(expression=expression), after_ms=AT_MS),)


def wanted_at(expression: str, request: int) -> tuple[Scheduled, ...]:
    return (Scheduled(Goal(expression=expression), at_request=request),)


def hangs(target: str, for_ms: int, event: str, nth: int) -> Fault:
    return Fault(Hang(for_ms), target, Trigger(event, nth))


FOUND: Final = {
    # A backup whose Server refuses a checkpoint waited for its answer, and could take over nothing for ever.
    "a checkpoint that is refused": Setup(
        "pbr",
        count=300,
        rate_hz=2000.0,
        faults=(
            Fault(ValueFlip(ValuePlace.CHECKPOINT, Bit(0)), "primary", Trigger("checkpoint.sent", 5)),
            Fault(Crash(), "primary", Trigger("reply.sent", 200)),
        ),
    ),
    # The successor dies while it is bound: it is replaced for its own death, and again for the failure.
    "two clients": Setup("pbr", count=40, rate_hz=500.0, faults=(dies("client", 1.0), dies("client", 1.9))),
    "two recoveries": Setup(
        "pbr", "replica", count=40, rate_hz=500.0, faults=(dies("recovery", 1.0), dies("recovery", 2.2))
    ),
    # The Engine hangs with the graph it was asked about, and plans by it when another replica leads.
    "a plan of before the failover": Setup(
        "pbr",
        count=100,
        rate_hz=500.0,
        faults=(
            Fault(Hang(100), "engine", Trigger(after_ms=AT_MS - 1)),
            dies("a/protocol", 20.0),
        ),
        adaptations=wanted("tr"),
    ),
    # A replica dies between the question and the Engine's first order: both scripts act at once.
    "a loss between the question and the order": Setup(
        "pbr+assert",
        "replica",
        5,
        count=100,
        rate_hz=2000.0,
        faults=(dies("b", AT_MS - 0.15),),
        adaptations=wanted("lfr+assert"),
    ),
    "a failover between the question and the order": Setup(
        "pbr",
        count=100,
        rate_hz=2000.0,
        faults=(dies("a/server", AT_MS - 0.3),),
        adaptations=wanted("tr"),
    ),
    # A Watchdog dies between the step that exchanges it and the end of the commit.
    "a staged node of no replica": Setup(
        "tr",
        "replica",
        count=1,
        faults=(Fault(Crash(), "b/watchdog'", Trigger("adapt.step.exit", 4)),),
        adaptations=(Scheduled(Goal(expression="lfr+tr"), 1),),
    ),
    # The fault moves to the new leader, whose channel to a backup leads nowhere yet.
    "a channel that is not bound yet": Setup(
        "pbr",
        count=40,
        rate_hz=500.0,
        faults=(
            Fault(ChannelFault(Disturbance.DELAY, "aft2aft", 2.0), "primary", Trigger(nth=3)),
            Fault(Crash(), "a/after", Trigger("server.enter", 1)),
        ),
    ),
    # The way back unbinds what is inside the node that serves again.
    "half a graph after the way back": Setup(
        "lfr+tr",
        "replica",
        count=40,
        rate_hz=400.0,
        faults=(Fault(Crash(), "recovery", Trigger("adapt.step.enter", 3)),),
        adaptations=(Scheduled(Goal(expression="tr"), 4),),
    ),
    # Both replicas are suspected: one is given up, and the other one got no backup for ever.
    "two hangs": Setup(
        "pbr",
        count=100,
        rate_hz=500.0,
        faults=(hangs("backup", 120, "request.sent", 29), hangs("primary", 120, "request.sent", 30)),
    ),
    # The way back from two replicas to one, which is the one that hangs: it lost what was under way there.
    "the only replica of the old graph": Setup(
        "tr",
        count=66,
        rate_hz=497.0,
        faults=(hangs("primary", 65, "server.enter", 130),),
        adaptations=wanted_at("pbr", 62),
    ),
    # After a failover to `b`, one replica alone is `b`: the judge asked for `a`.
    "one replica alone behind a failover": Setup(
        "pbr",
        count=2,
        faults=(hangs("primary", 50, "server.enter", 1),),
        adaptations=wanted_at("assert+tr", 2),
    ),
    # Supervision stopped a slow leader, whose backup was lost, for a new one to take its place.
    **{
        f"a slow leader alone under {ftm}": Setup(
            ftm,
            count=60,
            rate_hz=1000.0,
            faults=(
                Fault(Crash(), "backup", Trigger("server.exit", 20)),
                Fault(ChannelFault(Disturbance.DELAY, "srv2prd", 40.0), "primary", Trigger(nth=22)),
            ),
        )
        for ftm in ("pbr+sup", "lfr+sup")
    },
}


@pytest.mark.parametrize("name", FOUND)
def test_it_is_mended(name: str) -> None:
    _, broken = attempt(FOUND[name])
    assert broken == ()


@pytest.mark.parametrize("ftm", ["pbr+sup", "lfr+sup"])
def test_a_slow_leader_that_has_a_backup_again_is_stopped(ftm: str) -> None:
    """Its first backup was lost as above; the new one takes its place."""
    slow = Fault(ChannelFault(Disturbance.DELAY, "srv2prd", 40.0), "primary", Trigger(nth=40))
    crash = Fault(Crash(), "backup", Trigger("server.exit", 5))
    run = simulate(Setup(ftm, count=60, rate_hz=200.0, faults=(crash, slow)))
    assert breaches(run) == ()
    assert len(run.history.events(Event.DETECTED_STOP)) == 1
    assert len(run.history.events(Event.REPLICA_PROMOTED)) == 1


def test_a_leader_that_dies_while_the_way_from_one_replica_to_two_is_observed_is_failed_over_from() -> None:
    """The judge excuses the loss of one that was alone for a time; here it need not be lost."""
    fault = Fault(Crash(), "primary", Trigger("server.enter", 130))
    run = simulate(Setup("tr", count=66, rate_hz=497.0, faults=(fault,), adaptations=wanted_at("pbr", 62)))
    assert (run.rest.lost, run.rest.leader) == (False, "b")
    assert [one.outcome for one in run.adaptations] == ["done"]
    assert breaches(run) == ()

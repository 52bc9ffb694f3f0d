"""Deaths between any two effects, value faults in any execution: each at a point that hypothesis draws.

The explorers try every point of a short run with one fault. Here runs are longer, some messages are slow, and
what is asked at the end is more: nothing is left inside of any brick, and every Server that lives has the
state of a bare one that did the same. `Counting` is protected: each of its replies depends on all requests
before.
"""

from collections.abc import Sequence
from functools import lru_cache
from random import Random
from typing import Final

import pytest
from counting import Counting
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from aftbed.core.events import Event
from aftbed.core.journal import EntryKind
from aftbed.ftm.compose import EXPRESSIONS, build, chain, parse, replication_of
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Bit, Trigger
from aftbed.inject.model import Fault
from aftbed.inject.value import EXECUTED, ValueFlip, ValuePlace
from aftbed.judge import checks
from aftbed.judge.reference import reference_run
from aftbed.judge.simulated import breaches
from aftbed.runtime.sim.clock import Clock
from aftbed.runtime.sim.processes import SimProcess
from aftbed.runtime.sim.world import Doom, Run, Setup, World

NESTED: Final = ("pbr+assert+tr", "lfr+assert+tr")
DUPLEX: Final = (*(e for e in EXPRESSIONS if replication_of(e)), *NESTED)
SAMPLE: Final = ("pbr", "lfr", "pbr+tr", "lfr+assert+tr")  # in which each mechanism occurs
SIMPLEX: Final = tuple(e for e in EXPRESSIONS if e != "none" and not replication_of(e))
VOTING: Final = (*(e for e in EXPRESSIONS if "tr" in parse(e)), *NESTED)
DETECTING: Final = tuple(e for e in DUPLEX if "assert" in parse(e) and "tr" not in parse(e))
ANY: Final = 10_000  # a number of an effect, modulo how many there are
SLOW: Final = 16  # one of so many messages takes so many times longer
SEEN: Final = 6  # the highest bit of a digit: flipped, it is none
BITS: Final = {
    ValuePlace.RESULT: (0, 16),
    ValuePlace.STATE: (8, 15),
}  # of the first digits; of the number of requests
FEW: Final = settings.default.max_examples // 6

seeds = st.integers(0, 2**32)
pytestmark = pytest.mark.timeout(900)  # in profile `deep`; seconds in the others


class Uneven(Clock):
    """Now and then a reader hardly gets to run: mail piles up before it, and scripts wait."""

    def hop_ns(self) -> int:
        """As measured, or much longer."""
        return super().hop_ns() * (SLOW if self.chance.randrange(SLOW) == 0 else 1)


def requests(count: int) -> list[bytes]:
    """Each another one."""
    return [b"request %d" % number for number in range(1, count + 1)]


def played(setup: Setup, payloads: Sequence[bytes] = ()) -> tuple[World, Run]:
    """A run over `Counting`, to its rest."""
    clock = Uneven if setup.seed % 2 else Clock
    loads = list(payloads) or requests(setup.count)
    world = World(setup, function=Counting, requests=loads, clock=clock)
    return world, world.run()


def assert_promises(world: World, run: Run) -> None:
    """G1 to G6 and the rest; nothing is left inside, and all replicas are in the state of a bare server."""
    assert breaches(run, function=Counting) == ()
    bare = Counting()
    for entry in run.history.dialogue:
        if entry.kind is EntryKind.SENT:
            bare.execute(entry.payload)
    assert run.history.events(Event.FOLLOWER_DIVERGED) == []
    servers = 0
    for process in world.controller.deployment.nodes.values():
        assert isinstance(process, SimProcess) and process.node is not None
        for hosted in process.node.bricks.values():
            assert hosted.brick.quiescent(), f"something is left inside of {hosted.name}"
            if hosted.name.endswith("/server"):
                servers += 1
                assert hosted.brick.capture() == bare.capture(), hosted.name
    assert servers == (2 if replication_of(run.rest.graph.ftm) else 1)


def bricks_of(ftm: str, replica: str) -> list[str]:
    """Those that a replica needs."""
    return chain(build(ftm, "process"), replica)


@lru_cache(maxsize=256)
def effects(ftm: str, placement: str, count: int) -> dict[str, int]:
    """How many each brick performs where nothing goes wrong."""
    return played(Setup(ftm, placement, 0, count))[1].effects


def doomed(setup: Setup, brick: str, at: int) -> Doom:
    """At one of its effects, or behind the last."""
    return Doom(brick, at % (effects(setup.ftm, setup.placement, setup.count)[brick] + 1))


@pytest.mark.simulation
@pytest.mark.parametrize(
    "ftm", [pytest.param(e, marks=[] if e in SAMPLE else [pytest.mark.deep]) for e in DUPLEX]
)
def test_who_speaks_to_the_other_replica_or_the_proxy_may_die_at_each_effect(ftm: str) -> None:
    """All there are over two requests: here the order of a mechanism's effects is what it promises."""
    setup = Setup(ftm, "process", 0, 2)
    links = [k for k in build(ftm, "process").links if "/" in k.source]
    outward = {k.source for k in links if k.source[:2] != k.sink[:2]}
    for brick in sorted(outward - {"a/watchdog", "b/watchdog"}):
        for at in range(effects(ftm, "process", 2)[brick] + 1):
            world, run = played(replace(setup, dooms=(Doom(brick, at),)))
            assert_promises(world, run)


@pytest.mark.parametrize("ftm", DUPLEX)
@settings(max_examples=FEW)
@given(
    seed=seeds,
    count=st.integers(1, 8),
    placement=st.sampled_from(("process", "replica")),
    role=st.sampled_from("ab"),
    part=st.integers(0, 99),
    at=st.integers(0, ANY),
)
def test_a_replica_may_die_between_any_two_effects(
    ftm: str, seed: int, count: int, placement: str, role: str, part: int, at: int
) -> None:
    """And another one is there at the end, which knows everything."""
    parts = bricks_of(ftm, role)
    setup = Setup(ftm, placement, seed, count)
    world, run = played(replace(setup, dooms=(doomed(setup, parts[part % len(parts)], at),)))
    assert_promises(world, run)
    died = any(one.node.startswith(role) for one in run.struck)
    assert run.rest.leader == ("b" if died and role == "a" else "a")
    assert world.controller.deployment.epoch == (2 if died and role == "a" else 1)


@pytest.mark.parametrize("ftm", DUPLEX)
@settings(max_examples=FEW)
@given(
    seed=seeds,
    at=st.integers(0, ANY),
    part=st.integers(0, 99),
    role=st.sampled_from("ab"),
    other=st.sampled_from(("proxy", "recovery", "a/watchdog", "b/watchdog", "client", "engine")),
    later=st.integers(0, ANY),
)
def test_who_belongs_to_no_replica_may_die_as_well(
    ftm: str, seed: int, at: int, part: int, role: str, other: str, later: int
) -> None:
    parts = bricks_of(ftm, role)
    setup = Setup(ftm, "process", seed, 6)
    dooms = (doomed(setup, parts[part % len(parts)], at), doomed(setup, other, later))
    world, run = played(replace(setup, dooms=dooms))
    assert_promises(world, run)


@pytest.mark.parametrize("ftm", DUPLEX)
@settings(max_examples=FEW // 2)
@given(seed=seeds, event=st.sampled_from((Event.REQUEST_RECEIVED, Event.SERVER_EXIT, Event.REPLY_STORED)))
def test_one_replica_after_the_other_may_die(ftm: str, seed: int, event: Event) -> None:
    """The second one when redundancy is back: what leads then was made by state transfer."""
    nths = (2, 40)
    faults = tuple(Fault(Crash(), "primary", Trigger(event.label, nth)) for nth in nths)
    world, run = played(Setup(ftm, "process", seed, 80, 2000.0, faults))
    assert_promises(world, run)
    assert world.controller.deployment.epoch == 1 + sum(f.fired for f in run.faults) > 1


def transient(ftm: str, role: str, count: int, random: Random) -> tuple[Fault, ...]:
    """At most one bit per request, each in one of its two trials; a third one follows."""
    found: list[Fault] = []
    for request in range(count):
        if random.random() < 0.4:
            nth = 2 * request + len(found) + random.choice((1, 2))
            place = random.choice(EXECUTED)
            flip = ValueFlip(place, Bit(random.randrange(*BITS[place])))
            found.append(Fault(flip, role, Trigger(Event.SERVER_EXIT.label, nth)))
    return tuple(found)


@pytest.mark.parametrize("ftm", VOTING)
@settings(max_examples=FEW)
@given(seed=seeds, count=st.integers(1, 8))
def test_one_value_fault_per_request_never_reaches_the_client(ftm: str, seed: int, count: int) -> None:
    """G4, and it is corrected: no replica stops, and only a request with a fault costs a third trial."""
    random = Random(seed)
    roles = ("primary", "backup") if ftm.startswith("lfr") else ("primary",)
    faults = tuple(f for role in roles for f in transient(ftm, role, count, random))
    world, run = played(Setup(ftm, "process", seed, count, faults=faults))
    assert_promises(world, run)
    applied = sum(f.fired for f in run.faults)
    votes = [r.detail for r in run.history.events(Event.VOTE_COMPARED)]
    assert (votes.count(3), votes.count(2)) == (applied, len(roles) * count - applied)
    assert run.history.events(Event.DETECTED_STOP) == [] and world.controller.deployment.epoch == 1
    assert applied == len(faults)


@pytest.mark.parametrize("ftm", DETECTING)
@settings(max_examples=FEW)
@given(seed=seeds, role=st.sampled_from(("primary", "backup")), nth=st.integers(1, 4))
def test_what_an_assertion_finds_stops_one_replica_and_the_other_goes_on(
    ftm: str, seed: int, role: str, nth: int
) -> None:
    if role == "backup" and not ftm.startswith("lfr"):
        return  # it executes nothing
    fault = Fault(ValueFlip(ValuePlace.RESULT, Bit(SEEN)), role, Trigger(Event.SERVER_EXIT.label, nth))
    world, run = played(Setup(ftm, "process", seed, 5, faults=(fault,)))
    assert_promises(world, run)
    assert len(run.history.events(Event.DETECTED_STOP)) == 1
    assert run.rest.leader == ("b" if role == "primary" else "a")


@pytest.mark.parametrize("ftm", ["none", "pbr", "lfr"])
def test_without_a_mechanism_against_it_a_value_fault_reaches_the_client(ftm: str) -> None:
    """What the tests above do is done: where nothing is there to find it, it is found by the check."""
    fault = Fault(ValueFlip(ValuePlace.RESULT, Bit(0)), "primary", Trigger(Event.SERVER_EXIT.label, 2))
    _, run = played(Setup(ftm, count=3, faults=(fault,)))
    assert checks.wrong_replies(run.history, reference_run(run.history, Counting())).keys() == {2}


@pytest.mark.parametrize("ftm", (*EXPRESSIONS, *NESTED))
def test_a_request_that_the_function_refuses_does_not_stand_in_the_way_of_the_next(ftm: str) -> None:
    _, run = played(Setup(ftm, count=3), [b"before", b"", b"after"])
    answers = [e for e in run.history.dialogue if e.kind is EntryKind.ANSWERED]
    assert [(e.request_id, bool(e.payload)) for e in answers] == [(1, True), (2, False), (3, True)]
    assert breaches(run, function=Counting) == ()


@pytest.mark.parametrize("ftm", SIMPLEX)
def test_with_one_replica_a_crash_ends_the_service_and_nothing_else_is_tried(ftm: str) -> None:
    last = next(brick for brick in bricks_of(ftm, "a") if brick.endswith("proceed"))
    fault = Fault(Crash(), last, Trigger(Event.REQUEST_SENT.label, 2))
    _, run = played(Setup(ftm, count=2, faults=(fault,)))
    assert run.rest.lost
    assert [e.request_id for e in run.history.dialogue if e.kind is EntryKind.ANSWERED] == [1]
    assert len(run.history.events(Event.WATCHDOG_SUSPECT)) == 1
    assert run.history.events(Event.RECOVERY_ENTER, Event.REPLICA_FENCED) == []

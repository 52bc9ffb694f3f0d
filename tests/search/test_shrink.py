"""What shrinking comes to: a known minimum, the same promise, the same each time, and never what is whole."""

import zlib
from collections.abc import Callable, Iterator

import pytest
from msgspec import json
from msgspec.structs import replace

from aftbed.adapt.engine import AdaptationEngine
from aftbed.core.brick import Brick, Effect
from aftbed.core.graph import BrickSpec
from aftbed.core.messages import Goal, Scheduled, StateCaptured
from aftbed.ftm.pbr import PbrAfter
from aftbed.ftm.registry import Setting, make
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Trigger
from aftbed.inject.hang import Hang
from aftbed.inject.model import Fault
from aftbed.inject.value import ValueFlip, ValuePlace
from aftbed.judge.simulated import breaches
from aftbed.judge.verdict import Breach
from aftbed.runtime.sim.world import Doom, Setup, World
from aftbed.search.shrink import shrink
from aftbed.search.swarm import experiments

pytestmark = pytest.mark.simulation

Broken = Callable[[Setup], tuple[Breach, ...]]

CRASH = Fault(Crash(), "a/after", Trigger("server.exit", 30))
HANG = Fault(Hang(90), "b/server", Trigger(after_ms=20.0))
FLIP = Fault(ValueFlip(ValuePlace.RESULT), "primary", Trigger("server.exit", 60))
TO_PBR = Scheduled(Goal(expression="pbr"), 80)
TO_LFR = Scheduled(Goal(expression="lfr+tr"), 150)
TO_LFR_EARLY = replace(TO_LFR, at_request=20)
LARGE = Setup("lfr+tr", "process", 5, 200, 1000.0, (HANG, CRASH, FLIP), (TO_PBR, TO_LFR))
G1, G2 = Breach("G1", "twice"), Breach("G2", "lost")


def where(broken: Callable[[Setup], bool], breach: Breach = G1) -> Broken:
    return lambda setup: (breach,) if broken(setup) else ()


def test_a_crash_and_seven_requests_are_left_of_it() -> None:
    def broken(setup: Setup) -> bool:
        return setup.count >= 7 and any(f.target == "a/after" for f in setup.faults)

    least = Fault(Crash(), "a/after", Trigger("server.exit", 1))
    assert shrink(LARGE, where(broken)) == Setup("pbr", "process", 5, 7, 0.0, (least,))


def test_what_it_takes_stays() -> None:
    def broken(setup: Setup) -> bool:
        hangs = [
            f
            for f in setup.faults
            if isinstance(f.action, Hang) and f.action.for_ms > 60 and f.trigger.after_ms >= 3
        ]
        late = any(a.at_request >= 11 for a in setup.adaptations)
        return bool(hangs) and late and setup.rate_hz > 0 and "lfr" in setup.ftm

    found = shrink(LARGE, where(broken))
    (hang,), (adaptation,) = found.faults, found.adaptations
    assert hang.action == Hang(61) and 3 <= hang.trigger.after_ms < 6
    assert (found.ftm, found.rate_hz, adaptation.at_request, found.count) == ("lfr", 1000.0, 11, 11)


def test_where_a_bit_is_flipped_tr_stays() -> None:
    found = shrink(LARGE, where(lambda setup: any(isinstance(f.action, ValueFlip) for f in setup.faults)))
    assert found == Setup("pbr+tr", "process", 5, 1, 0.0, (replace(FLIP, trigger=Trigger("server.exit", 1)),))


def test_another_promise_is_no_simpler_way_to_break_this_one() -> None:
    def broken(setup: Setup) -> tuple[Breach, ...]:
        return (G1, G2) if setup.count > 50 else (G2,)

    assert shrink(LARGE, broken).count == 51


def test_nothing_is_planned_behind_the_last_request() -> None:
    seen: list[Setup] = []

    def broken(setup: Setup) -> bool:
        seen.append(setup)
        return bool(setup.adaptations) and HANG.target in {f.target for f in setup.faults}

    shrink(LARGE, where(broken))
    assert len(seen) > 20
    for setup in seen:
        last_ms = max(0.6, (setup.count - 1) * (1e3 / setup.rate_hz if setup.rate_hz else 0.02))
        assert all(a.at_request <= setup.count for a in setup.adaptations)
        assert all(f.trigger.after_ms <= last_ms for f in setup.faults)


def test_a_car_gives_way_to_a_load() -> None:
    found = shrink(replace(LARGE, scenario="ccrs-50"), where(lambda setup: True))
    assert found == Setup("pbr", "process", 5, 1, 0.0)


def test_what_the_graph_does_not_have_is_not_tried() -> None:
    node = Fault(Crash(), "a", Trigger("request.received", 1))  # of placement `replica`
    inner = Doom("a/tr.before", 3)
    setup = Setup("pbr+tr", "replica", 5, 1, 0.0, (node,), dooms=(inner,))
    found = shrink(setup, where(lambda setup: bool(setup.faults and setup.dooms)))
    assert found == replace(setup, dooms=(Doom("a/tr.before", 0),))


def test_no_more_is_tried_than_allowed() -> None:
    for tries_max in (1, 2, 10, 20):
        tried: list[Setup] = []

        def broken(setup: Setup, tried: list[Setup] = tried) -> bool:
            tried.append(setup)
            return len(tried) % 3 == 1

        shrink(LARGE, where(broken), tries_max)
        assert len(tried) == tries_max
        assert len({json.encode(setup) for setup in tried}) == tries_max  # none of them twice


def test_what_belongs_together_comes_earlier_together() -> None:
    def broken(setup: Setup) -> bool:
        crashes = [f.trigger.nth for f in setup.faults if f.target == CRASH.target]
        return any(nth == setup.count - 12 for nth in crashes)

    found = shrink(replace(LARGE, count=42), where(broken))
    assert (found.count, found.faults[0].trigger.nth) == (13, 1)


def test_what_is_left_is_broken_and_the_same_each_time() -> None:
    for setup in experiments(range(40)):

        def broken(simpler: Setup, setup: Setup = setup) -> tuple[Breach, ...]:
            """At random, but the same again."""
            found = simpler == setup or zlib.crc32(json.encode(simpler)) % 3 == 0
            return (G1,) if found else ()

        found = shrink(setup, broken)
        assert broken(found) and found == shrink(setup, broken)


def test_what_breaks_nothing_cannot_be_shrunk() -> None:
    with pytest.raises(AssertionError, match="nothing is broken"):
        shrink(LARGE, lambda setup: ())


# -- a bug in a mechanism --------------------------------------------------------------------------


class ReplyFirst(PbrAfter):
    """The reply before the checkpoint: a client may hold what the backup never knew."""

    def checkpoint_then_reply(self, msg: StateCaptured) -> list[Effect]:
        return super().checkpoint_then_reply(msg)[::-1]


def with_the_bug(spec: BrickSpec, setting: Setting) -> Brick:
    if spec.kind == "engine":
        return AdaptationEngine()
    return ReplyFirst(setting.epoch, setting.leads) if spec.kind == "pbr.after" else make(spec.kind, setting)


def with_the_bug_broken(setup: Setup) -> tuple[Breach, ...]:
    return breaches(World(setup, make=with_the_bug).run())


def suspects() -> Iterator[Setup]:
    """Of a swarm, those that have more than one thing going on, a crash at a checkpoint among them."""
    for setup in experiments(range(20_000)):
        crashes = [f for f in setup.faults if (f.action, f.event) == (Crash(), "checkpoint.sent")]
        busy = len(setup.faults) > 1 and setup.adaptations and not setup.scenario
        if busy and "pbr" in setup.ftm and any(f.target == "primary" for f in crashes):
            yield setup


def assert_it_shrinks_to_one_crash(setup: Setup) -> None:
    first = with_the_bug_broken(setup)
    least = shrink(setup, with_the_bug_broken)
    assert with_the_bug_broken(least)[0].promise == first[0].promise
    assert len(least.faults) == 1 and not least.adaptations and least.count <= 5, least
    assert least.faults[0].action == Crash()
    assert least.seed == setup.seed and not breaches(World(least).run())


def test_what_breaks_a_mechanism_with_a_bug_shrinks_to_one_fault() -> None:
    crash = Fault(Crash(), "primary", Trigger("checkpoint.sent", 15))
    assert_it_shrinks_to_one_crash(Setup("pbr", "process", 5, 30, 1000.0, (crash, HANG), (TO_LFR_EARLY,)))


@pytest.mark.deep
def test_a_swarm_finds_the_bug() -> None:
    found = (s for s in suspects() if with_the_bug_broken(s) and not breaches(World(s).run()))
    assert_it_shrinks_to_one_crash(next(found))

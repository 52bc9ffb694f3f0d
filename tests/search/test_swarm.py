"""A swarm's experiment is made of its seed alone, is within what is promised, and so breaks nothing."""

from collections import Counter
from functools import lru_cache
from itertools import pairwise
from statistics import mean

import pytest
from msgspec import json

from aftbed.core.events import Event
from aftbed.core.graph import STAGED
from aftbed.ftm.compose import build, parse, replication_of
from aftbed.inject import targets
from aftbed.inject.channel import ChannelFault
from aftbed.inject.crash import Crash
from aftbed.inject.hang import Hang
from aftbed.inject.slow import Slow
from aftbed.inject.value import ValueFlip
from aftbed.runtime.deployment import replica_of
from aftbed.runtime.sim.world import Setup, simulate
from aftbed.search import swarm
from aftbed.search.explore import attempt
from aftbed.search.swarm import drawn, experiments

DRAWN = 3_000
RUN = range(40)


@lru_cache(maxsize=1)
def many() -> tuple[Setup, ...]:
    return tuple(experiments(range(DRAWN)))


def test_the_seed_is_all_there_is() -> None:
    assert drawn(7) == drawn(7)
    assert json.decode(json.encode(drawn(7)), type=Setup) == drawn(7)
    assert [setup.seed for setup in many()] == list(range(DRAWN))
    assert len({json.encode(setup) for setup in many()}) == DRAWN


def test_of_everything_there_is_some() -> None:
    assert {s.ftm for s in many()} == {*swarm.DUPLEX, "tr", "none"}
    assert {s.placement for s in many()} == {"process", "replica", "single"}
    assert Counter(len(s.faults) for s in many()).keys() == {0, 1, 2, 3}
    assert Counter(len(s.adaptations) for s in many()).keys() == {0, 1, 2}
    faults = [fault for s in many() for fault in s.faults]
    assert {type(fault.action) for fault in faults} == {Crash, Hang, ValueFlip, Slow, ChannelFault}
    assert {bool(fault.action.for_ms) for fault in faults if isinstance(fault.action, Hang)} == {True, False}
    assert any(fault.target.endswith(STAGED) for fault in faults)
    assert any(fault.trigger.after_ms for fault in faults)
    assert {Event.CHECKPOINT_SENT.label, Event.ADAPT_STEP_ACT.label} <= {f.trigger.event for f in faults}


def test_the_load_is_as_asked_for() -> None:
    assert mean(s.count for s in many()) == pytest.approx(200, rel=0.05)
    rates = [s.rate_hz for s in many() if s.rate_hz]
    assert 200 <= min(rates) < 300 and 3000 < max(rates) <= 4000
    assert 0.3 < sum(not s.rate_hz for s in many()) / DRAWN < 0.5
    assert 0 < sum(bool(s.scenario) for s in many()) / DRAWN <= 0.02


def test_what_is_aimed_at_is_there() -> None:
    graph = lru_cache(maxsize=None)(build)
    for setup in many():
        for fault in setup.faults:
            fault.check(graph(setup.ftm, setup.placement))


def test_no_mechanism_is_asked_for_what_it_does_not_promise() -> None:
    for setup in many():
        duplex = bool(replication_of(setup.ftm))
        assert duplex or not setup.scenario
        assert not (duplex and setup.placement == "single")
        assert setup.ftm != "none" or not setup.faults
        for fault in setup.faults:
            for_good = isinstance(fault.action, Hang) and not fault.action.for_ms
            watched = fault.target in targets.ROLES or replica_of(fault.target)
            assert watched or not for_good, setup
            assert not fault.target.endswith(STAGED) or isinstance(fault.action, Crash)


def test_a_bit_is_flipped_only_where_tr_will_see_it() -> None:
    flipped = 0
    for setup in many():
        flips = [fault for fault in setup.faults if isinstance(fault.action, ValueFlip)]
        if not flips:
            continue
        flipped += 1
        ways = [setup.ftm, *(a.goal.expression for a in setup.adaptations)]
        assert all("tr" in parse(ftm) for ftm in ways), setup
        assert {fault.event for fault in flips} == {Event.SERVER_EXIT.label}
        assert len({fault.target for fault in flips}) == 1
        assert all(b.trigger.nth - a.trigger.nth >= swarm.FLIPS_APART for a, b in pairwise(flips))
    assert flipped > DRAWN / 20


def test_what_is_planned_comes_before_the_end_of_the_load() -> None:
    for setup in many():
        if setup.scenario:
            continue
        assert all(1 <= a.at_request <= setup.count for a in setup.adaptations)
        last_ms = (setup.count - 1) * (1e3 / setup.rate_hz if setup.rate_hz else swarm.REQUEST_MS_MIN)
        assert all(f.trigger.after_ms <= swarm.LAUNCH_MS + last_ms for f in setup.faults)
        timed = [f for f in setup.faults if not f.trigger.event and not isinstance(f.action, ChannelFault)]
        assert all(f.trigger.after_ms >= swarm.LAUNCH_MS for f in timed)


def test_a_request_takes_no_less_than_the_draw_believes() -> None:
    run = simulate(Setup("none", "single", count=200))
    sent = [entry.t_ns for entry in run.history.dialogue]
    assert max(sent) - min(sent) > 199 * swarm.REQUEST_MS_MIN * 1e6


def test_a_swarm_breaks_nothing() -> None:
    broken = {seed: found for seed in RUN if (found := attempt(drawn(seed))[1])}
    assert not broken, f"repeat with: aftbed sim --swarm --seed {next(iter(broken))}: {broken}"

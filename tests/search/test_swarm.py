"""A swarm's experiment is made of its seed alone, breaks nothing, and what it draws to happen happens."""

from collections import Counter
from functools import lru_cache
from itertools import pairwise
from statistics import mean

import pytest
from msgspec import json
from msgspec.structs import replace

from aftbed.core.events import Event
from aftbed.core.graph import STAGED
from aftbed.core.messages import Goal, Scheduled
from aftbed.ftm.compose import build, parse, replication_of
from aftbed.inject import targets
from aftbed.inject.channel import ChannelFault
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Trigger
from aftbed.inject.hang import Hang
from aftbed.inject.model import Fault, FaultReport
from aftbed.inject.receipts import ReceiptState
from aftbed.inject.slow import Slow
from aftbed.inject.value import ValueFlip
from aftbed.runtime.deployment import replica_of
from aftbed.runtime.sim.trace import Sent, traced
from aftbed.runtime.sim.world import Setup, simulate
from aftbed.search import swarm
from aftbed.search.explore import STEPS, steps_of
from aftbed.search.swarm import attempt_drawn, contradictions, drawn, experiments, intended
from aftbed.search.tally import ACTIVATED_MIN, DONE_MIN, AdaptationEnd, Intent, Tally, happened_in

pytestmark = pytest.mark.simulation

DRAWN = 1_000
RUN = range(100)
STEP_LABELS = {event.label for event in STEPS}


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
    rare = {event.label for event in (*swarm.FAILOVER, swarm.RESENT, *swarm.UNCAUSED)}
    events = {f.trigger.event for f in faults}
    assert {Event.CHECKPOINT_SENT.label, Event.ADAPT_STEP_ACT.label, *rare} <= events
    assert swarm.ALARM in {f.action.channel for f in faults if isinstance(f.action, ChannelFault)}


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
        meant = intended(setup)
        asked = zip(setup.adaptations, meant.adaptations, strict=True)
        for adaptation in (a for a, intent in asked if intent is not Intent.NEVER):
            assert 1 <= adaptation.at_request <= setup.count
        last_ms = (setup.count - 1) * (1e3 / setup.rate_hz if setup.rate_hz else swarm.REQUEST_MS_MIN)
        faults = [f for f, i in zip(setup.faults, meant.faults, strict=True) if i is Intent.HAPPEN]
        assert all(f.trigger.after_ms <= swarm.LAUNCH_MS + last_ms for f in faults)
        timed = [f for f in faults if not f.trigger.event and not isinstance(f.action, ChannelFault)]
        assert all(f.trigger.after_ms >= swarm.LAUNCH_MS for f in timed)
        flips = [f for f in faults if isinstance(f.action, ValueFlip)]
        counted = [f for f in faults if f not in flips and f.trigger.event not in STEP_LABELS]
        assert all(f.trigger.nth <= setup.count * swarm.NTH_PART + 1 for f in counted)
        assert all(f.trigger.nth <= swarm.EXECUTIONS * setup.count * swarm.NTH_PART + 1 for f in flips)


def test_adaptations_lead_elsewhere_and_do_not_overlap() -> None:
    pairs_of_adaptations = 0
    for setup in many():
        asked = zip(setup.adaptations, intended(setup).adaptations, strict=True)
        possible = [a for a, intent in asked if intent is not Intent.NEVER]
        ways = [setup.ftm, *(a.goal.expression for a in possible)]
        assert len(set(ways)) == len(ways), setup
        period_ms = swarm.CAR_MS / swarm.CAR_REQUESTS if setup.scenario else 1e3 / (setup.rate_hz or 1e6)
        for one, other in pairwise(possible):
            pairs_of_adaptations += 1
            assert (other.at_request - one.at_request) * period_ms >= swarm.ADAPTATION_MS, setup
        steps = sum(steps_of(old, new, setup.placement).total for old, new in pairwise(ways))
        at_steps = [f for f in setup.faults if f.trigger.event in STEP_LABELS]
        assert all(f.trigger.nth <= steps for f in at_steps), setup
    assert pairs_of_adaptations > DRAWN / 30


def test_what_cannot_happen_is_drawn_rarely() -> None:
    meant = [intended(setup) for setup in many()]
    faults = Counter(intent for one in meant for intent in one.faults)
    adaptations = Counter(intent for one in meant for intent in one.adaptations)
    assert faults[Intent.NEVER] / faults.total() == pytest.approx(swarm.NEVER_PART, abs=0.02)
    assert adaptations[Intent.NEVER] / adaptations.total() == pytest.approx(swarm.NEVER_PART, abs=0.02)
    assert adaptations[Intent.STRUCK] > DRAWN / 30
    never = [
        f
        for s, m in zip(many(), meant, strict=True)
        for f, i in zip(s.faults, m.faults, strict=True)
        if i is Intent.NEVER
    ]
    assert any(f.trigger.nth == swarm.NEVER_NTH for f in never)
    assert any(f.trigger.after_ms == swarm.NEVER_MS for f in never)
    assert any(f.trigger.event == Event.FOLLOWER_DIVERGED.label for f in never)


@pytest.mark.parametrize("ftm", [e for e in (*swarm.DUPLEX, *swarm.SIMPLEX) if e != "none"])
def test_each_channel_that_is_disturbed_has_a_message_at_each_request(ftm: str) -> None:
    trace = traced(Setup(ftm, "process", count=10))
    sent = Counter(one.port for one in trace.happened if isinstance(one, Sent))
    assert {name: sent[name] for name in swarm._channels(ftm, "process") if sent[name] < 10} == {}


def test_a_request_takes_no_less_than_the_draw_believes() -> None:
    run = simulate(Setup("none", "single", count=200))
    sent = [entry.t_ns for entry in run.history.dialogue]
    assert max(sent) - min(sent) > 199 * swarm.REQUEST_MS_MIN * 1e6


def test_a_swarm_breaks_nothing_and_what_it_draws_happens() -> None:
    tally = Tally()
    for seed in RUN:
        run, broken = attempt_drawn(drawn(seed))
        assert run is not None and not broken, f"repeat with: aftbed sim --swarm --seed {seed}: {broken}"
        tally.add(happened_in(run), intended(run.setup))
    faults, adaptations = tally.document()["faults"], tally.document()["adaptations"]
    assert faults["happen"]["activated"] >= ACTIVATED_MIN * faults["happen"]["total"]
    assert adaptations["happen"]["done"] >= DONE_MIN * adaptations["happen"]["total"]


CRASH = Fault(Crash(), "primary", Trigger("server.exit", 5))


@pytest.mark.parametrize(
    "trigger", [Trigger("server.exit", swarm.NEVER_NTH), Trigger(after_ms=swarm.NEVER_MS)]
)
def test_a_fault_that_cannot_strike_and_is_reported_to_have_struck_is_a_breach(trigger: Trigger) -> None:
    run = simulate(Setup(count=20, faults=(replace(CRASH, trigger=trigger),)))
    assert contradictions(run) == ()
    wrong = replace(run, faults=(FaultReport(run.faults[0].fault, ReceiptState.ACTIVATED),))
    (breach,) = contradictions(wrong)
    assert "cannot strike, and is reported as activated" in breach.reason


@pytest.mark.parametrize(
    ("asked", "ends"),
    [
        ((("pbr", 3, 0.0), ("lfr", 5, 0.0)), (AdaptationEnd.REFUSED, AdaptationEnd.DONE)),  # it runs already
        ((("lfr", 5, 0.0), ("tr", 5, 0.0)), (AdaptationEnd.DONE, AdaptationEnd.REFUSED)),  # under way
        ((("lfr", 5, 0.0), ("tr", 0, swarm.NEVER_MS)), (AdaptationEnd.DONE, AdaptationEnd.NOT_BEGUN)),
    ],
)
def test_an_adaptation_that_cannot_be_carried_out_is_told_so(
    asked: tuple[tuple[str, int, float], ...], ends: tuple[AdaptationEnd, ...]
) -> None:
    ways = tuple(Scheduled(Goal(expression=way), request, after_ms) for way, request, after_ms in asked)
    run = simulate(Setup(count=20, adaptations=ways))
    assert happened_in(run).adaptations == ends
    intents = [Intent.HAPPEN if end is AdaptationEnd.DONE else Intent.NEVER for end in ends]
    assert list(intended(run.setup).adaptations) == intents and contradictions(run) == ()
    done = next(outcome for outcome in run.scheduled if outcome is not None and outcome.outcome == "done")
    (breach,) = contradictions(replace(run, scheduled=(done, done)))
    assert "cannot be carried out, and is reported as done" in breach.reason


def test_an_adaptation_at_whose_step_a_fault_is_aimed_counts_apart() -> None:
    ways = (Scheduled(Goal(expression="lfr"), 5), Scheduled(Goal(expression="tr"), 50))
    steps = steps_of("pbr", "lfr", "process").total
    for nth, intents in (
        (steps, [Intent.STRUCK, Intent.HAPPEN]),
        (steps + 1, [Intent.HAPPEN, Intent.STRUCK]),
    ):
        fault = replace(CRASH, trigger=Trigger(Event.ADAPT_STEP_ACT.label, nth))
        assert list(intended(Setup(faults=(fault,), adaptations=ways)).adaptations) == intents

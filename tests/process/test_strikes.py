"""A death at every step of every adaptation: before it, while it is under way, after it (promise G5).

One run walks from mechanism to mechanism, and at each adaptation somebody is struck: a node of the old
graph, a process that is staged for the new one, the Engine, Recovery, the Proxy. Whatever comes of it, the
old or the new graph is whole afterwards, redundancy is back, requests are answered, each once; the next
adaptation starts from what is there. Names are those of a run that `a` leads; where `b` leads, they are
exchanged.

The process tier strikes at a sample drawn from a fixed seed, the deep tier everywhere.
"""

import contextlib
import itertools
import random
from collections.abc import Iterable
from typing import Final

import psutil
import pytest
from liveruns import NO_TIME, Home, Outcome, Started, until
from sampling import sampled as combinations
from test_adaptations import (
    PAPER,
    adapt,
    assert_nothing_happened_to_requests,
    ended,
    graph_of,
    serving,
    whole,
)

from aftbed.core.errors import ConfigError, HarnessError
from aftbed.core.events import Event
from aftbed.core.graph import STAGED
from aftbed.core.messages import Goal
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Trigger
from aftbed.inject.model import Fault
from aftbed.runtime.unix import control_client
from aftbed.search.explore import STEPS, Strike, strikes

pytestmark = pytest.mark.process

PAIRS: Final = tuple(itertools.permutations(PAPER, 2))
SEED: Final = 20161118
SAMPLED: Final = 12
STRIKES_MAX: Final = 40  # in one run
FALSE_ALARMS_MAX: Final = 2  # of a walk: runs in which a busy machine had the strike not come
OTHER: Final = {"a": "b", "b": "a"}


def mirrored(node: str, leader: str) -> str:
    """The same node of a run that `leader` leads."""
    replica, _, part = node.partition("/")
    stem = replica.removesuffix(STAGED)
    if leader == "a" or stem not in OTHER:
        return node
    return replica.replace(stem, OTHER[stem]) + (f"/{part}" if part else "")


def strike(run: Started, struck: Strike, placement: str) -> tuple[str, bool]:
    """One adaptation with one death; the mechanism that runs after it, and whether there was time for it.

    Without, it is not asked again: the fault has counted the steps of the first time.
    """
    leader = str(run.status()["leader"])
    fault = Fault(Crash(), mirrored(struck.node, leader), Trigger(struck.when.label, struck.step))
    control_client.ask(run.private, control_client.InjectCommand(fault))
    outcome, reason = how_it_ended(run, Goal(expression=struck.new, may_fail=True))
    came_to = struck.new if outcome == "done" else struck.old
    until(run.redundant, f"redundancy after {struck}")
    assert graph_of(run) == whole(came_to, placement, str(run.status()["leader"])), struck
    run.wait_for_answers(run.answered() + 1)
    run.heard()  # what is not read is dropped in the end
    return came_to, NO_TIME not in reason


def how_it_ended(run: Started, goal: Goal) -> tuple[str, str]:
    """`done`, `rolled back`, or `refused` where the Engine died before it had planned; and why."""
    try:
        found = adapt(run, goal, tries=1)
    except ConfigError as refusal:
        print(refusal)  # pytest shows it where a test fails
        return "refused", str(refusal)
    return str(found["outcome"]), str(found["reason"])


def never_struck(outcome: Outcome, *, had_time: bool) -> bool:
    """Whether the last adaptation had no time, or a replica was taken for hung, and a fault that never fired
    is all that is wrong.
    """
    reasons = outcome.verdict.reasons
    busy = not had_time or any("hang" in text for text in outcome.told("alarm"))
    return busy and bool(reasons) and all(one.startswith("faults_applied: never fired") for one in reasons)


def walk(home: Home, placement: str, todo: Iterable[Strike]) -> int:
    """Strike at each of `todo`, in runs of at most STRIKES_MAX; how many it survived. Prints the breaches.

    Nothing here hangs. Where an adaptation was refused for a replica that was taken for hung before the
    strike, or ended before it for want of time, and nothing else is wrong, it is tried again in another run,
    FALSE_ALARMS_MAX times in all.
    """
    left: dict[str, list[Strike]] = {}
    false_alarms = 0
    for struck in todo:
        left.setdefault(struck.old, []).append(struck)
    survived = 0
    while any(left.values()):
        at = next(old for old, waiting in left.items() if waiting)
        done: list[Strike] = []
        with serving(home, at, placement) as run:
            try:
                had_time = True
                while had_time and len(done) < STRIKES_MAX and left.get(at):
                    done.append(left[at].pop())
                    at, had_time = strike(run, done[-1], placement)
                outcome = ended(run)
                if false_alarms < FALSE_ALARMS_MAX and never_struck(outcome, had_time=had_time):
                    false_alarms += 1
                    for struck in done:
                        left.setdefault(struck.old, []).append(struck)
                    continue
                assert_nothing_happened_to_requests(outcome)
                receipts = [f.receipt.value for f in outcome.verdict.faults]
                assert receipts == ["activated"] * len(done), list(zip(receipts, done, strict=True))
            except (AssertionError, HarnessError, pytest.fail.Exception) as error:
                print(f"BROKEN at {done[-1]}, the last of {len(done)}: {error}")
                print("".join(f"    {e['t_ms']} {e['event']} {e['text']}\n" for e in run.heard()[-40:]))
                with contextlib.suppress(psutil.Error):  # the run has ended
                    print(run.states())
                survived -= 1
        survived += len(done)
    return survived


def sampled(placement: str, count: int) -> list[Strike]:
    """Some of all, the same every time."""
    return random.Random(SEED).sample([s for pair in PAIRS for s in strikes(*pair, placement)], count)


@pytest.mark.parametrize("placement", ["process", pytest.param("replica", marks=pytest.mark.deep)])
def test_a_death_at_a_step_leaves_one_graph_whole(home: Home, placement: str) -> None:
    assert walk(home, placement, sampled(placement, SAMPLED)) == SAMPLED


@pytest.mark.parametrize(("node", "when"), combinations(("a", "b", "b'"), STEPS))
def test_a_death_while_requests_are_let_on(home: Home, node: str, when: Event) -> None:
    last = max(s.step for s in strikes("pbr", "lfr", "replica"))
    assert walk(home, "replica", [Strike("pbr", "lfr", node, when, last)]) == 1


def test_an_engine_that_dies_takes_a_spare_that_the_adaptation_waits_for(home: Home) -> None:
    fault = Fault(Crash(), "engine", Trigger(Event.ADAPT_STEP_EXIT.label, 1))
    with serving(home, "pbr", "process", fault) as run:
        assert adapt(run, Goal(expression="pbr+tr"))["outcome"] == "done"
        assert_nothing_happened_to_requests(ended(run))


@pytest.mark.deep
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("placement", ["process", "replica"])
@pytest.mark.parametrize(("old", "new"), PAIRS)
def test_a_death_at_every_step(home: Home, placement: str, old: str, new: str) -> None:
    todo = list(strikes(old, new, placement))
    assert walk(home, placement, todo) == len(todo)

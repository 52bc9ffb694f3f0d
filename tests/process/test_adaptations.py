"""Adaptations under load, on real processes: every way from mechanism to mechanism.

One run walks a closed trail through the graph whose nodes are mechanisms, so that each way is gone once. The
process tier walks among the four mechanisms of the paper, the deep tier among all. Deaths on the way:
see `test_strikes`.
"""

import itertools
from pathlib import Path
from typing import Final

import pytest
from liveruns import ADAPT_TRIES, ENDLESS, NO_TIME, Home, Outcome, Started, under_load, until

from aftbed.core.errors import ConfigError
from aftbed.core.journal import EntryKind
from aftbed.core.messages import Goal
from aftbed.ftm.compose import EXPRESSIONS, NONE, build
from aftbed.inject.model import Fault
from aftbed.runtime.unix import control_client

pytestmark = pytest.mark.process

PAPER: Final = ("pbr", "lfr", "pbr+tr", "lfr+tr")
ALL: Final = tuple(e for e in EXPRESSIONS if e != NONE)
PLACEMENTS: Final = ("process", "replica", "single")
RATE_HZ: Final = 200.0


def trail(mechanisms: tuple[str, ...]) -> list[str]:
    """A closed trail over every ordered pair (Hierholzer; the complete digraph is Eulerian)."""
    ways = {m: [n for n in mechanisms if n != m] for m in mechanisms}
    stack, found = [mechanisms[0]], []
    while stack:
        if ways[stack[-1]]:
            stack.append(ways[stack[-1]].pop())
        else:
            found.append(stack.pop())
    assert len(found) == len(mechanisms) * (len(mechanisms) - 1) + 1
    return found[::-1]


def adapt(run: Started, goal: Goal, tries: int = ADAPT_TRIES) -> dict[str, object]:
    """The answer of the run; asked again where a busy machine gave the adaptation no time."""
    for tries_left in reversed(range(tries)):
        try:
            found = control_client.ask(
                run.private, control_client.AdaptCommand(goal), control_client.ADAPT_SECONDS_MAX
            )
        except ConfigError as refusal:
            if NO_TIME not in str(refusal) or not tries_left:
                raise
            found = {"reason": str(refusal)}
        if NO_TIME not in str(found["reason"]):
            break
        until(lambda: not run.status()["busy"], "the end of what followed")
    return found


def serving(home: Home, ftm: str, placement: str, *faults: Fault) -> Started:
    """A run under load that has begun to answer, and goes on until it is stopped."""
    return under_load(home, ENDLESS, RATE_HZ, ftm=ftm, placement=placement, faults=faults)


def ended(run: Started) -> Outcome:
    """The run, stopped after some more requests have been answered."""
    run.wait_for_answers(run.answered() + 20)
    return run.stop()


def assert_nothing_happened_to_requests(outcome: Outcome) -> None:
    """G1 to G6."""
    verdict = outcome.verdict
    assert verdict.verdict == "pass", verdict.reasons
    requests = verdict.requests
    assert requests.sent == requests.answered
    assert (requests.lost, requests.duplicated, requests.wrong) == (0, 0, 0)
    answered = [e.request_id for e in outcome.record.history.dialogue if e.kind is EntryKind.ANSWERED]
    assert all(a < b for a, b in itertools.pairwise(answered)), "out of order"


def graph_of(run: Started) -> set[tuple[str, str]]:
    """The bricks that run, with their kinds."""
    bricks = control_client.ask(run.private, control_client.GraphQuery())["bricks"]
    assert isinstance(bricks, list)
    return {(str(b["name"]), str(b["kind"])) for b in bricks}


def whole(ftm: str, placement: str, leader: str = "a") -> set[tuple[str, str]]:
    """The bricks of a whole graph."""
    return {(b.name, b.kind) for b in build(ftm, placement, leader).bricks}


@pytest.mark.parametrize(
    "placement",
    [pytest.param(one, marks=[pytest.mark.deep] if one == "single" else []) for one in PLACEMENTS],
)
@pytest.mark.parametrize(
    "mechanisms",
    [
        pytest.param(PAPER, id="paper"),
        pytest.param(ALL, id="all", marks=[pytest.mark.deep, pytest.mark.timeout(300)]),
    ],
)
def test_every_way_from_mechanism_to_mechanism(
    home: Home, placement: str, mechanisms: tuple[str, ...]
) -> None:
    way = trail(mechanisms)
    with serving(home, way[0], placement) as run:
        for expression in way[1:]:
            found = adapt(run, Goal(expression=expression))
            assert (found["outcome"], found["reason"]) == ("done", ""), expression
            assert graph_of(run) == whole(expression, placement)
        outcome = ended(run)
    assert_nothing_happened_to_requests(outcome)


# -- bricks designed off line ---------------------------------------------------------------------

TEMPLATE: Final = """
from aftbed.ftm.registry import KINDS
from aftbed.ftm.chain import Compute

class Mine:
    KIND = KINDS[{kind!r}]
    def __init__(self, setting):
        self.inner, self.steps = Compute(), 0
    def open_ports(self): return self.inner.open_ports()
    def quiescent(self): return self.inner.quiescent()
    def deadline_ns(self): return None
    def capture(self): return b""
    def restore(self, state): pass
    def step(self, port, message, now_ns):
        self.steps += 1
        assert self.steps < {steps}, "a bug of mine"
        return self.inner.step(port, message, now_ns)
"""
SELF_TEST_STEPS: Final = 40  # of a Proceed: two for each of 16 recorded requests, and word of its channels


def written(folder: Path, kind: str = "compute.proceed", steps: int = 1 << 30, text: str = TEMPLATE) -> str:
    """A brick in a file of its own, as `adapt update` is told of it."""
    path = folder / "mine.py"
    path.write_text(text.format(kind=kind, steps=steps))
    return f"{path}:Mine"


@pytest.mark.parametrize("placement", ["process", "replica"])
def test_a_brick_designed_off_line_is_put_in_place(home: Home, tmp_path: Path, placement: str) -> None:
    with serving(home, "pbr", placement) as run:
        found = adapt(run, Goal(part="proceed", source=written(tmp_path)))
        assert found["outcome"] == "done"
        outcome = ended(run)
    assert_nothing_happened_to_requests(outcome)


@pytest.mark.parametrize(
    ("kind", "steps", "text", "words"),
    [
        (
            "pbr.after",
            1 << 30,
            TEMPLATE,
            "its inputs are aft2aft, prd2aft, srv2aft, wanted are bfr2prd, srv2prd",
        ),
        ("compute.proceed", 3, TEMPLATE, "self-test: "),
        ("compute.proceed", 1 << 30, "import nowhere_to_be_found", "cannot be imported: ModuleNotFoundError"),
        ("compute.proceed", 1 << 30, "Other = 1", "has no class Mine"),
    ],
)
def test_a_faulty_brick_is_refused_and_the_service_never_notices(
    home: Home, tmp_path: Path, kind: str, steps: int, text: str, words: str
) -> None:
    with serving(home, "pbr", "process") as run:
        with pytest.raises(ConfigError, match=words):
            adapt(run, Goal(part="proceed", source=written(tmp_path, kind, steps, text), may_fail=True))
        assert graph_of(run) == whole("pbr", "process")
        outcome = ended(run)
    assert_nothing_happened_to_requests(outcome)
    assert not outcome.verdict.failovers


@pytest.mark.parametrize("placement", ["process", "replica"])
def test_a_brick_that_crashes_while_it_is_observed_is_rolled_back(
    home: Home, tmp_path: Path, placement: str
) -> None:
    with serving(home, "pbr", placement) as run:
        source = written(tmp_path, steps=SELF_TEST_STEPS)
        found = adapt(run, Goal(part="proceed", source=source, may_fail=True))
        assert found["outcome"] == "rolled back"
        until(run.redundant, "redundancy")
        outcome = ended(run)
    assert_nothing_happened_to_requests(outcome)
    assert len(outcome.verdict.failovers) == 1


def test_a_second_adaptation_meanwhile_is_refused(home: Home) -> None:
    with serving(home, "pbr", "process") as run:
        line = control_client.send(run.private, control_client.AdaptCommand(Goal(expression="lfr")))
        until(lambda: run.status()["adapting"], "an adaptation under way")
        with pytest.raises(ConfigError, match=r"adaptation 1 .* is under way"):
            adapt(run, Goal(expression="pbr+tr"))
        assert control_client.receive(line)["outcome"] == "done"
        outcome = ended(run)
    assert_nothing_happened_to_requests(outcome)

"""What is told while the client waits has been worked out before, and is not used if it no longer holds."""

from collections.abc import Sequence
from typing import Final

import pytest
from planting import adapted, crash_after

from aftbed.core.messages import Goal, Scheduled
from aftbed.core.script import Drain, Exchange, Resume, Step, Suspend, Together
from aftbed.ftm.compose import build
from aftbed.judge.simulated import breaches
from aftbed.runtime.script_executor import Changes, Rebinding, to_be_told
from aftbed.runtime.sim.world import Setup, simulate

pytestmark = pytest.mark.simulation

WAYS: Final = [
    (old, new, placement)
    for old, new in [("pbr", "lfr"), ("lfr", "pbr"), ("pbr", "pbr+tr"), ("lfr+tr", "lfr"), ("pbr", "tr")]
    for placement in ("process", "replica")
]


@pytest.fixture
def worked_out(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, bool]]:
    """When it was asked for (`ahead`, `prepare`, `commit`), and whether the answer was there already."""
    found: list[tuple[str, bool]] = []
    changes, prepare = Rebinding.changes, Rebinding.prepare
    ahead = False

    def watched_changes(self: Rebinding, steps: Sequence[Step], *, committing: bool) -> Changes:
        known = self._prepared
        answer = changes(self, steps, committing=committing)
        when = "ahead" if ahead else "commit" if committing else "prepare"
        found.append((when, known is not None and answer is known[2]))
        return answer

    def watched_prepare(self: Rebinding, steps: Sequence[Step]) -> None:
        nonlocal ahead
        ahead = True
        prepare(self, steps)
        ahead = False

    monkeypatch.setattr(Rebinding, "changes", watched_changes)
    monkeypatch.setattr(Rebinding, "prepare", watched_prepare)
    return found


@pytest.mark.parametrize(("old", "new", "placement"), WAYS)
def test_nothing_is_worked_out_while_the_client_waits(
    old: str, new: str, placement: str, worked_out: list[tuple[str, bool]]
) -> None:
    run = simulate(adapted(old, new, placement=placement))
    assert [a.outcome for a in run.adaptations] == ["done"] and breaches(run) == ()
    assert worked_out == [("prepare", False), ("ahead", False), ("commit", True)]


def test_after_a_node_was_replaced_it_is_worked_out_again(worked_out: list[tuple[str, bool]]) -> None:
    """The Engine's death gives nothing up, and its successor is another process."""
    for tenth_ms in range(120, 160):  # after the start; what is prepared is ready after 15 ms
        run = simulate(adapted("pbr", "lfr", crash_after("engine", tenth_ms / 10)))
        assert [a.outcome for a in run.adaptations] in (["done"], []) and breaches(run) == (), tenth_ms
    assert ("commit", False) in worked_out and ("commit", True) in worked_out


def test_a_node_that_was_drained_is_not_told_that_it_is_exchanged(monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes no mail, and each order costs a tenth of a millisecond in which no request is served."""
    told: list[str] = []
    changes = Rebinding.changes

    def watched(self: Rebinding, steps: Sequence[Step], *, committing: bool) -> Changes:
        found = changes(self, steps, committing=committing)
        told.extend(change.process.name for change in found.values() if committing and change.suspend)
        return found

    monkeypatch.setattr(Rebinding, "changes", watched)
    run = simulate(adapted("lfr", "pbr"))
    assert [a.outcome for a in run.adaptations] == ["done"] and breaches(run) == ()
    assert set(told) == {"a/before", "a/after"}  # exchanged, as are those of b, which are drained before


def test_a_node_that_serves_again_is_told_that_it_is_exchanged() -> None:
    graph = build("pbr", "process")
    steps: tuple[Step, ...] = (Exchange("b/after"), Exchange("a/after"))
    drained = Drain("b/after")
    assert to_be_told(steps, graph, ()) == to_be_told(steps, graph, [Suspend("a/protocol")]) == steps
    assert to_be_told(steps, graph, [drained]) == steps[1:]
    assert to_be_told(steps, graph, [Together((drained, Resume("b/after")))]) == steps
    assert to_be_told(steps, graph, [drained, Resume("b/after"), drained]) == steps[1:]


@pytest.mark.parametrize("new", ["pbr+tr", "lfr", "lfr+tr"])
def test_by_the_recipe_of_the_paper_nothing_can_be_foreseen(new: str) -> None:
    """It stages in the commit, when the old is dead: what it links does not exist before."""
    scheduled = Scheduled(Goal(expression=new, recipe="paper"), 20)
    run = simulate(Setup("pbr", count=60, rate_hz=200.0, adaptations=(scheduled,)))
    assert [a.outcome for a in run.adaptations] == ["done"]

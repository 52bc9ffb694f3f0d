"""What is told while the client waits has been worked out before, and is not used if it no longer holds."""

from collections.abc import Sequence
from typing import Final

import pytest
from planting import adapted, crash_after

from aftbed.core.messages import Goal, Scheduled
from aftbed.core.script import Step
from aftbed.judge.simulated import breaches
from aftbed.runtime.script_executor import Changes, Rebinding
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


@pytest.mark.parametrize("new", ["pbr+tr", "lfr", "lfr+tr"])
def test_by_the_recipe_of_the_paper_nothing_can_be_foreseen(new: str) -> None:
    """It stages in the commit, when the old is dead: what it links does not exist before."""
    scheduled = Scheduled(Goal(expression=new, recipe="paper"), 20)
    run = simulate(Setup("pbr", count=60, rate_hz=200.0, adaptations=(scheduled,)))
    assert [a.outcome for a in run.adaptations] == ["done"]

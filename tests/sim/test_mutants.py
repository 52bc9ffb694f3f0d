"""The tests of the tests: the simulator's experiments find each seeded bug, by the promise that it breaks.

The right code survives every experiment that was needed to find the bug, so it is the bug that was found. A
mutant that survives is a gap: in the experiments, in a checker, or in what was believed of the mutant.
"""

from functools import lru_cache
from typing import Final

import pytest
from executivemutants import EXECUTIVE
from mutants import MECHANISMS
from planting import EXPLORERS, Mutant, flip, instead

from aftbed.core.events import Event
from aftbed.ftm import lfr
from aftbed.inject.value import ValuePlace
from aftbed.judge.simulated import breaches
from aftbed.judge.verdict import Breach
from aftbed.runtime.sim.world import Setup, simulate

pytestmark = pytest.mark.simulation

MUTANTS: Final = (*MECHANISMS, *EXECUTIVE)
MUTANTS_MIN: Final = 24
RUNS_MAX: Final = 40  # that a bug may take here


@lru_cache(maxsize=1024)
def of_the_right_code(setup: Setup) -> tuple[Breach, ...]:
    return breaches(simulate(setup))


def of_the_wrong_code(mutant: Mutant, setup: Setup) -> tuple[Breach, ...]:
    with mutant.plant():
        return breaches(simulate(setup))


def runs_to_find(mutant: Mutant) -> int:
    """How many experiments it takes; 0 if none of them finds it."""
    for tried, setup in enumerate(mutant.setups(), 1):
        assert of_the_right_code(setup) == (), f"without the bug: {setup}"
        if mutant.promise in {b.promise or b.check for b in of_the_wrong_code(mutant, setup)}:
            return tried
    return 0


@pytest.mark.parametrize(
    "mutant",
    [pytest.param(m, id=m.name, marks=[pytest.mark.deep] if m.deep else []) for m in MUTANTS],
)
def test_a_planted_bug_is_found(mutant: Mutant) -> None:
    runs = runs_to_find(mutant)
    assert runs, f"{mutant.name} survives"
    assert mutant.deep or runs <= RUNS_MAX, f"{mutant.name}: found, but only in run {runs}"


def test_the_table_is_whole() -> None:
    assert len(MUTANTS) >= MUTANTS_MIN
    assert len({m.name for m in MUTANTS}) == len({m.wrong for m in MUTANTS}) == len(MUTANTS)
    assert {m.explorer for m in MUTANTS} == set(EXPLORERS)
    assert {m.promise for m in MUTANTS} == {"G1", "G2", "G3", "G4", "G5", "G6", "at_rest", "needless_stop"}


def test_a_planted_bug_is_taken_out_again() -> None:
    """Also where the run ends in an error."""
    right = lfr.digest
    with pytest.raises(ZeroDivisionError), instead(lfr, "digest", bytes)():
        assert lfr.digest is bytes
        raise ZeroDivisionError
    assert lfr.digest is right


def test_digests_that_are_not_compared_break_no_promise_but_leave_no_word() -> None:
    """A divergence is only reported (which replica is right is unknown): the journal alone shows the bug."""
    setup = Setup("lfr", count=6, faults=(flip(ValuePlace.RESULT, 0, "server.exit", 3, "backup"),))
    with instead(lfr, "digest", lambda payload: b"")():
        wrong = simulate(setup)
    right = simulate(setup)
    assert breaches(right) == breaches(wrong) == ()
    assert [r.request_id for r in right.history.events(Event.FOLLOWER_DIVERGED)] == [3]
    assert not wrong.history.events(Event.FOLLOWER_DIVERGED)

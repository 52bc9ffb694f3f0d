"""Counts over runs, and when a swarm is told to prove too little."""

import pytest

from aftbed.inject.receipts import ReceiptState
from aftbed.search.tally import (
    ACTIVATED_MIN,
    DONE_MIN,
    ENOUGH_RUNS,
    AdaptationEnd,
    Happened,
    Intended,
    Intent,
    Tally,
)

STRUCK = Happened((ReceiptState.ACTIVATED,), (AdaptationEnd.DONE,))
IDLE = Happened((ReceiptState.ARMED,), (AdaptationEnd.NOT_BEGUN,))
HAPPEN = Intended((Intent.HAPPEN,), (Intent.HAPPEN,))
NEVER = Intended((Intent.NEVER,), (Intent.NEVER,))


def tally_of(*runs: tuple[Happened, Intended, int]) -> Tally:
    """Each of `runs` so many times."""
    tally = Tally()
    for happened, intended, times in runs:
        for _ in range(times):
            tally.add(happened, intended)
    return tally


def test_a_swarm_in_which_enough_happened_is_not_vacuous() -> None:
    enough = round(ENOUGH_RUNS * max(ACTIVATED_MIN, DONE_MIN))
    assert tally_of((STRUCK, HAPPEN, enough), (IDLE, HAPPEN, ENOUGH_RUNS - enough)).vacuous() == []


def test_a_swarm_in_which_too_little_happened_is_vacuous() -> None:
    faults = round(ENOUGH_RUNS * ACTIVATED_MIN) - 1
    found = tally_of((STRUCK, HAPPEN, faults), (IDLE, HAPPEN, ENOUGH_RUNS - faults)).vacuous()
    assert found == [
        f"vacuous: {faults} of {ENOUGH_RUNS} faults were activated; these runs prove too little below 90%"
    ]
    done = round(ENOUGH_RUNS * DONE_MIN) - 1
    found = tally_of((STRUCK, HAPPEN, done), (IDLE, HAPPEN, ENOUGH_RUNS - done)).vacuous()
    assert len(found) == 2 and f"{done} of {ENOUGH_RUNS} adaptations were done" in found[1]


def test_a_few_runs_are_never_vacuous() -> None:
    assert tally_of((IDLE, HAPPEN, ENOUGH_RUNS - 1)).vacuous() == []


def test_a_swarm_that_draws_nothing_to_happen_is_vacuous() -> None:
    assert len(tally_of((IDLE, NEVER, ENOUGH_RUNS)).vacuous()) == 2


@pytest.mark.parametrize("apart", [NEVER, Intended((Intent.NEVER,), (Intent.STRUCK,))])
def test_what_was_not_meant_to_happen_counts_apart(apart: Intended) -> None:
    assert tally_of((STRUCK, HAPPEN, 1), (IDLE, apart, ENOUGH_RUNS)).vacuous() == []


def test_the_counts_in_words_and_as_a_document() -> None:
    rolled_back = Happened((), (AdaptationEnd.ROLLED_BACK,))
    struck = Intended((), (Intent.STRUCK,))
    tally = tally_of((STRUCK, HAPPEN, 3), (IDLE, HAPPEN, 1), (IDLE, NEVER, 2), (rolled_back, struck, 1))
    assert list(tally.lines()) == [
        "faults: 4 drawn to happen: 3 activated, 1 armed; 2 drawn not to happen: 2 armed",
        "adaptations: 4 drawn to happen: 3 done, 1 not begun;"
        " 1 drawn with a fault at a step: 1 rolled back; 2 drawn not to happen: 2 not begun",
    ]
    assert tally.document() == {
        "faults": {
            "happen": {"total": 4, "activated": 3, "armed": 1},
            "never": {"total": 2, "armed": 2},
        },
        "adaptations": {
            "happen": {"total": 4, "done": 3, "not_begun": 1},
            "struck": {"total": 1, "rolled_back": 1},
            "never": {"total": 2, "not_begun": 2},
        },
    }


def test_without_a_swarm_everything_was_asked_for() -> None:
    tally = Tally()
    tally.add(STRUCK)
    assert list(tally.lines()) == ["faults: 1 asked for: 1 activated", "adaptations: 1 asked for: 1 done"]
    assert list(Tally().lines()) == []

"""What became of the faults and adaptations of runs: of each of one run, and counts over many.

A run in which nothing struck and nothing was adapted breaks no promise, and proves none. So the runs of a
swarm are counted: what was drawn to happen beside what happened, and apart from it what was drawn on purpose
not to happen. Where too little of it happened, the swarm is *vacuous*.
"""

from collections import Counter
from collections.abc import Iterator
from enum import Enum
from typing import Final, NamedTuple, TypeVar

from aftbed.adapt.engine import DONE, FAILED, REFUSED, ROLLED_BACK
from aftbed.inject.receipts import ReceiptState
from aftbed.runtime.adaptations import Outcome
from aftbed.runtime.sim.world import Run

T = TypeVar("T", bound=Enum)

ENOUGH_RUNS: Final = 1000  # fewer may miss a limit by chance
ACTIVATED_MIN: Final = 0.9  # of the faults drawn to happen
DONE_MIN: Final = 0.8  # of the adaptations drawn to happen


class AdaptationEnd(Enum):
    """What became of a scheduled adaptation."""

    DONE = DONE
    ROLLED_BACK = ROLLED_BACK
    REFUSED = REFUSED
    FAILED = FAILED
    NOT_ENDED = "not ended"
    NOT_BEGUN = "not begun"

    @classmethod
    def of(cls, outcome: Outcome | None) -> "AdaptationEnd":
        if outcome is None:
            return cls.NOT_BEGUN
        return cls(outcome.outcome) if outcome.outcome else cls.NOT_ENDED


class Happened(NamedTuple):
    """What became of each fault and each adaptation of a run, in the order of its setup."""

    faults: tuple[ReceiptState, ...] = ()
    adaptations: tuple[AdaptationEnd, ...] = ()


class Intent(Enum):
    """What was meant when a fault or an adaptation was drawn."""

    ASKED = "asked for"  # by options: nothing was drawn
    HAPPEN = "drawn to happen"
    STRUCK = "drawn with a fault at a step"  # an adaptation: that it is rolled back is as good as done
    NEVER = "drawn not to happen"


class Intended(NamedTuple):
    """What was meant by each fault and each adaptation of a setup."""

    faults: tuple[Intent, ...]
    adaptations: tuple[Intent, ...]


def happened_in(run: Run) -> Happened:
    """By the receipts and the answers of the executive."""
    return Happened(tuple(f.receipt for f in run.faults), tuple(map(AdaptationEnd.of, run.scheduled)))


class Tally:
    """Counts over some runs: what became of faults and adaptations, by what was meant by them."""

    def __init__(self) -> None:
        self.runs = 0
        self.faults: Counter[tuple[Intent, ReceiptState]] = Counter()
        self.adaptations: Counter[tuple[Intent, AdaptationEnd]] = Counter()

    def add(self, happened: Happened, intended: Intended | None = None) -> None:
        """Count a run; without `intended`, all of it was asked for."""
        if intended is None:
            asked = ((Intent.ASKED,) * len(states) for states in happened)
            intended = Intended(*asked)
        self.runs += 1
        self.faults.update(zip(intended.faults, happened.faults, strict=True))
        self.adaptations.update(zip(intended.adaptations, happened.adaptations, strict=True))

    def vacuous(self) -> list[str]:
        """Why the runs prove too little, a line for each reason; never of fewer than ENOUGH_RUNS."""
        if self.runs < ENOUGH_RUNS:
            return []
        faults, adaptations = _of(Intent.HAPPEN, self.faults), _of(Intent.HAPPEN, self.adaptations)
        shares = (
            ("faults were activated", faults[ReceiptState.ACTIVATED], faults.total(), ACTIVATED_MIN),
            ("adaptations were done", adaptations[AdaptationEnd.DONE], adaptations.total(), DONE_MIN),
        )
        return [
            f"vacuous: {some} of {drawn} {what}; these runs prove too little below {least:.0%}"
            for what, some, drawn, least in shares
            if some < least * drawn or not drawn
        ]

    def lines(self) -> Iterator[str]:
        """For people: a line for the faults and one for the adaptations, where there are any."""
        if self.faults:
            yield f"faults: {_words(self.faults)}"
        if self.adaptations:
            yield f"adaptations: {_words(self.adaptations)}"

    def document(self) -> dict[str, dict[str, dict[str, int]]]:
        """For `--json`: by `faults` and `adaptations`, by intent, the total and what there is of each end."""
        return {"faults": _by_intent(self.faults), "adaptations": _by_intent(self.adaptations)}


def _of(intent: Intent, counts: Counter[tuple[Intent, T]]) -> Counter[T]:
    """The ends of those that were meant so, the most frequent first."""
    return Counter({end: count for (meant, end), count in counts.most_common() if meant is intent})


def _words(counts: Counter[tuple[Intent, T]]) -> str:
    groups = ((intent, _of(intent, counts)) for intent in Intent)
    return "; ".join(
        f"{ends.total()} {intent.value}: "
        + ", ".join(f"{n} {end.value.replace('_', ' ')}" for end, n in ends.items())
        for intent, ends in groups
        if ends
    )


def _by_intent(counts: Counter[tuple[Intent, T]]) -> dict[str, dict[str, int]]:
    groups = ((intent, _of(intent, counts)) for intent in Intent)
    return {
        intent.name.lower(): {"total": ends.total()}
        | {end.value.replace(" ", "_"): count for end, count in ends.items()}
        for intent, ends in groups
        if ends
    }

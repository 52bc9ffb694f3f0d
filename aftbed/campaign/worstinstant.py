"""The worst instant: when a fault harms the car most, searched on the simulator.

The paper (Section IV) tells an outage in metres at 50 km/h. What those metres cost depends on when they
are lost: before anything was in sight, nothing; at the cycle that would have begun the braking, all of
them. So the fault is tried at many instants, and the one that harms most is told, with the words that
repeat it.

    coarse  each cycle whose reply asks for another stage, and each `STEP_CYCLES`th from the first with a
            target to standstill, or to the end of the last braking; without either, of the whole drive
    fine    around the worst so far, at ever smaller distances, down to the next cycle
    inside  of that cycle: each event on the request's way; and the time before it, down to 1 ms

They are tried in copies of one drive (`branching`). Of the `CONFIRMED` worst each is then run whole, by its
words, and the worst of these is told: so what is told is what the words repeat.

Harm is, in this order: a broken promise, a faster impact, a smaller gap, more braking. Of two instants that
harm alike the one that was tried first is told, so those at an event: they mean the same in a real run.

Limits. It is a search and no proof: between two coarse instants harm is taken to have one peak. One that is
narrower than `STEP_CYCLES` and at no change of stage is not found. `instants` is how many were tried.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import pairwise
from typing import Final, NamedTuple

import msgspec

from aftbed.campaign.branching import Branch, branched
from aftbed.campaign.course import Course, Struck, strike
from aftbed.core.events import Event
from aftbed.core.fault import Action, Fault, Hang, Slow, Trigger
from aftbed.vehicle.plant import VehicleResult

STEP_CYCLES: Final = 20  # 0.4 s
FINER_CYCLES: Final = (10, 5, 2, 1)
STEP_MS: Final = 5
FINER_MS: Final = (2, 1)
ARM_MS: Final = 1.0  # so long before its cycle a fault is armed: an order takes some 50 us
AFTER_MS: Final = 3000.0  # so long after the last instant and the end of a fault a copy drives on at most
CONFIRMED: Final = 3
ANCHOR: Final = Event.SERVER_ENTER.label  # under every mechanism: the function is about to be called

Harm = tuple[bool, float, float, float]


class Worst(msgspec.Struct, frozen=True):
    """The worst of the `instants` at which the fault was tried, and struck."""

    struck: Struck
    instants: int


class Instant(msgspec.Struct, frozen=True):
    """When: in the words of a whole run; and in a copy of the drive, which is made at `branch_ms`.

    `place` is the index of the cycle, or the millisecond, by which a search goes on from here.
    """

    words: Trigger
    branch_ms: float
    branch: Trigger
    place: int


def worst_instant(course: Course, action: Action, target: str) -> Worst | None:
    """Search; None if the fault struck at none of the instants. Raises HarnessError."""
    return _Search(course, action, target).run()


def harm(result: VehicleResult, broken: tuple[str, ...] = ()) -> Harm:
    """The greater, the worse. Rounded, since what is finer than that is noise of the last digits."""
    impact_kmh = (result.impact_speed_kmh or 0.0) if result.collision else 0.0
    gap_m = result.min_gap_m if result.min_gap_m is not None else float("inf")
    return bool(broken), round(impact_kmh, 4), -round(gap_m, 4), result.demand_max_ms2


class _Tried(NamedTuple):
    harm: Harm
    earlier: int  # the greater, the earlier it was tried


class _Search:
    def __init__(self, course: Course, action: Action, target: str) -> None:
        self._course, self._action, self._target = course, action, target
        self._over_ms = _over_ms(course, action)
        self._tried: dict[Trigger, _Tried | None] = {}  # None where the fault did not strike

    def run(self) -> Worst | None:
        """From coarse to fine."""
        first, last = span(self._course)
        begin = list(self._cycles(coarse(self._course, first, last)))
        at = self._narrow(begin, self._cycles, FINER_CYCLES, range(first, last + 1))
        self._try(list(self._events(at, self._course.nths)))
        t_ms = self._course.cycles[at].t_ms
        before_ms = self._course.cycles[at - 1].t_ms if at else t_ms
        begin = list(self._moments(range(t_ms - 1, before_ms, -STEP_MS)))
        self._narrow(begin, self._moments, FINER_MS, range(before_ms + 1, t_ms))
        return self._confirmed()

    # -- instants -----------------------------------------------------------------------------

    def _cycles(self, indices: Iterable[int]) -> Iterator[Instant]:
        """The beginning of each of these cycles, as the function sees it."""
        for index in indices:
            yield from self._events(index, (ANCHOR,))

    def _events(self, index: int, events: Iterable[str]) -> Iterator[Instant]:
        """These events of that cycle, as far as it has them."""
        cycle = self._course.cycles[index]
        for event in events:
            nth = self._course.nths[event].get(cycle.request_id)
            if nth is not None:
                yield Instant(Trigger(event, nth), cycle.t_ms - ARM_MS, Trigger(event), index)

    def _moments(self, times_ms: Iterable[int]) -> Iterator[Instant]:
        """These times, from the arming on."""
        for t_ms in times_ms:
            after_ms = round(t_ms - self._course.armed_ms, 6)
            if after_ms > 0.0:
                yield Instant(Trigger(after_ms=after_ms), float(t_ms), Trigger(), t_ms)

    # -- trying -------------------------------------------------------------------------------

    def _narrow(
        self,
        found: list[Instant],
        make: Callable[[Iterable[int]], Iterator[Instant]],
        steps: Sequence[int],
        places: range,
    ) -> int:
        """Try `found`, then ever nearer to the worst of them. The place of the worst of all."""
        self._try(found)
        at = self._worst_place(found, places.start)
        for step in steps:
            more = list(make(near for near in (at - step, at + step) if near in places))
            self._try(more)
            found += more
            at = self._worst_place(found, at)
        return at

    def _try(self, instants: Sequence[Instant]) -> None:
        """Those that are new, in the order of time; who is proposed first counts as tried first."""
        fresh = {instant.words: instant for instant in instants if instant.words not in self._tried}
        order = {words: -len(self._tried) - at for at, words in enumerate(fresh)}
        todo = sorted(fresh.values(), key=lambda instant: instant.branch_ms)
        faults = (Fault(self._action, self._target, instant.branch) for instant in todo)
        branches = (Branch(i.branch_ms, fault) for i, fault in zip(todo, faults, strict=True))
        for instant, outcome in zip(todo, branched(self._course, branches, self._over_ms), strict=True):
            found = _Tried(harm(outcome.result), order[instant.words]) if outcome.fired else None
            self._tried[instant.words] = found

    def _worst_place(self, instants: Iterable[Instant], otherwise: int) -> int:
        found = [(tried, i.place) for i in instants if (tried := self._tried[i.words]) is not None]
        return max(found)[1] if found else otherwise

    def _confirmed(self) -> Worst | None:
        """The worst of the worst, run whole."""
        struck = sorted(((t, words) for words, t in self._tried.items() if t is not None), key=_by_harm)
        whole = [self._strike(words) for _, words in struck[-CONFIRMED:]]
        whole = [one for one in reversed(whole) if one.fired]
        if not whole:
            return None
        return Worst(max(whole, key=lambda one: harm(one.result, one.broken)), len(struck))

    def _strike(self, words: Trigger) -> Struck:
        return strike(self._course, Fault(self._action, self._target, words))


def _by_harm(one: tuple[_Tried, Trigger]) -> _Tried:
    return one[0]


def span(course: Course) -> tuple[int, int]:
    """The first and the last cycle of the search, by index."""
    cycles = course.cycles
    first = next((at for at, cycle in enumerate(cycles) if cycle.target), 0)
    still = next((at for at, cycle in enumerate(cycles) if at > first and not cycle.moving), None)
    return first, still or max((at for at in _changes(course) if at > first), default=len(cycles) - 1)


def coarse(course: Course, first: int, last: int) -> list[int]:
    """Where the search begins: the changes of stage first, since it is there that a delay matters."""
    changes = [at for at in _changes(course) if first <= at <= last]
    return list(dict.fromkeys((*changes, *range(first, last + 1, STEP_CYCLES), last)))


def _changes(course: Course) -> list[int]:
    """The cycles that ask for another stage than those before them."""
    return [at for at, (a, b) in enumerate(pairwise(course.cycles), 1) if a.stage != b.stage]


def _over_ms(course: Course, action: Action) -> float:
    """When all is over: after the last instant of the search the fault ends, and what it led to."""
    length_ms = action.for_ms if isinstance(action, Hang | Slow) else 0
    return course.cycles[span(course)[1]].t_ms + length_ms + AFTER_MS

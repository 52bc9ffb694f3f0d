"""All orders in which messages can arrive, but for those that make no difference.

In other runs, time decides what arrives next. Here a choice does: of all lines that carry something
(channels, orders, answers, the news of a death) any one may deliver its oldest message. Two deliveries to
different nodes commute, so of the orders that differ in nothing else only one is run: sleep sets (Godefroid,
*Partial-Order Methods for the Verification of Concurrent Systems*, 1996, ch. 5). What the executive receives
commutes with nothing.

A run is repeated from its start for each order, choice by choice. Deadlines and births come when nothing else
can: orders that only a slow machine brings about are left to the seeds.
"""

from collections import deque
from collections.abc import Callable, Iterator
from random import Random
from typing import Final

from aftbed.core.graph import Link
from aftbed.core.messages import Message
from aftbed.runtime.sim.clock import Call, Carrier, Clock
from aftbed.runtime.sim.node_io import SimChannel

STEP_NS: Final = 1_000  # of virtual time, per delivery
ON_ITS_WAY: Final = 1 << 62

Readers = frozenset[str] | None
Sleep = dict[int, Readers]  # lines whose delivery would make no difference now, with their readers


class HeldChannel(SimChannel):
    """A channel whose messages arrive when the Chooser delivers them."""

    def __init__(self, link: Link, clock: Clock, first_number: int) -> None:
        super().__init__(link, clock, first_number)
        assert isinstance(clock, Chooser)
        self._chooser = clock

    def put(self, message: Message) -> bool:
        if not self._chooser.chooses:
            return super().put(message)
        if not self.has_room():
            return False
        self.mail.append((ON_ITS_WAY, message))
        self._chooser.message(self._chooser.ns, self, self._come)
        return True

    def _come(self) -> None:
        """Deliver the oldest message under way."""
        for index, (t_ns, message) in enumerate(self.mail):
            if t_ns == ON_ITS_WAY:
                self.mail[index] = (self._chooser.ns, message)
                break
        self.arrive()


class ChoicePoint:
    """A moment with several possible deliveries, and those of them that need not be tried."""

    def __init__(self, enabled: dict[int, Readers], sleep: Sleep, chosen: int) -> None:
        self.enabled, self.sleep, self.chosen = enabled, sleep, chosen

    def next_sleep(self) -> Sleep:
        """The deliveries that stay irrelevant behind the choice."""
        readers = self.enabled[self.chosen]
        return {line: other for line, other in self.sleep.items() if _commute(readers, other)}


def _commute(one: Readers, other: Readers) -> bool:
    return one is not None and other is not None and not one & other


class Pruned(Exception):  # noqa: N818 - not an error: an order that is another one's equal
    """Every delivery that is possible now leads to an order that was run already."""


class Chooser(Clock):
    """A clock that replays the choices in `points`, then takes the first possible one each time."""

    def __init__(self, chance: Random, given: list[ChoicePoint]) -> None:
        super().__init__(chance)
        self.points = list(given)
        self._at = 0
        self.chooses = False
        self._lines: dict[int, tuple[Carrier, deque[Call]]] = {}

    def begin(self) -> None:
        self.chooses = True

    def message(self, t_ns: int, line: Carrier, call: Call) -> None:
        """Queue the message for a choice."""
        if not self.chooses:
            super().message(t_ns, line, call)
            return
        self._lines.setdefault(line.number, (line, deque()))[1].append(call)

    def steps(self, count: int) -> bool:
        return all(self.step() for _ in range(count))

    def step(self) -> bool:
        """Handle what is due at this moment, else deliver a message, else advance to the next deadline."""
        if not self.chooses or (self.heap and self.heap[0][0] <= self.ns):
            return super().step()
        enabled = {number: line.reader_names() for number, (line, calls) in self._lines.items() if calls}
        if not enabled:
            return super().step()
        if self._at == len(self.points):
            sleep = self.points[-1].next_sleep() if self.points else {}
            awake = [number for number in enabled if number not in sleep]
            if not awake:
                raise Pruned
            self.points.append(ChoicePoint(enabled, sleep, awake[0]))
        chosen = self.points[self._at].chosen
        self._at += 1
        self.ns += STEP_NS
        self._lines[chosen][1].popleft()()
        return True


def orders(run: Callable[[Callable[[Random], Clock]], object]) -> Iterator[bool]:
    """Run `run` with a clock for every order. True for each order, False for each run that was cut short."""
    given: list[ChoicePoint] = []
    while True:
        made: list[Chooser] = []

        def clock(chance: Random, given: list[ChoicePoint] = given, made: list[Chooser] = made) -> Clock:
            made.append(Chooser(chance, given))
            return made[0]

        try:
            run(clock)
            whole = True
        except Pruned:
            whole = False
        yield whole
        following = _following(made[0].points)
        if following is None:
            return
        given = following


def _following(points: list[ChoicePoint]) -> list[ChoicePoint] | None:
    """The choices that lead to the next order: the last one that has an alternative takes it."""
    for depth in range(len(points) - 1, -1, -1):
        point = points[depth]
        sleep = point.sleep | {point.chosen: point.enabled[point.chosen]}
        awake = [number for number in point.enabled if number not in sleep]
        if awake:
            return [*points[:depth], ChoicePoint(point.enabled, sleep, awake[0])]
    return None

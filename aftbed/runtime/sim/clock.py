"""Virtual time: a heap of what is to happen, and the chance by which delays are drawn.

Nothing here looks at a clock. Between two events no time passes; two events of the same instant happen in
the order in which they were planned. So a run is a function of its seed.
"""

import heapq
from collections.abc import Callable
from random import Random
from typing import Final, Protocol

from aftbed.core.errors import StepFailed
from aftbed.runtime.latencies import HOP_QUANTILES_NS
from aftbed.runtime.tasks import Tasks

START_NS: Final = 1_000_000_000  # so that no time is 0, which means "never" in some places
HOP_BITS: Final = 7
assert len(HOP_QUANTILES_NS) > 1 << HOP_BITS

Call = Callable[[], None]


class Carrier(Protocol):
    """Something on which messages travel, in order."""

    @property
    def number(self) -> int: ...

    def reader_names(self) -> frozenset[str] | None:
        """The nodes at its end; None for the executive, which may act on any node."""
        ...


class Clock:
    """The loop of a run (see `runtime.interface.Loop`)."""

    def __init__(self, chance: Random) -> None:
        self.ns = START_NS
        self.heap: list[tuple[int, int, Call]] = []
        self.count = 0  # events planned so far: breaks ties
        self.chance, self._bits = chance, chance.getrandbits
        self.tasks = Tasks(self.now_ns)
        self._expiry_ns: int | None = None

    def now_ns(self) -> int:
        return self.ns

    def at(self, t_ns: int, call: Call) -> None:
        """Call `call` at `t_ns`."""
        self.count += 1
        heapq.heappush(self.heap, (t_ns, self.count, call))

    def message(self, t_ns: int, line: "Carrier", call: Call) -> None:
        """Call `call` at `t_ns`, or later: the messages of a line keep their order."""
        self.at(t_ns, call)

    def begin(self) -> None:
        """The launch is over: the source may send requests."""

    def after(self, seconds: float, call: Call) -> None:
        """Call `call` in `seconds`. An order to a dead process is dropped, as in the event loop."""

        def guarded() -> None:
            try:
                call()
            except StepFailed:
                return

        self.at(self.ns + round(seconds * 1e9), guarded)

    def rest(self, seconds: float) -> None:
        """Return at once: virtual CPUs are not shared."""

    def hop_ns(self) -> int:
        """A measured delay of one message, the step of its reader included."""
        return HOP_QUANTILES_NS[self._bits(HOP_BITS)]

    def between_ns(self, low_ns: int, high_ns: int) -> int:
        """A delay between both, uniformly distributed."""
        return low_ns + self._bits(30) * (high_ns - low_ns) // (1 << 30)

    def step(self) -> bool:
        """Handle the next event; False if there is none."""
        if not self.heap:
            return False
        self.ns, _, call = heapq.heappop(self.heap)
        call()
        return True

    def steps(self, count: int) -> bool:
        """Handle the next `count` events; False if there are fewer."""
        heap, pop = self.heap, heapq.heappop
        for _ in range(count):
            if not heap:
                return False
            self.ns, _count, call = pop(heap)
            call()
        return True

    def watch_jobs(self) -> None:
        """Plan the deadlines of tasks: anew whenever a task has begun to wait."""
        due = self.tasks.deadline_ns()
        if due is None or (self._expiry_ns is not None and self._expiry_ns <= due):
            return
        self._expiry_ns = due
        self.at(due, self._expire)

    def _expire(self) -> None:
        self._expiry_ns = None
        self.tasks.expire(self.ns)
        self.watch_jobs()

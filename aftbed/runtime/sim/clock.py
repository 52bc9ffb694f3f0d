"""Virtual time: a heap of what is to happen, and the chance by which delays are drawn.

Nothing here looks at a clock. Between two events no time passes; two events of the same instant happen in
the order in which they were planned. So a run is a function of its seed.
"""

import heapq
from collections.abc import Callable
from random import Random
from typing import Final, Protocol

from aftbed.core.errors import StepFailed
from aftbed.runtime.tasks import Tasks

# The delay of one hop between two processes, as measured: the `quantiles_ns` of `aftbed bench hops --json`
# (`aftbed/bench/cycle.py` says what a hop is) for `pbr`, one process per brick, 30 000 samples, on a virtual
# machine of two cores under CPython 3.11, 2026-11-21. Other work ran on that machine meanwhile; of 83 runs
# this is the one with the lowest median.
#
# Limits: the last value is the longest delay of all, and is due to the machine's other work more than to a
# hop. It stands for one sample of 30 000, not for one of 128: to draw evenly between the last two values
# makes the mean 17 us, where it is less than 10 us.
# fmt: off
HOP_QUANTILES_NS: Final[tuple[int, ...]] = (  # 0/128, 1/128, ..., 128/128: eight to a row
    6_359, 7_171, 7_291, 7_421, 7_551, 7_691, 7_771, 7_831,
    7_871, 7_902, 7_932, 7_962, 7_992, 8_012, 8_042, 8_062,
    8_092, 8_112, 8_142, 8_172, 8_202, 8_232, 8_262, 8_292,
    8_313, 8_342, 8_362, 8_383, 8_403, 8_432, 8_452, 8_472,
    8_492, 8_503, 8_523, 8_552, 8_573, 8_593, 8_613, 8_633,
    8_662, 8_683, 8_703, 8_723, 8_743, 8_764, 8_783, 8_803,
    8_823, 8_843, 8_863, 8_883, 8_903, 8_923, 8_943, 8_954,
    8_974, 8_993, 9_013, 9_033, 9_053, 9_073, 9_084, 9_104,
    9_124, 9_153, 9_173, 9_194, 9_214, 9_234, 9_264, 9_284,
    9_314, 9_344, 9_364, 9_394, 9_434, 9_465, 9_505, 9_554,
    9_595, 9_644, 9_684, 9_725, 9_765, 9_804, 9_844, 9_875,
    9_915, 9_945, 9_975, 10_005, 10_035, 10_065, 10_085, 10_115,
    10_145, 10_165, 10_195, 10_225, 10_255, 10_285, 10_325, 10_365,
    10_405, 10_445, 10_486, 10_555, 10_616, 10_696, 10_796, 10_906,
    11_046, 11_206, 11_397, 11_587, 11_927, 12_438, 12_578, 12_699,
    12_919, 13_330, 13_891, 14_141, 14_452, 15_483, 20_600, 40_370,
    1_928_399,
)
# fmt: on


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

"""Whether the machine lets times mean anything: a probe beside each real experiment.

Experiments side by side, or the neighbours of a virtual machine, can take the CPU away for longer than any
mechanism needs to recover. So each worker measures, before and after each experiment, how late it wakes from
sleeps of a millisecond, as a node does that waits for mail, and the supervisor of the run says how long its
most unlucky node was ready to run and had no CPU. If either is far off, the experiment is marked as noisy:
what depends on time in it is inconclusive, what does not (a wrong reply, a lost one) stands.
"""

import time
from typing import Final

SLEEP_SECONDS: Final = 0.001
SLEEPS: Final = 5
FACTOR: Final = 10.0
LATE_MS_MIN: Final = 5.0  # a recovery takes about as long on a bad day: less is no excuse
STARVED_MS_MIN: Final = 20.0  # in a run,
STARVED_PART: Final = 0.05  # and more than so much of it


def lateness_ms() -> float:
    """How much longer than asked for the median sleep took."""
    found = []
    for _ in range(SLEEPS):
        began_s = time.perf_counter()
        time.sleep(SLEEP_SECONDS)
        found.append((time.perf_counter() - began_s - SLEEP_SECONDS) * 1e3)
    return sorted(found)[SLEEPS // 2]


class Probe:
    """Calibrated when it is made."""

    def __init__(self) -> None:
        self.quiet_ms = lateness_ms()

    def noisy(self) -> bool:
        """Whether it is now."""
        return lateness_ms() > max(LATE_MS_MIN, FACTOR * self.quiet_ms)


def starved(starved_ms: float, seconds: float) -> bool:
    """Whether a node had to wait for a CPU for so long that the times of a run of `seconds` mean nothing."""
    return starved_ms > max(STARVED_MS_MIN, STARVED_PART * seconds * 1e3)

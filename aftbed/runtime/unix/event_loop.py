"""The supervisor's loop: one thread, one epoll, timers, tasks. Off the request path."""

import contextlib
import heapq
import itertools
import select
import time
from collections.abc import Callable
from typing import Final

from aftbed.core.errors import StepFailed
from aftbed.runtime.tasks import Tasks

LOOK_AROUND_NS: Final = 1_000_000_000
STALL_NS: Final = 250_000_000  # woken later than this, a process was not merely waiting for its turn


def _call(call: Callable[[], object]) -> None:
    """Call `call`. An order to a process that is gone must not end the run: its death is noticed anyway."""
    with contextlib.suppress(StepFailed):
        call()


class EventLoop:
    """Call what is registered for a descriptor when it is readable, and timers when they are due."""

    def __init__(self) -> None:
        self._epoll = select.epoll()
        self._readers: dict[int, tuple[bool, Callable[[], object]]] = {}
        self._timers: list[tuple[int, int, Callable[[], object]]] = []
        self._order = itertools.count()
        self._ended = False
        self._polled_ns = time.monotonic_ns()
        self.tasks = Tasks(self.now_ns)

    def read(self, fd: int, call: Callable[[], object], *, patient: bool = False) -> None:
        """Call `call` whenever `fd` is readable or has ended; if `patient`, after those that are not."""
        self._readers[fd] = (patient, call)
        self._epoll.register(fd, select.EPOLLIN)

    def forget(self, fd: int) -> None:
        """Undo `read`; call it before the descriptor is closed."""
        if self._readers.pop(fd, None) is not None:
            self._epoll.unregister(fd)

    def after(self, seconds: float, call: Callable[[], object]) -> None:
        due = time.monotonic_ns() + round(seconds * 1e9)
        heapq.heappush(self._timers, (due, next(self._order), call))

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def rest(self, seconds: float) -> None:
        """Yield the CPU for `seconds`."""
        time.sleep(seconds)

    def end(self) -> None:
        self._ended = True

    def run(self) -> None:
        while not self._ended:
            due_ns = self._due_ns()
            polled = self._epoll.poll(max(0.0, (due_ns - time.monotonic_ns()) / 1e9))
            now_ns = time.monotonic_ns()  # before the calls: what arrives while they run is not late yet
            stalled = now_ns - max(due_ns, self._polled_ns) > STALL_NS  # in the wait, or since the last one
            self._polled_ns = now_ns
            if stalled:
                self.tasks.begin_anew()
            ready = [(fd, self._readers[fd]) for fd, _ in polled if fd in self._readers]
            for turn in (False, True):
                for fd, reader in ready:
                    # A call before this one may have closed `fd`, and its number may be another's now.
                    if reader[0] is turn and self._readers.get(fd) is reader:
                        _call(reader[1])
            self.tasks.expire(now_ns)
            while self._timers and self._timers[0][0] <= now_ns:
                _call(heapq.heappop(self._timers)[2])

    def _due_ns(self) -> int:
        """When to look around at the latest."""
        dues = [self._polled_ns + LOOK_AROUND_NS]
        if self._timers:
            dues.append(self._timers[0][0])
        job = self.tasks.deadline_ns()
        if job is not None:
            dues.append(job)
        return min(dues)

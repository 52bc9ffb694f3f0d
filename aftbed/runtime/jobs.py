"""Jobs: what takes several round trips, written as a generator, run by one thread without blocking.

A job yields a `Wait`: keys that must be settled, processes that must not die meanwhile, a deadline.
It is resumed with the values of the keys, or `StepFailed` is thrown into it at that point, so that
what must be undone stands in an `except` beside what was done.
"""

import contextlib
from collections.abc import Callable, Generator
from typing import Final

import msgspec

from aftbed.core.errors import StepFailed

STEP_SECONDS_MAX: Final = 2.0
EARLY_MAX: Final = 256
STATS_JOB: Final = "stats"

Key = tuple[str, str, int]


class Wait(msgspec.Struct, frozen=True):
    """`involved`: names of processes whose death fails the step."""

    keys: frozenset[Key]
    involved: frozenset[str] = frozenset()
    seconds: float = STEP_SECONDS_MAX


Steps = Generator[Wait, dict[Key, bytes], None]


def run_after_first_yield(task: Steps, hook: Steps) -> Steps:
    """Start `task` up to its first wait, run `hook`, then wait and continue."""
    wait = next(task, None)
    yield from hook
    while wait is not None:
        got = yield wait
        try:
            wait = task.send(got)
        except StopIteration:
            return


class _Job:
    def __init__(self, name: str, steps: Steps, on_end: Callable[[str], None]) -> None:
        self.name, self.steps, self.on_end = name, steps, on_end
        self.wait = Wait(frozenset())
        self.got: dict[Key, bytes] = {}
        self.deadline_ns = 0


class Jobs:
    """All jobs under way."""

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self._now_ns = now_ns
        self._jobs: list[_Job] = []
        self._early: dict[Key, bytes] = {}  # settled before anybody waited for it
        self._refused: dict[Key, str] = {}  # failed before anybody waited for it

    def __len__(self) -> int:
        return len(self._jobs)

    def names(self) -> list[str]:
        """What is under way, but for mere questions."""
        return [job.name for job in self._jobs if job.name != STATS_JOB]

    def start(self, name: str, steps: Steps, on_end: Callable[[str], None]) -> None:
        """Run `steps`; `on_end` gets the reason of its failure, or `""`."""
        job = _Job(name, steps, on_end)
        self._jobs.append(job)
        self._advance(job, lambda: next(steps))

    def settle(self, key: Key, value: bytes = b"") -> None:
        """`key` has happened. An answer may come before its job gets to wait for it: it is kept."""
        waited_for = False
        for job in list(self._jobs):
            if job in self._jobs and key in job.wait.keys and key not in job.got:
                waited_for = True
                job.got[key] = value
                if len(job.got) == len(job.wait.keys):
                    got = job.got
                    self._advance(job, lambda j=job, g=got: j.steps.send(g))  # type: ignore[misc]
        if not waited_for and key[0] == "ack":
            self._early[key] = value
            if len(self._early) > EARLY_MAX:
                del self._early[next(iter(self._early))]

    def fail(self, key: Key, reason: str) -> None:
        """`key` will not happen."""
        waiting = [job for job in self._jobs if key in job.wait.keys]
        if not waiting and key[0] == "ack":
            self._refused[key] = reason
            if len(self._refused) > EARLY_MAX:
                del self._refused[next(iter(self._refused))]
        self._throw(waiting, reason)

    def died(self, process: str) -> None:
        """The process called `process` is dead."""
        self._throw([job for job in self._jobs if process in job.wait.involved], f"{process} died")

    def cancel(self, name: str, reason: str) -> None:
        """Fail the job called `name`."""
        self._throw([job for job in self._jobs if job.name == name], reason)

    def expire(self, now_ns: int) -> None:
        """Fail what is past its deadline."""
        late = [job for job in self._jobs if now_ns >= job.deadline_ns]
        for job in late:
            missing = ", ".join(f"{a} {b}" for a, b, _ in job.wait.keys - job.got.keys())
            self._throw([job], f"no answer within {job.wait.seconds} s: {missing}")

    def deadline_ns(self) -> int | None:
        """The earliest deadline."""
        return min((job.deadline_ns for job in self._jobs), default=None)

    def _throw(self, jobs: list[_Job], reason: str) -> None:
        for job in jobs:
            if job in self._jobs:
                self._advance(job, lambda j=job: j.steps.throw(StepFailed(reason)))  # type: ignore[misc]

    def _advance(self, job: _Job, resume: Callable[[], Wait]) -> None:
        try:
            while True:
                job.wait = resume()
                job.got = {key: self._early.pop(key) for key in job.wait.keys & self._early.keys()}
                job.deadline_ns = self._now_ns() + round(job.wait.seconds * 1e9)
                refused = [self._refused.pop(key) for key in job.wait.keys & self._refused.keys()]
                if refused:
                    resume = lambda why=refused[0]: job.steps.throw(StepFailed(why))  # type: ignore[misc]  # noqa: E731
                elif len(job.got) == len(job.wait.keys):
                    resume = lambda got=job.got: job.steps.send(got)  # type: ignore[misc]  # noqa: E731
                else:
                    return
        except StopIteration:
            self._end(job, "")
        except StepFailed as failure:
            self._end(job, str(failure) or "failed")

    def _end(self, job: _Job, reason: str) -> None:
        self._jobs.remove(job)
        with contextlib.suppress(StepFailed):  # an order to a process that is gone: its death is seen anyway
            job.on_end(reason)

"""Tasks of several round trips, each a generator; one thread runs them without blocking.

A task yields a `Wait`: keys that must be settled, processes that must not die meanwhile, a deadline. It is
resumed with the values of the keys, or `StepFailed` is thrown into it at that point.
"""

import contextlib
from collections.abc import Callable, Generator
from typing import Final

import msgspec

from aftbed.core.errors import StepFailed

STEP_SECONDS_MAX: Final = 2.0
EARLY_MAX: Final = 256
ANEW_MAX: Final = 3  # times that one wait begins anew
STATS_TASK: Final = "stats"

Key = tuple[str, str, int]


def death_of(pid: int) -> Key:
    """The death of a process, whose name may change while it is waited for: an adaptation exchanges it."""
    return ("died", f"pid {pid}", pid)


class Wait(msgspec.Struct, frozen=True):
    """`involved`: names of processes whose death fails the step."""

    keys: frozenset[Key]
    involved: frozenset[str] = frozenset()
    seconds: float = STEP_SECONDS_MAX


Task = Generator[Wait, dict[Key, bytes], None]


def run_after_first_yield(task: Task, hook: Task) -> Task:
    """Start `task` up to its first wait, run `hook`, then wait and continue."""
    wait = next(task, None)
    yield from hook
    while wait is not None:
        failure = None
        try:
            got = yield wait
        except StepFailed as error:
            failure = error
        try:
            wait = task.send(got) if failure is None else task.throw(failure)
        except StopIteration:
            return


class _TaskRun:
    def __init__(self, name: str, steps: Task, on_end: Callable[[str], None]) -> None:
        self.name, self.steps, self.on_end = name, steps, on_end
        self.wait = Wait(frozenset())
        self.got: dict[Key, bytes] = {}
        self.deadline_ns = self.anew = 0


class Tasks:
    """All tasks under way."""

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self._now_ns = now_ns
        self._tasks: list[_TaskRun] = []
        self._early: dict[Key, bytes] = {}  # settled before a task waited for it
        self._refused: dict[Key, str] = {}  # failed before a task waited for it

    def __len__(self) -> int:
        return len(self._tasks)

    def names(self) -> list[str]:
        """What is under way, but for mere questions."""
        return [run.name for run in self._tasks if run.name != STATS_TASK]

    def start(self, name: str, steps: Task, on_end: Callable[[str], None]) -> None:
        """Run `steps`; `on_end` gets the reason of its failure, or `""`."""
        run = _TaskRun(name, steps, on_end)
        self._tasks.append(run)
        self._advance(run, None)

    def settle(self, key: Key, value: bytes = b"") -> None:
        """`key` has happened. An answer may come before its task waits for it: it is kept."""
        waited_for = False
        for run in list(self._tasks):
            if run in self._tasks and key in run.wait.keys and key not in run.got:
                waited_for = True
                run.got[key] = value
                if len(run.got) == len(run.wait.keys):
                    self._advance(run, run.got)
        if not waited_for and key[0] == "ack":
            self._early[key] = value
            if len(self._early) > EARLY_MAX:
                del self._early[next(iter(self._early))]

    def fail(self, key: Key, reason: str) -> bool:
        """`key` will not happen. False if no task waits for it now."""
        waiting = [run for run in self._tasks if key in run.wait.keys]
        if not waiting and key[0] == "ack":
            self._refused[key] = reason
            if len(self._refused) > EARLY_MAX:
                del self._refused[next(iter(self._refused))]
        self._throw(waiting, reason)
        return bool(waiting)

    def died(self, process: str) -> None:
        """The process called `process` is dead."""
        self._throw([run for run in self._tasks if process in run.wait.involved], f"{process} died")

    def cancel(self, name: str, reason: str) -> None:
        """Fail the task called `name`."""
        self._throw([run for run in self._tasks if run.name == name], reason)

    def expire(self, now_ns: int) -> None:
        """Fail what is past its deadline."""
        late = [run for run in self._tasks if now_ns >= run.deadline_ns]
        for run in late:
            keys = sorted(run.wait.keys - run.got.keys())
            missing = ", ".join(who if what == "ack" else f"{who} ({what})" for what, who, _ in keys)
            self._throw([run], f"no answer within {run.wait.seconds:g} s from {missing}")

    def begin_anew(self) -> None:
        """The machine stood still, so nothing could answer: each wait has all of its time again."""
        for run in self._tasks:
            if run.anew < ANEW_MAX:
                run.anew += 1
                run.deadline_ns = self._now_ns() + round(run.wait.seconds * 1e9)

    def deadline_ns(self) -> int | None:
        """The earliest deadline."""
        return min((run.deadline_ns for run in self._tasks), default=None)

    def _throw(self, tasks: list[_TaskRun], reason: str) -> None:
        for run in tasks:
            if run in self._tasks:
                self._advance(run, StepFailed(reason))

    def _advance(self, run: _TaskRun, result: dict[Key, bytes] | StepFailed | None) -> None:
        """Resume with the result of the wait; None begins."""
        try:
            while True:
                if isinstance(result, StepFailed):
                    run.wait = run.steps.throw(result)
                else:
                    run.wait = run.steps.send(result)  # type: ignore[arg-type]  # None begins a generator
                run.got = {key: self._early.pop(key) for key in run.wait.keys & self._early.keys()}
                run.deadline_ns, run.anew = self._now_ns() + round(run.wait.seconds * 1e9), 0
                refused = [self._refused.pop(key) for key in run.wait.keys & self._refused.keys()]
                if refused:
                    result = StepFailed(refused[0])
                elif len(run.got) == len(run.wait.keys):
                    result = run.got
                else:
                    return
        except StopIteration:
            self._end(run, "")
        except StepFailed as failure:
            self._end(run, str(failure) or "failed")

    def _end(self, run: _TaskRun, reason: str) -> None:
        self._tasks.remove(run)
        with contextlib.suppress(StepFailed):  # an order to a process that is gone: its death is seen anyway
            run.on_end(reason)

"""Tasks: generators that wait for answers; what fails is thrown into them, and undone where it stands."""

import time
from collections.abc import Generator
from typing import Final

import pytest

from aftbed.core.errors import StepFailed
from aftbed.runtime.tasks import (
    ANEW_MAX,
    EARLY_MAX,
    STEP_SECONDS_MAX,
    Key,
    Task,
    Tasks,
    Wait,
    run_after_first_yield,
)

ONE: Final[Key] = ("ack", "a/after", 1)
TWO: Final[Key] = ("ack", "b/after", 2)
PROMOTED: Final[Key] = ("promoted", "b/protocol", 2)


def wait(*keys: Key, involved: tuple[str, ...] = (), seconds: float = STEP_SECONDS_MAX) -> Wait:
    return Wait(frozenset(keys), frozenset(involved), seconds)


class Run:
    """A job that yields the given waits, and keeps what it got and how it ended."""

    def __init__(self, tasks: Tasks, *waits: Wait, name: str = "job") -> None:
        self.got: list[dict[Key, bytes]] = []
        self.undone: list[str] = []
        self.ends: list[str] = []
        tasks.start(name, self._steps(waits), self.ends.append)

    def _steps(self, waits: tuple[Wait, ...]) -> Task:
        try:
            for one in waits:
                self.got.append((yield one))
        except StepFailed as failure:
            self.undone.append(str(failure))
            raise


@pytest.fixture
def tasks() -> Tasks:
    return Tasks(time.monotonic_ns)


def test_a_task_goes_on_when_all_its_keys_are_settled(tasks: Tasks) -> None:
    run = Run(tasks, wait(ONE, TWO), wait(PROMOTED))
    tasks.settle(TWO, b"two")
    assert run.got == []
    tasks.settle(ONE, b"one")
    assert run.got == [{ONE: b"one", TWO: b"two"}] and run.ends == []
    tasks.settle(PROMOTED)
    assert run.got[1] == {PROMOTED: b""} and run.ends == [""]
    assert len(tasks) == 0


def test_a_task_that_waits_for_nothing_goes_on_at_once(tasks: Tasks) -> None:
    run = Run(tasks, wait(), wait(), wait())
    assert run.got == [{}, {}, {}] and run.ends == [""]


def test_several_jobs_are_under_way_and_each_gets_what_it_waits_for(tasks: Tasks) -> None:
    first, second = Run(tasks, wait(ONE), name="first"), Run(tasks, wait(TWO), name="second")
    assert tasks.names() == ["first", "second"]
    tasks.settle(TWO)
    assert (first.ends, second.ends) == ([], [""]) and tasks.names() == ["first"]


def test_a_key_may_be_waited_for_by_several_tasks(tasks: Tasks) -> None:
    runs = [Run(tasks, wait(PROMOTED)) for _ in range(3)]
    tasks.settle(PROMOTED, b"now")
    assert [run.got for run in runs] == [[{PROMOTED: b"now"}]] * 3


def test_the_first_answer_counts(tasks: Tasks) -> None:
    run = Run(tasks, wait(ONE, TWO))
    tasks.settle(ONE, b"first")
    tasks.settle(ONE, b"second")
    tasks.settle(TWO)
    assert run.got == [{ONE: b"first", TWO: b""}]


def test_an_answer_that_comes_before_its_job_waits_for_it_is_kept(tasks: Tasks) -> None:
    run = Run(tasks, wait(TWO), wait(ONE), wait(PROMOTED))
    tasks.settle(ONE, b"early")
    tasks.settle(TWO)
    assert run.got == [{TWO: b""}, {ONE: b"early"}]
    assert run.ends == []


def test_an_early_answer_is_given_once(tasks: Tasks) -> None:
    tasks.settle(ONE, b"early")
    first, second = Run(tasks, wait(ONE)), Run(tasks, wait(ONE))
    assert (first.ends, second.ends) == ([""], [])


def test_a_refusal_that_comes_before_its_job_waits_for_it_is_kept(tasks: Tasks) -> None:
    run = Run(tasks, wait(TWO), wait(ONE))
    tasks.fail(ONE, "a/after: refused")
    assert run.ends == []
    tasks.settle(TWO)
    assert run.undone == run.ends == ["a/after: refused"]


def test_an_early_refusal_is_thrown_once(tasks: Tasks) -> None:
    tasks.fail(ONE, "a/after: refused")
    first, second = Run(tasks, wait(ONE)), Run(tasks, wait(ONE))
    assert (first.ends, second.ends) == (["a/after: refused"], [])


def test_only_answers_are_kept_and_not_for_ever(tasks: Tasks) -> None:
    tasks.settle(PROMOTED)
    assert Run(tasks, wait(PROMOTED)).ends == [], "an event is no answer: it must happen after one waits"
    tasks.settle(ONE)
    for token in range(EARLY_MAX):
        tasks.settle(("ack", "client", token))
    assert Run(tasks, wait(ONE)).ends == []
    assert Run(tasks, wait(("ack", "client", 0))).ends == [""]


def test_a_refusal_is_thrown_into_the_job_that_waits_for_it(tasks: Tasks) -> None:
    refused, other = Run(tasks, wait(ONE)), Run(tasks, wait(TWO))
    tasks.fail(ONE, "a/after: no such port")
    assert refused.undone == refused.ends == ["a/after: no such port"]
    assert other.ends == [] and len(tasks) == 1


def test_the_death_of_whoever_is_involved_fails_the_step(tasks: Tasks) -> None:
    run = Run(tasks, wait(ONE, involved=("a/after", "a/server")))
    other = Run(tasks, wait(TWO, involved=("b/after",)))
    tasks.died("a/server")
    assert run.undone == run.ends == ["a/server died"] and other.ends == []


def test_what_is_past_its_deadline_fails_and_says_what_is_missing(tasks: Tasks) -> None:
    run, other = Run(tasks, wait(ONE, TWO, seconds=0.25)), Run(tasks, wait(PROMOTED, seconds=60))
    due_ns = tasks.deadline_ns()
    assert due_ns is not None and due_ns <= time.monotonic_ns() + 250_000_000
    tasks.settle(ONE)
    tasks.expire(due_ns - 1)
    assert run.ends == []
    tasks.expire(due_ns)
    assert run.undone == ["no answer within 0.25 s from b/after"] and other.ends == []


def test_a_wait_begins_anew_after_the_machine_stood_still_but_not_for_ever(tasks: Tasks) -> None:
    run = Run(tasks, wait(ONE, seconds=0.25), wait(TWO, seconds=60))
    for _ in range(ANEW_MAX):
        first_ns = tasks.deadline_ns()
        tasks.begin_anew()
        assert (tasks.deadline_ns() or 0) > (first_ns or 0)
    last_ns = tasks.deadline_ns()
    tasks.begin_anew()
    assert tasks.deadline_ns() == last_ns
    tasks.settle(ONE)
    tasks.begin_anew()
    tasks.expire((last_ns or 0) + 1_000_000_000)
    assert run.undone == [], "the next wait has a deadline of its own"


def test_each_step_has_its_own_deadline(tasks: Tasks) -> None:
    Run(tasks, wait(ONE, seconds=1), wait(TWO, seconds=100))
    first_ns = tasks.deadline_ns()
    tasks.settle(ONE)
    second_ns = tasks.deadline_ns()
    assert first_ns is not None and second_ns is not None and second_ns - first_ns > 90e9


def test_without_jobs_there_is_no_deadline(tasks: Tasks) -> None:
    assert tasks.deadline_ns() is None
    tasks.expire(2**63)


def test_what_must_be_undone_may_take_steps_itself(tasks: Tasks) -> None:
    said: list[str] = []

    def steps() -> Task:
        said.append("suspend")
        try:
            yield wait(ONE)
        except StepFailed:
            yield wait(TWO)
            said.append("resumed")
            raise

    ends: list[str] = []
    tasks.start("script", steps(), ends.append)
    tasks.fail(ONE, "refused")
    assert (said, ends, len(tasks)) == (["suspend"], [], 1)
    tasks.settle(TWO)
    assert (said, ends, len(tasks)) == (["suspend", "resumed"], ["refused"], 0)


def test_a_task_that_makes_up_for_a_failure_has_succeeded(tasks: Tasks) -> None:
    def steps() -> Task:
        try:
            yield wait(ONE)
        except StepFailed:
            return

    ends: list[str] = []
    tasks.start("script", steps(), ends.append)
    tasks.died("unknown")
    tasks.fail(ONE, "refused")
    assert ends == [""]


def test_a_step_that_fails_by_itself_ends_its_job(tasks: Tasks) -> None:
    def steps() -> Task:
        yield wait(ONE)
        raise StepFailed("b/after is gone")

    ends: list[str] = []
    tasks.start("script", steps(), ends.append)
    tasks.settle(ONE)
    assert ends == ["b/after is gone"] and len(tasks) == 0


def test_a_task_may_fail_before_its_first_wait(tasks: Tasks) -> None:
    def steps() -> Generator[Wait, dict[Key, bytes], None]:
        raise StepFailed
        yield wait()

    ends: list[str] = []
    tasks.start("script", steps(), ends.append)
    assert ends == ["failed"] and len(tasks) == 0


def test_the_end_of_a_task_may_fail_another_that_waits_for_the_same_key(tasks: Tasks) -> None:
    ends: list[str] = []

    def first_ends(reason: str) -> None:
        ends.append(reason)
        tasks.died("b/after")

    def steps_of(one: Wait) -> Task:
        yield one

    tasks.start("first", steps_of(wait(ONE)), first_ends)
    second = Run(tasks, wait(ONE, involved=("b/after",)))
    tasks.settle(ONE)
    assert ends == [""] and second.ends == ["b/after died"] and len(tasks) == 0


def test_whoever_is_told_of_an_end_may_start_another_job(tasks: Tasks) -> None:
    ends: list[str] = []

    def one_more(reason: str) -> None:
        ends.append(reason)
        tasks.start("next", steps_of(wait(TWO)), ends.append)

    def steps_of(one: Wait) -> Task:
        yield one

    tasks.start("script", steps_of(wait(ONE)), one_more)
    tasks.settle(ONE)
    assert tasks.names() == ["next"]
    tasks.settle(TWO)
    assert ends == ["", ""]


def test_a_failure_reaches_a_task_behind_its_first_wait(tasks: Tasks) -> None:
    """One that handles it goes on, with what it waits for next."""
    told: list[str] = []
    ends: list[str] = []

    def patient() -> Task:
        try:
            yield wait(ONE)
        except StepFailed as failure:
            told.append(str(failure))
        yield wait(TWO)

    def hook() -> Task:
        told.append("hook")
        yield wait()

    tasks.start("job", run_after_first_yield(patient(), hook()), ends.append)
    tasks.fail(ONE, "refused")
    assert told == ["hook", "refused"] and ends == []
    tasks.settle(TWO)
    assert ends == [""]

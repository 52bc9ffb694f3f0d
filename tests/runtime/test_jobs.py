"""Jobs: generators that wait for answers; what fails is thrown into them, and undone where it stands."""

import time
from collections.abc import Generator
from typing import Final

import pytest

from aftbed.core.errors import StepFailed
from aftbed.runtime.jobs import EARLY_MAX, STEP_SECONDS_MAX, Jobs, Key, Steps, Wait

ONE: Final[Key] = ("ack", "a/after", 1)
TWO: Final[Key] = ("ack", "b/after", 2)
PROMOTED: Final[Key] = ("promoted", "b/protocol", 2)


def wait(*keys: Key, involved: tuple[str, ...] = (), seconds: float = STEP_SECONDS_MAX) -> Wait:
    return Wait(frozenset(keys), frozenset(involved), seconds)


class Run:
    """A job that yields the given waits, and keeps what it got and how it ended."""

    def __init__(self, jobs: Jobs, *waits: Wait, name: str = "job") -> None:
        self.got: list[dict[Key, bytes]] = []
        self.undone: list[str] = []
        self.ends: list[str] = []
        jobs.start(name, self._steps(waits), self.ends.append)

    def _steps(self, waits: tuple[Wait, ...]) -> Steps:
        try:
            for one in waits:
                self.got.append((yield one))
        except StepFailed as failure:
            self.undone.append(str(failure))
            raise


@pytest.fixture
def jobs() -> Jobs:
    return Jobs(time.monotonic_ns)


def test_a_job_goes_on_when_all_its_keys_are_settled(jobs: Jobs) -> None:
    run = Run(jobs, wait(ONE, TWO), wait(PROMOTED))
    jobs.settle(TWO, b"two")
    assert run.got == []
    jobs.settle(ONE, b"one")
    assert run.got == [{ONE: b"one", TWO: b"two"}] and run.ends == []
    jobs.settle(PROMOTED)
    assert run.got[1] == {PROMOTED: b""} and run.ends == [""]
    assert len(jobs) == 0


def test_a_job_that_waits_for_nothing_goes_on_at_once(jobs: Jobs) -> None:
    run = Run(jobs, wait(), wait(), wait())
    assert run.got == [{}, {}, {}] and run.ends == [""]


def test_several_jobs_are_under_way_and_each_gets_what_it_waits_for(jobs: Jobs) -> None:
    first, second = Run(jobs, wait(ONE), name="first"), Run(jobs, wait(TWO), name="second")
    assert jobs.names() == ["first", "second"]
    jobs.settle(TWO)
    assert (first.ends, second.ends) == ([], [""]) and jobs.names() == ["first"]


def test_a_key_may_be_waited_for_by_several_jobs(jobs: Jobs) -> None:
    runs = [Run(jobs, wait(PROMOTED)) for _ in range(3)]
    jobs.settle(PROMOTED, b"now")
    assert [run.got for run in runs] == [[{PROMOTED: b"now"}]] * 3


def test_the_first_answer_counts(jobs: Jobs) -> None:
    run = Run(jobs, wait(ONE, TWO))
    jobs.settle(ONE, b"first")
    jobs.settle(ONE, b"second")
    jobs.settle(TWO)
    assert run.got == [{ONE: b"first", TWO: b""}]


def test_an_answer_that_comes_before_its_job_waits_for_it_is_kept(jobs: Jobs) -> None:
    run = Run(jobs, wait(TWO), wait(ONE), wait(PROMOTED))
    jobs.settle(ONE, b"early")
    jobs.settle(TWO)
    assert run.got == [{TWO: b""}, {ONE: b"early"}]
    assert run.ends == []


def test_an_early_answer_is_given_once(jobs: Jobs) -> None:
    jobs.settle(ONE, b"early")
    first, second = Run(jobs, wait(ONE)), Run(jobs, wait(ONE))
    assert (first.ends, second.ends) == ([""], [])


def test_a_refusal_that_comes_before_its_job_waits_for_it_is_kept(jobs: Jobs) -> None:
    run = Run(jobs, wait(TWO), wait(ONE))
    jobs.fail(ONE, "a/after: refused")
    assert run.ends == []
    jobs.settle(TWO)
    assert run.undone == run.ends == ["a/after: refused"]


def test_an_early_refusal_is_thrown_once(jobs: Jobs) -> None:
    jobs.fail(ONE, "a/after: refused")
    first, second = Run(jobs, wait(ONE)), Run(jobs, wait(ONE))
    assert (first.ends, second.ends) == (["a/after: refused"], [])


def test_only_answers_are_kept_and_not_for_ever(jobs: Jobs) -> None:
    jobs.settle(PROMOTED)
    assert Run(jobs, wait(PROMOTED)).ends == [], "an event is no answer: it must happen after one waits"
    jobs.settle(ONE)
    for token in range(EARLY_MAX):
        jobs.settle(("ack", "client", token))
    assert Run(jobs, wait(ONE)).ends == []
    assert Run(jobs, wait(("ack", "client", 0))).ends == [""]


def test_a_refusal_is_thrown_into_the_job_that_waits_for_it(jobs: Jobs) -> None:
    refused, other = Run(jobs, wait(ONE)), Run(jobs, wait(TWO))
    jobs.fail(ONE, "a/after: no such port")
    assert refused.undone == refused.ends == ["a/after: no such port"]
    assert other.ends == [] and len(jobs) == 1


def test_the_death_of_whoever_is_involved_fails_the_step(jobs: Jobs) -> None:
    run = Run(jobs, wait(ONE, involved=("a/after", "a/server")))
    other = Run(jobs, wait(TWO, involved=("b/after",)))
    jobs.died("a/server")
    assert run.undone == run.ends == ["a/server died"] and other.ends == []


def test_what_is_past_its_deadline_fails_and_says_what_is_missing(jobs: Jobs) -> None:
    run, other = Run(jobs, wait(ONE, TWO, seconds=0.25)), Run(jobs, wait(PROMOTED, seconds=60))
    due_ns = jobs.deadline_ns()
    assert due_ns is not None and due_ns <= time.monotonic_ns() + 250_000_000
    jobs.settle(ONE)
    jobs.expire(due_ns - 1)
    assert run.ends == []
    jobs.expire(due_ns)
    assert run.undone == ["no answer within 0.25 s: ack b/after"] and other.ends == []


def test_each_step_has_its_own_deadline(jobs: Jobs) -> None:
    Run(jobs, wait(ONE, seconds=1), wait(TWO, seconds=100))
    first_ns = jobs.deadline_ns()
    jobs.settle(ONE)
    second_ns = jobs.deadline_ns()
    assert first_ns is not None and second_ns is not None and second_ns - first_ns > 90e9


def test_without_jobs_there_is_no_deadline(jobs: Jobs) -> None:
    assert jobs.deadline_ns() is None
    jobs.expire(2**63)


def test_what_must_be_undone_may_take_steps_itself(jobs: Jobs) -> None:
    said: list[str] = []

    def steps() -> Steps:
        said.append("suspend")
        try:
            yield wait(ONE)
        except StepFailed:
            yield wait(TWO)
            said.append("resumed")
            raise

    ends: list[str] = []
    jobs.start("script", steps(), ends.append)
    jobs.fail(ONE, "refused")
    assert (said, ends, len(jobs)) == (["suspend"], [], 1)
    jobs.settle(TWO)
    assert (said, ends, len(jobs)) == (["suspend", "resumed"], ["refused"], 0)


def test_a_job_that_makes_up_for_a_failure_has_succeeded(jobs: Jobs) -> None:
    def steps() -> Steps:
        try:
            yield wait(ONE)
        except StepFailed:
            return

    ends: list[str] = []
    jobs.start("script", steps(), ends.append)
    jobs.died("nobody")
    jobs.fail(ONE, "refused")
    assert ends == [""]


def test_a_step_that_fails_by_itself_ends_its_job(jobs: Jobs) -> None:
    def steps() -> Steps:
        yield wait(ONE)
        raise StepFailed("b/after is gone")

    ends: list[str] = []
    jobs.start("script", steps(), ends.append)
    jobs.settle(ONE)
    assert ends == ["b/after is gone"] and len(jobs) == 0


def test_a_job_may_fail_before_its_first_wait(jobs: Jobs) -> None:
    def steps() -> Generator[Wait, dict[Key, bytes], None]:
        raise StepFailed
        yield wait()

    ends: list[str] = []
    jobs.start("script", steps(), ends.append)
    assert ends == ["failed"] and len(jobs) == 0


def test_the_end_of_a_job_may_fail_another_that_waits_for_the_same_key(jobs: Jobs) -> None:
    ends: list[str] = []

    def first_ends(reason: str) -> None:
        ends.append(reason)
        jobs.died("b/after")

    def steps_of(one: Wait) -> Steps:
        yield one

    jobs.start("first", steps_of(wait(ONE)), first_ends)
    second = Run(jobs, wait(ONE, involved=("b/after",)))
    jobs.settle(ONE)
    assert ends == [""] and second.ends == ["b/after died"] and len(jobs) == 0


def test_whoever_is_told_of_an_end_may_start_another_job(jobs: Jobs) -> None:
    ends: list[str] = []

    def one_more(reason: str) -> None:
        ends.append(reason)
        jobs.start("next", steps_of(wait(TWO)), ends.append)

    def steps_of(one: Wait) -> Steps:
        yield one

    jobs.start("script", steps_of(wait(ONE)), one_more)
    jobs.settle(ONE)
    assert jobs.names() == ["next"]
    jobs.settle(TWO)
    assert ends == ["", ""]

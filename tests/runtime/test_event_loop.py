"""The supervisor's loop: a machine that stood still is no reason to give up what is under way."""

import os
import select
import signal
import time
from collections.abc import Iterator
from typing import Final

import pytest

from aftbed.runtime.tasks import Key, Task, Wait
from aftbed.runtime.unix.event_loop import STALL_NS, EventLoop

pytestmark = pytest.mark.process

ANSWER: Final[Key] = ("ack", "b/after", 1)
WAIT_SECONDS: Final = 1.5
SAID_SECONDS_MAX: Final = 60.0
STALL_SECONDS: Final = WAIT_SECONDS + 2 * STALL_NS / 1e9
ANSWERED, FAILED, PAST_DEADLINE = b"answered", b"no answer", b"past the deadline"
HANDLES, HANDLED = b"handles", b"has handled"


class Waiting:
    """A process whose loop waits for one answer, and says what came of it."""

    def __init__(self) -> None:
        self._answers, self._answer = os.pipe()
        self._work, self._give_work = os.pipe()
        self._told, tell = os.pipe2(os.O_DIRECT)  # keeps messages apart
        self.pid = os.fork()
        if self.pid == 0:
            try:
                self._serve(tell)
            finally:
                os._exit(0)
        os.close(tell)
        assert self.said() == b"waits"

    def _serve(self, tell: int) -> None:
        loop = EventLoop()

        def task() -> Task:
            yield Wait(frozenset({ANSWER}), seconds=WAIT_SECONDS)

        def answered() -> None:
            os.read(self._answers, 1)
            loop.tasks.settle(ANSWER)

        def handle() -> None:
            os.read(self._work, 1)
            os.write(tell, HANDLES)
            os.read(self._work, 1)  # until it has stood still
            os.write(tell, HANDLED)

        def ended(reason: str) -> None:
            os.write(tell, FAILED if reason else ANSWERED)
            loop.end()

        def late() -> None:
            os.write(tell, PAST_DEADLINE)

        loop.read(self._answers, answered)
        loop.read(self._work, handle)
        loop.tasks.start("task", task(), ended)
        loop.after(WAIT_SECONDS, late)  # behind what has failed by then
        os.write(tell, b"waits")
        loop.run()

    def said(self) -> bytes:
        ready, _, _ = select.select([self._told], [], [], SAID_SECONDS_MAX)
        return os.read(self._told, 64) if ready else b""

    def answer(self) -> None:
        os.write(self._answer, b"!")

    def work(self) -> None:
        os.write(self._give_work, b"!")

    def stand_still(self) -> None:
        """As the processes of a machine that is paused."""
        os.kill(self.pid, signal.SIGSTOP)
        os.waitid(os.P_PID, self.pid, os.WSTOPPED)
        time.sleep(STALL_SECONDS)  # what is tested: time that goes by
        os.kill(self.pid, signal.SIGCONT)

    def end(self) -> None:
        os.kill(self.pid, signal.SIGKILL)
        os.waitpid(self.pid, 0)
        for descriptor in (self._answers, self._answer, self._work, self._give_work, self._told):
            os.close(descriptor)


@pytest.fixture
def waiting() -> Iterator[Waiting]:
    process = Waiting()
    yield process
    process.end()


def test_an_answer_has_its_time_again_after_the_machine_stood_still(waiting: Waiting) -> None:
    waiting.stand_still()
    assert waiting.said() == PAST_DEADLINE
    waiting.answer()
    assert waiting.said() == ANSWERED


def test_it_has_so_where_the_machine_stood_still_between_two_polls(waiting: Waiting) -> None:
    waiting.work()
    assert waiting.said() == HANDLES
    waiting.stand_still()
    waiting.work()
    assert [waiting.said(), waiting.said()] == [HANDLED, PAST_DEADLINE]
    waiting.answer()
    assert waiting.said() == ANSWERED


def test_without_an_answer_a_wait_fails_at_its_deadline(waiting: Waiting) -> None:
    assert waiting.said() == FAILED

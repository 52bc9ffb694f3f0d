"""Experiments over some processes, in order: what a campaign needs of a pool, and no pool of the library has.

A worker (`worker`) has one pipe. It is given an experiment, answers with what it found, and is given the next
one; it ends when its pipe does. Nobody stands between it and the command, which always knows who is at what:
an experiment that hangs, or whose worker dies, is named with the command that runs it alone.

Pools of the standard library know neither, and one that is interrupted while it starts a process may wait
for it for ever. Here an interrupt ends all at any moment: each worker ends with what it is at, so that its
run is taken down in order. A second interrupt kills them.
"""

import os
import pickle
import signal
import socket
import sys
import time
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from select import POLLIN, poll
from typing import Any, Final, Generic, NoReturn, TypeVar, cast

from aftbed.core.errors import HarnessError
from aftbed.runtime.unix import linux
from aftbed.runtime.unix.spawn import environment

# -- A worker: a process that is given one experiment after the other, and answers with what it found.
#
# Started afresh (`python -m`) or forked; it ends with its end of the pipe. Little is imported here, above
# all
# not `threading`, nor `multiprocessing`, which needs it: the nodes of a real run are forks of a fresh
# worker,
# and each would pay 0.3 ms of CPU for it.


SIZE_BYTES: Final = 8
PIPE_FD: Final = 3  # of a fresh one

Judge = Callable[[Any], object]
Answer = tuple[Any, Exception | None]  # what was found, or what was raised


def send(pipe: socket.socket, thing: object) -> None:
    """Raises OSError: nobody reads it."""
    data = pickle.dumps(thing, pickle.HIGHEST_PROTOCOL)
    pipe.sendall(len(data).to_bytes(SIZE_BYTES, "little") + data)


def receive(pipe: socket.socket) -> Any:
    """Raises EOFError, OSError."""
    return pickle.loads(_read(pipe, int.from_bytes(_read(pipe, SIZE_BYTES), "little")))


def _read(pipe: socket.socket, size: int) -> bytearray:
    data = bytearray(size)
    left = memoryview(data)
    while left:
        count = pipe.recv_into(left)
        if not count:
            raise EOFError
        left = left[count:]
    return data


def work(command: int, pipe: socket.socket, judge: Judge | None = None) -> NoReturn:
    """Leave interrupts to the command, and die with it, whatever ends it (G7).

    A fork has its `judge`; a fresh one is told first where modules are found, then it.
    """
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        linux.die_with(command)
        _answer(pipe, judge or _told(pipe))
    except (EOFError, OSError):
        os._exit(0)  # the command ends
    except BaseException:  # noqa: BLE001 - the last frame of this process
        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(1)


def _told(pipe: socket.socket) -> Judge:
    sys.path[:] = receive(pipe)
    judge: Judge = receive(pipe)
    return judge


def _answer(pipe: socket.socket, judge: Judge) -> NoReturn:
    while True:
        setup = receive(pipe)
        answer: Answer
        try:
            answer = judge(setup), None
        except Exception as error:  # noqa: BLE001 - whatever it is, it is the command's
            error.add_note(traceback.format_exc())
            answer = None, error
        send(pipe, answer)


if __name__ == "__main__":
    os.set_inheritable(PIPE_FD, False)
    work(int(sys.argv[1]), socket.socket(fileno=PIPE_FD))


WORKER: Final = "aftbed.runtime.unix.worker_pool"
AHEAD: Final = 32  # experiments for each worker that may be done before the oldest is
SECONDS_MAX: Final = 900.0  # of one: it takes seconds, on a busy machine a minute
RUN_END_SECONDS_MAX: Final = 30.0  # when the command ends: a real run is taken down in order
END_SECONDS_MAX: Final = 1.0  # of any other nothing is left, whatever ends it
TALK_SECONDS_MAX: Final = 60.0  # for what is sent to go on its way, and for what comes to go on
SETUP_MAX: Final = 300  # characters of an experiment in an error

S = TypeVar("S")
T = TypeVar("T")
Alone = Callable[[int, S], str]  # number and experiment -> a command


def each(
    judge: Callable[[S], T],
    setups: Iterable[S],
    jobs: int = 1,
    *,
    alone: Alone[S] | None = None,
    seconds_max: float = SECONDS_MAX,
    fresh: bool = False,
) -> Generator[tuple[int, S, T], None, None]:
    """Number, experiment and what `judge` found, in order, over `jobs` processes.

    `fresh`: processes that import what `judge` takes, and have nothing of the command's: those of a real run
    are forks of them, and all that is in them would be copied with each.
    What `judge` raises is raised here. Raises HarnessError if a worker dies, or is at one experiment for
    more than `seconds_max`; `alone` is the command that runs it by itself.
    """
    if jobs == 1 and not fresh:
        for number, setup in enumerate(setups):
            yield number, setup, judge(setup)
        return
    numbered = enumerate(setups)
    given: dict[int, S] = {}  # and not handed on yet, the oldest first
    found: dict[int, Answer] = {}
    crew = _Crew(judge, jobs, seconds_max, fresh)
    try:
        while True:
            while len(given) < AHEAD * jobs and crew.free() and (following := next(numbered, None)):
                number, given[number] = following
                crew.give(*following)
            if not given:
                return
            oldest = next(iter(given))
            found.update(crew.answers(waits=oldest not in found))
            if oldest in found:
                answer, error = found.pop(oldest)
                if error is not None:
                    raise error
                yield oldest, given.pop(oldest), cast("T", answer)
    except _LostError as lost:
        setup = given[lost.number]
        command = f"; alone: {alone(lost.number, setup)}" if alone is not None else ""
        raise HarnessError(f"{lost}: {f'{setup}'[:SETUP_MAX]}{command}") from None
    finally:
        crew.end()


class _LostError(Exception):
    """No answer will come for experiment `number`."""

    def __init__(self, number: int, why: str) -> None:
        super().__init__(f"experiment {number} {why}")
        self.number = number


class _Worker:
    """A process that is ours, and the number of what it is at."""

    def __init__(self, pid: int, pipe: socket.socket) -> None:
        self.pid, self.pidfd, self.pipe = pid, os.pidfd_open(pid), pipe
        self.number: int | None = None
        self.late_s = 0.0  # the time (monotonic) from which on it hangs

    def give(self, number: int, seconds_max: float, *words: object) -> None:
        """Raises _LostError."""
        self.number, self.late_s = number, time.monotonic() + seconds_max
        try:
            for word in words:
                send(self.pipe, word)
        except TimeoutError:
            raise self.hangs(TALK_SECONDS_MAX) from None
        except OSError:  # nobody reads it
            raise self.died() from None

    def answer(self) -> tuple[int, Answer]:
        """Raises _LostError."""
        number = self._asked()
        try:
            answer = receive(self.pipe)
        except TimeoutError:
            raise self.hangs(TALK_SECONDS_MAX) from None
        except (EOFError, OSError):
            raise self.died() from None
        self.number = None
        return number, answer

    def died(self) -> _LostError:
        """It has no more to say."""
        _ready([self.pidfd], END_SECONDS_MAX)
        ended = os.waitid(os.P_PIDFD, self.pidfd, os.WEXITED | os.WNOHANG | os.WNOWAIT)
        how = "has closed its pipe"
        if ended is not None:
            exited = ended.si_code == os.CLD_EXITED
            how = f"has {'ended with code' if exited else 'been killed by signal'} {ended.si_status}"
        return _LostError(self._asked(), f"has no result, its process {how}")

    def hangs(self, seconds_max: float) -> _LostError:
        """Kill it."""
        linux.kill(self.pidfd, signal.SIGKILL)
        return _LostError(self._asked(), f"hangs, after {seconds_max:g} s there is no result")

    def end(self) -> None:
        """Kill it if it lives."""
        linux.kill(self.pidfd, signal.SIGKILL)
        if _ready([self.pidfd], RUN_END_SECONDS_MAX):
            os.waitpid(self.pid, 0)
        os.close(self.pidfd)

    def _asked(self) -> int:
        assert self.number is not None, "only a process that was given work is named"
        return self.number


class _Crew(Generic[S]):
    """At most `jobs` workers, each started when it has something to do."""

    def __init__(self, judge: Callable[[S], object], jobs: int, seconds_max: float, fresh: bool) -> None:
        self._judge, self._jobs, self._seconds_max, self._fresh = judge, jobs, seconds_max, fresh
        self._workers: list[_Worker] = []

    def free(self) -> bool:
        """Whether one more experiment can be given."""
        return len(self._workers) < self._jobs or self._idle() is not None

    def give(self, number: int, setup: S) -> None:
        """Raises _LostError."""
        worker, words = self._idle(), list[object]()
        if worker is None:
            worker = self._start()
            words = [sys.path, self._judge] if self._fresh else []
        worker.give(number, self._seconds_max, *words, setup)

    def answers(self, *, waits: bool) -> Iterator[tuple[int, Answer]]:
        """Of each worker that has come to an end of what it was at; if it `waits`, of one at least.

        Raises _LostError.
        """
        busy = [worker for worker in self._workers if worker.number is not None]
        late_s = min((worker.late_s for worker in busy), default=0.0)
        patience_s = max(0.0, late_s - time.monotonic()) if waits else 0.0
        ready = _ready([fd for w in busy for fd in (w.pipe.fileno(), w.pidfd)], patience_s)
        if waits and not ready:
            raise min(busy, key=lambda worker: worker.late_s).hangs(self._seconds_max)
        for worker in busy:
            if worker.pipe.fileno() in ready:
                yield worker.answer()
            elif worker.pidfd in ready:  # what it has started may have its end of the pipe
                raise worker.died()

    def end(self) -> None:
        """Each ends with what it is at. One that takes too long is killed, all are at another interrupt."""
        try:
            for worker in self._workers:
                worker.pipe.close()
            limit_s = time.monotonic() + (RUN_END_SECONDS_MAX if self._fresh else END_SECONDS_MAX)
            left = {worker.pidfd for worker in self._workers}
            while left and (ended := _ready(left, max(0.0, limit_s - time.monotonic()))):
                left -= ended
        finally:
            with _uninterrupted():
                while self._workers:
                    self._workers.pop().end()

    def _idle(self) -> _Worker | None:
        return next((worker for worker in self._workers if worker.number is None), None)

    def _start(self) -> _Worker:
        ours, its = socket.socketpair()
        ours.settimeout(TALK_SECONDS_MAX)
        with its, _uninterrupted():
            pid = self._spawn(its) if self._fresh else self._fork(ours, its)
            self._workers.append(_Worker(pid, ours))
        return self._workers[-1]

    def _spawn(self, its: socket.socket) -> int:
        arguments = [sys.executable, "-P", "-m", WORKER, str(os.getpid())]
        descriptors = [(os.POSIX_SPAWN_DUP2, its.fileno(), PIPE_FD)]
        return os.posix_spawn(sys.executable, arguments, environment(), file_actions=descriptors)

    def _fork(self, ours: socket.socket, its: socket.socket) -> int:
        command, pid = os.getpid(), os.fork()
        if pid == 0:
            for pipe in (ours, *(worker.pipe for worker in self._workers)):
                pipe.close()  # a pipe ends with its last copy
            work(command, its, self._judge)
        return pid


def _ready(fds: Iterable[int], seconds: float) -> set[int]:
    """Those that can be read, or have ended; waits `seconds` at most for one."""
    found = poll()
    for fd in fds:
        found.register(fd, POLLIN)
    return {fd for fd, _ in found.poll(seconds * 1e3)}


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """An interrupt comes behind it; a process that is started in it hears of none.

    The mask is for this thread and for that process. The handler is for interrupts that the kernel gives to
    another thread of this process (libraries have some): Python would raise them here all the same.
    """
    came: list[int] = []
    try:
        handler = signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    except ValueError:  # not the main thread: interrupts are not for it
        yield
        return
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGINT, handler)
        if came:
            signal.raise_signal(signal.SIGINT)

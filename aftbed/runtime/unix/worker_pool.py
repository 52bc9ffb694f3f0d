"""A pool of worker processes for experiments, whose results come in order.

A worker has one pipe: it receives an experiment, sends its result, and receives the next one; it ends with
its pipe. No process stands between it and the command, which always knows what each worker is doing: an
experiment that hangs, or whose worker dies, is reported with the command that runs it alone.

Pools of the standard library know neither, and one that is interrupted while it starts a process may wait
for it for ever. Here an interrupt ends all at any moment: each worker finishes its experiment, so that its
run is taken down in order. What takes longer than END_SECONDS_MAX is killed, and the warden of its run cleans
up. A second interrupt kills them at once.

A worker is a fork, or a fresh interpreter (`python -m`). Little is imported here, above all not
`threading`, nor `multiprocessing`, which needs it: the nodes of a real run are forks of a fresh worker, and
each would pay 0.3 ms of CPU for it.
"""

import os
import pickle
import signal
import socket
import sys
import time
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing
from select import POLLIN, poll
from typing import Any, Final, NoReturn, TypeVar, cast

from aftbed.core.errors import HarnessError
from aftbed.runtime.unix import interrupts, linux
from aftbed.runtime.unix.interrupts import uninterrupted

AHEAD: Final = 32  # experiments for each worker that may be done before the oldest is
SECONDS_MAX: Final = 900.0  # of one: it takes seconds, on a busy machine a minute
OWN_SECONDS_MAX: Final = 60.0  # of a simulated one that executes a function of the user, and for each request
OWN_REQUEST_SECONDS_MAX: Final = 0.01
RUN_END_SECONDS_MAX: Final = 30.0  # when the command ends: a real run is taken down in order
END_SECONDS_MAX: Final = 0.5  # of a worker without real runs, or of any behind an interrupt
TALK_SECONDS_MAX: Final = 60.0  # for a message to be sent or received once it has begun
SETUP_MAX: Final = 300  # characters of an experiment in an error
SIZE_BYTES: Final = 8

Judge = Callable[[Any], object]
Result = tuple[Any, Exception | None]  # what was found, or what was raised
S = TypeVar("S")
T = TypeVar("T")
Alone = Callable[[int, S], str]  # number and experiment -> a command
Instead = Callable[[S, str], T]  # experiment, and what became of its worker -> a result


def each(
    judge: Callable[[S], T],
    setups: Iterable[S],
    jobs: int = 1,
    *,
    alone: Alone[S] | None = None,
    seconds_max: float = SECONDS_MAX,
    fresh: bool = False,
    apart: bool = False,
    instead: Instead[S, T] | None = None,
) -> Generator[tuple[int, S, T], None, None]:
    """Number, experiment and what `judge` found, in order, over `jobs` processes.

    `fresh`: in new interpreters that import what `judge` takes, and have nothing of the command's: the
    processes of a real run are forks of them, and all that is in them would be copied with each. `apart`:
    not in this process, even if `jobs` is 1, since code of the user may crash it, or hang. What `judge`
    raises is raised here. Raises HarnessError if a worker dies, or takes more than `seconds_max`
    for one experiment; `alone` is the command that runs it by itself. With `instead`, what that returns in
    this process is the result of such an experiment.

    Use it in `contextlib.closing`: its workers end when it is closed, and an interrupt of that is lost if the
    garbage collector closes it.
    """
    if jobs == 1 and not (fresh or apart):
        for number, setup in enumerate(setups):
            yield number, setup, judge(setup)
        return
    numbered = enumerate(setups)
    given: dict[int, S] = {}  # and not yielded yet, the oldest first
    found: dict[int, Result] = {}
    pool = _Pool(judge, jobs, seconds_max, fresh)
    try:
        while True:
            try:
                while len(given) < AHEAD * jobs and pool.has_room() and (following := next(numbered, None)):
                    number, given[number] = following
                    pool.give(*following)
                if not given:
                    return
                oldest = next(iter(given))
                for number, result in pool.results(waits=oldest not in found):
                    found[number] = result
            except _LostError as lost:
                setup = given[lost.number]
                if instead is None:
                    command = alone(lost.number, setup) if alone is not None else ""
                    which = f"; alone: {command}" if command else f": {setup}"[:SETUP_MAX]
                    raise HarnessError(f"{lost}{which}") from None
                pool.leave(lost.number)
                found[lost.number] = instead(setup, lost.how), None
            oldest = next(iter(given))
            if oldest in found:
                result, error = found.pop(oldest)
                if error is not None:
                    raise error
                yield oldest, given.pop(oldest), cast("T", result)
    finally:
        pool.end()


def own_seconds_max(requests: int) -> float:
    """Of a simulated experiment that executes a function of the user."""
    return OWN_SECONDS_MAX + OWN_REQUEST_SECONDS_MAX * requests


def once(
    judge: Callable[[S], T],
    setup: S,
    seconds_max: float,
    *,
    fresh: bool = False,
    apart: bool = False,
    alone: Alone[S] | None = None,
) -> T:
    """What `judge` finds in one experiment. As `each`."""
    results = each(judge, [setup], alone=alone, seconds_max=seconds_max, fresh=fresh, apart=apart)
    with closing(results):
        ((_, _, found),) = results
    return found


# -- in the command -------------------------------------------------------------------------------


class _LostError(Exception):
    """No result will come for experiment `number`."""

    def __init__(self, number: int, why: str, how: str) -> None:
        super().__init__(f"experiment {number} {why}")
        self.number, self.how = number, how


class _Worker:
    """A child of this process, and the number of its experiment, -1 for none."""

    def __init__(self, pid: int, pipe: socket.socket) -> None:
        self.pid, self.pidfd, self.pipe = pid, os.pidfd_open(pid), pipe
        self.number = -1
        self.deadline_s = 0.0  # monotonic

    def give(self, *messages: object) -> None:
        """Raises _LostError."""
        try:
            for message in messages:
                _send(self.pipe, message)
        except TimeoutError:
            raise self.hangs(TALK_SECONDS_MAX) from None
        except OSError:  # its end is closed
            raise self.died() from None

    def result(self) -> tuple[int, Result]:
        """Raises _LostError."""
        try:
            result = _receive(self.pipe)
        except TimeoutError:
            raise self.hangs(TALK_SECONDS_MAX) from None
        except (EOFError, OSError):
            raise self.died() from None
        number, self.number = self.number, -1
        return number, result

    def died(self) -> _LostError:
        """It has closed its pipe, or ended."""
        _ready([self.pidfd], END_SECONDS_MAX)
        ended = os.waitid(os.P_PIDFD, self.pidfd, os.WEXITED | os.WNOHANG | os.WNOWAIT)
        how = "has closed its pipe"
        if ended is not None:
            exited = ended.si_code == os.CLD_EXITED
            how = f"has {'ended with code' if exited else 'been killed by signal'} {ended.si_status}"
        return _LostError(self.number, f"has no result, its process {how}", how)

    def hangs(self, seconds_max: float) -> _LostError:
        """Kill it."""
        linux.kill(self.pidfd, signal.SIGKILL)
        why = f"hangs, after {seconds_max:g} s there is no result"
        return _LostError(self.number, why, f"was hanging, and was killed after {seconds_max:g} s")

    def end(self) -> None:
        """Kill it if it lives, and reap it."""
        linux.kill(self.pidfd, signal.SIGKILL)
        if _ready([self.pidfd], RUN_END_SECONDS_MAX):
            os.waitpid(self.pid, 0)
        os.close(self.pidfd)


class _Pool:
    """At most `jobs` workers, each started when there is something to do for it."""

    def __init__(self, judge: Judge, jobs: int, seconds_max: float, fresh: bool) -> None:
        self._judge, self._jobs, self._seconds_max, self._fresh = judge, jobs, seconds_max, fresh
        self._workers: list[_Worker] = []

    def has_room(self) -> bool:
        """Whether one more experiment can be given."""
        return len(self._workers) < self._jobs or any(worker.number < 0 for worker in self._workers)

    def give(self, number: int, setup: object) -> None:
        """Raises _LostError."""
        worker, first = next((w for w in self._workers if w.number < 0), None), list[object]()
        if worker is None:
            worker = self._start()
            first = [sys.path, self._judge] if self._fresh else []
        worker.number, worker.deadline_s = number, time.monotonic() + self._seconds_max
        worker.give(*first, setup)

    def results(self, *, waits: bool) -> Iterator[tuple[int, Result]]:
        """Of each worker that has one; if it `waits`, of one at least. Raises _LostError."""
        busy = [worker for worker in self._workers if worker.number >= 0]
        deadline_s = min((worker.deadline_s for worker in busy), default=0.0)
        patience_s = max(0.0, deadline_s - time.monotonic()) if waits else 0.0
        ready = _ready([fd for w in busy for fd in (w.pipe.fileno(), w.pidfd)], patience_s)
        if waits and not ready:
            raise min(busy, key=lambda worker: worker.deadline_s).hangs(self._seconds_max)
        for worker in busy:
            if worker.pipe.fileno() in ready:
                yield worker.result()
            elif worker.pidfd in ready:  # a process that it started may still have its end of the pipe
                raise worker.died()

    def leave(self, number: int) -> None:
        """End the worker that has experiment `number`."""
        with uninterrupted():
            for worker in [worker for worker in self._workers if worker.number == number]:
                self._workers.remove(worker)
                worker.pipe.close()
                worker.end()

    def end(self) -> None:
        """Let each finish its experiment. One that takes too long is killed, all are at another interrupt."""
        try:
            for worker in self._workers:
                worker.pipe.close()
            in_order = self._fresh and not interrupts.came()
            limit_s = time.monotonic() + (RUN_END_SECONDS_MAX if in_order else END_SECONDS_MAX)
            left = {worker.pidfd for worker in self._workers}
            while left and (ended := _ready(left, max(0.0, limit_s - time.monotonic()))):
                left -= ended
        finally:
            with uninterrupted():
                while self._workers:
                    self._workers.pop().end()

    def _start(self) -> _Worker:
        ours, theirs = socket.socketpair()
        ours.settimeout(TALK_SECONDS_MAX)
        command = os.getpid()
        with theirs, uninterrupted():
            if self._fresh:
                pid = linux.start_interpreter(__name__, theirs.fileno(), str(command))
            elif (pid := os.fork()) == 0:
                for pipe in (ours, *(worker.pipe for worker in self._workers)):
                    pipe.close()  # a pipe ends with its last copy
                _work(command, theirs, self._judge)
            self._workers.append(_Worker(pid, ours))
        return self._workers[-1]


def _ready(fds: Iterable[int], seconds: float) -> set[int]:
    """Those that can be read, or have ended; waits `seconds` at most for one."""
    found = poll()
    for fd in fds:
        found.register(fd, POLLIN)
    return {fd for fd, _ in found.poll(seconds * 1e3)}


# -- in the worker --------------------------------------------------------------------------------


def _work(command: int, pipe: socket.socket, judge: Judge | None = None) -> NoReturn:
    """Judge experiments until the pipe ends; die with the command, whatever ends that (G7).

    A fork has its `judge`; a fresh worker first receives where modules are found, then the judge. Interrupts
    are left to the command.
    """
    try:
        interrupts.ignore()
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        linux.die_with(command)
        if judge is None:
            sys.path[:] = _receive(pipe)
            judge = cast("Judge", _receive(pipe))
        while True:
            setup = _receive(pipe)
            result: Result
            try:
                result = judge(setup), None
            except Exception as error:  # noqa: BLE001 - whatever it is, the command raises it
                error.add_note(traceback.format_exc())
                result = None, error
            _send(pipe, result)
    except (EOFError, OSError):
        os._exit(0)  # the command ends
    except BaseException:  # noqa: BLE001 - the last frame of this process
        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(1)


def _send(pipe: socket.socket, thing: object) -> None:
    """Raises OSError if the other end is closed."""
    data = pickle.dumps(thing, pickle.HIGHEST_PROTOCOL)
    pipe.sendall(len(data).to_bytes(SIZE_BYTES, "little") + data)


def _receive(pipe: socket.socket) -> Any:
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


if __name__ == "__main__":
    os.set_inheritable(linux.INHERITED_FD, False)
    _work(int(sys.argv[1]), socket.socket(fileno=linux.INHERITED_FD))

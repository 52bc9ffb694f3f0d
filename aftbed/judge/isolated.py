"""Executes a function that a record names: in a process of its own, with limits.

The process is a fresh interpreter. It is in no directory of the user, prints nothing, takes at most
`MEMORY_BYTES_MAX` of memory and `SECONDS_MAX` seconds, writes no file, and has no network where the kernel
gives it a network namespace of its own (unshare(2); some containers refuse that). It still has the rights of
the user: the limits are there for mistakes in code that is trusted. Code that is not trusted is not executed
at all (`runtime.unix.trust`).

What it answers is MessagePack, of a declared type and a limited size. When it crashes, hangs or answers
anything else, the replies of the function are unknown, with the reason.
"""

import os
import resource
import select
import signal
import socket
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from types import ModuleType
from typing import Final, NoReturn

import msgspec

from aftbed.adapt.plugins import characteristics_of
from aftbed.core.application import Application, Characteristics
from aftbed.core.errors import ConfigError
from aftbed.judge.record import RunRecord
from aftbed.judge.reference import (
    NamedChange,
    ReferenceRun,
    Succession,
    changes_of,
    executed,
    loaded,
    reference_run,
    requests_of,
    succession,
)
from aftbed.runtime.unix import linux
from aftbed.runtime.unix.options import load_module
from aftbed.runtime.unix.trust import NOBODY, Code, Trust, load, search_path, vetted

ANSWER_BYTES_MAX: Final = 1 << 30
SIZE_BYTES: Final = 8
CHUNK_BYTES: Final = 1 << 20
END_SECONDS_MAX: Final = 5.0  # of a process that was killed
WORDS_MAX: Final = 300  # characters of what went wrong


class ProcessLimits(msgspec.Struct, frozen=True):
    """Of the process: wall clock, and address space."""

    seconds: float = 120.0
    memory_bytes: int = 4 << 30


LIMITS: Final = ProcessLimits()


class Execute(msgspec.Struct, frozen=True, tag=True):
    """Execute `requests` by the versions in `changes`."""

    changes: tuple[NamedChange, ...]
    requests: tuple[tuple[int, bytes], ...]


class Describe(msgspec.Struct, frozen=True, tag=True):
    """What the function `source` declares."""

    source: str


class Job(msgspec.Struct, frozen=True):
    """`path`: where the code looks for modules that it imports."""

    task: Execute | Describe
    codes: tuple[Code, ...]
    path: tuple[str, ...]
    memory_bytes: int


class Replies(msgspec.Struct, frozen=True, tag=True):
    run: ReferenceRun


class Declared(msgspec.Struct, frozen=True, tag=True):
    characteristics: Characteristics


class Failed(msgspec.Struct, frozen=True, tag=True):
    reason: str


Answer = Replies | Declared | Failed


# -- in the command -------------------------------------------------------------------------------


def reference_of(
    record: RunRecord,
    function: Callable[[], Application] | None = None,
    trust: Trust = NOBODY,
    limits: ProcessLimits = LIMITS,
) -> ReferenceRun:
    """Of `function` if it is given, else of the versions of the function that served the run.

    Those that the record names are executed in a process of their own, or in this one if it is its own run.
    Raises ConfigError where a version of an own run is gone.
    """
    if function is not None:
        return reference_run(record.history, function())
    if trust.own_run:
        return reference_run(record.history, succession(record.history, record.adaptations)())
    changes = changes_of(record.history, record.adaptations)
    sources = tuple(dict.fromkeys(source for _, source in changes if source))
    if not sources:
        return reference_run(record.history, Succession(loaded(changes, load_module)))
    task = Execute(tuple(changes), tuple(requests_of(record.history)))
    match _answer(task, sources, trust, limits):
        case Replies(run):
            return run
        case Failed(reason):
            return ReferenceRun((), b"", unknown=reason)
        case Declared():
            return ReferenceRun((), b"", unknown=_failed(sources, "it answered something else").reason)


def declared_by(source: str, trust: Trust, limits: ProcessLimits = LIMITS) -> Characteristics:
    """What the function `source` declares. Raises ConfigError if that is unknown."""
    found = _answer(Describe(source), (source,), trust, limits)
    if isinstance(found, Declared):
        return found.characteristics
    raise ConfigError(found.reason if isinstance(found, Failed) else f"{source}: it answered something else")


def _answer(
    task: Execute | Describe, sources: tuple[str, ...], trust: Trust, limits: ProcessLimits
) -> Answer:
    """Of a new process, which has ended then."""
    try:
        codes = tuple(vetted(source, trust) for source in sources)
    except ConfigError as error:
        return Failed(str(error))
    job = msgspec.msgpack.encode(Job(task, codes, tuple(search_path()), limits.memory_bytes))
    ours, theirs = socket.socketpair()
    with ours:
        with theirs:
            pid = linux.start_interpreter(__name__, theirs.fileno(), str(os.getpid()))
        pidfd = os.pidfd_open(pid)
        try:
            data = _exchange(ours, job, time.monotonic() + limits.seconds)
        except TimeoutError:
            return _failed(sources, f"it takes more than {limits.seconds:g} s")
        except (EOFError, OSError):
            return _failed(sources, f"its process {_end_of(pidfd)}")
        finally:
            with suppress(ProcessLookupError):
                os.killpg(pid, signal.SIGKILL)  # with what it may have started
            linux.kill(pidfd, signal.SIGKILL)
            os.waitpid(pid, 0)
            os.close(pidfd)
    try:
        found: Answer = msgspec.msgpack.decode(data, type=Answer)
    except (msgspec.DecodeError, RecursionError) as error:
        return _failed(sources, f"its process answered what is no answer: {error}")
    return _failed(sources, found.reason) if isinstance(found, Failed) else found


def _failed(sources: tuple[str, ...], why: str) -> Failed:
    return Failed(f"{', '.join(sources)} cannot be executed again: {why}"[: 2 * WORDS_MAX])


def _exchange(sock: socket.socket, job: bytes, limit_s: float) -> bytes:
    """Send the job and receive the answer. Raises TimeoutError, EOFError, OSError."""
    sock.setblocking(False)
    left = memoryview(len(job).to_bytes(SIZE_BYTES, "little") + job)
    while left:
        _wait(sock, select.POLLOUT, limit_s)
        left = left[sock.send(left) :]
    size = int.from_bytes(_received(sock, SIZE_BYTES, limit_s), "little")
    if size > ANSWER_BYTES_MAX:
        raise EOFError
    return _received(sock, size, limit_s)


def _received(sock: socket.socket, size: int, limit_s: float) -> bytes:
    found = bytearray()
    while len(found) < size:
        _wait(sock, select.POLLIN, limit_s)
        if not (some := sock.recv(min(CHUNK_BYTES, size - len(found)))):
            raise EOFError
        found += some
    return bytes(found)


def _wait(sock: socket.socket, events: int, limit_s: float) -> None:
    poll = select.poll()
    poll.register(sock, events)
    if not poll.poll(max(0.0, limit_s - time.monotonic()) * 1e3):
        raise TimeoutError


def _end_of(pidfd: int) -> str:
    """How the process ended, which has closed its socket."""
    poll = select.poll()
    poll.register(pidfd, select.POLLIN)
    poll.poll(END_SECONDS_MAX * 1e3)
    ended = os.waitid(os.P_PIDFD, pidfd, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    if ended is None:
        return "has closed its connection"
    return f"ended with {'code' if ended.si_code == os.CLD_EXITED else 'signal'} {ended.si_status}"


# -- in the process -------------------------------------------------------------------------------


def main(command: int, sock: socket.socket) -> NoReturn:
    """Do one job for the process `command`, and end."""
    os.setsid()
    linux.leave_network()
    linux.die_with(command)
    nowhere = os.open(os.devnull, os.O_RDWR)
    for descriptor in range(3):
        os.dup2(nowhere, descriptor)
    os.chdir("/")
    linux.no_core()
    job = msgspec.msgpack.decode(_whole(sock, int.from_bytes(_whole(sock, SIZE_BYTES), "little")), type=Job)
    resource.setrlimit(resource.RLIMIT_AS, (job.memory_bytes, job.memory_bytes))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    sys.path[:] = job.path
    sys.dont_write_bytecode = True
    try:
        data = msgspec.msgpack.encode(_done(job))
    except BaseException as error:  # noqa: BLE001 - whatever a function does
        reason = str(error) if isinstance(error, ConfigError) else f"{type(error).__name__}: {error}"
        data = msgspec.msgpack.encode(Failed(reason[:WORDS_MAX]))
    with suppress(OSError):  # the command is gone
        sock.sendall(len(data).to_bytes(SIZE_BYTES, "little") + data)
    os._exit(0)


def _done(job: Job) -> Answer:
    codes = {code.place: code for code in job.codes}

    def load_code(place: str) -> ModuleType:
        return load(codes[place])

    match job.task:
        case Execute(changes, requests):
            return Replies(executed(requests, Succession(loaded(changes, load_code))))
        case Describe(source):
            return Declared(characteristics_of(source, load_code))


def _whole(sock: socket.socket, size: int) -> bytes:
    found = bytearray()
    while len(found) < size:
        if not (some := sock.recv(min(CHUNK_BYTES, size - len(found)))):
            os._exit(1)  # the command is gone
        found += some
    return bytes(found)


if __name__ == "__main__":
    os.set_inheritable(linux.INHERITED_FD, False)
    main(int(sys.argv[1]), socket.socket(fileno=linux.INHERITED_FD))

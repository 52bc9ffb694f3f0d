"""One job in a process of its own, which may crash, hang or answer nonsense: code of others does it.

The process is a fresh interpreter that does not search the working directory (multiprocessing's would import
from there). It is in no directory of the user, prints nothing, has limits of time and memory, and no network
where the kernel gives it a network namespace of its own (unshare(2); some containers refuse that). It has the
rights of the user: the limits are there for mistakes, not against code that is not trusted.

Job and answer are bytes, with their length before them, over one socket; the caller decodes what it gets.
What the process is about to do it may write into memory that the command shares (`note`): when it crashes or
hangs, the message says where.
"""

import mmap
import os
import resource
import select
import signal
import socket
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from io import FileIO
from typing import Final, NoReturn

import msgspec

from aftbed.core.errors import shown
from aftbed.runtime.unix import linux

ANSWER_BYTES_MAX: Final = 4 << 30
SIZE_BYTES: Final = 8
CHUNK_BYTES: Final = 1 << 20
NOTE_BYTES: Final = 256
END_SECONDS_MAX: Final = 5.0  # of a process whose socket has ended


class ProcessLimits(msgspec.Struct, frozen=True):
    """Wall clock; address space; and the size of a file that it writes, None for any."""

    seconds: float
    memory_bytes: int
    file_bytes: int | None = None


class JobFailedError(Exception):
    """No answer came; the text says why, as the end of a sentence about the process.

    `noted`: the last `note` of the process, "" without one.
    """

    noted: str = ""


# -- in the command -------------------------------------------------------------------------------


def ask(module: str, job: bytes, limits: ProcessLimits, variables: Mapping[str, str] | None = None) -> bytes:
    """The answer of `module`, which is executed and calls `serve`. Raises JobFailedError.

    `variables` are added to its environment.
    """
    ours, theirs = socket.socketpair()
    noted = os.memfd_create("aftbed-note")
    os.truncate(noted, NOTE_BYTES)
    with ours, open(noted, "rb", buffering=0) as notes:
        with theirs:
            files = -1 if limits.file_bytes is None else limits.file_bytes
            words = (str(os.getpid()), str(limits.memory_bytes), str(files))
            pid = linux.start_interpreter(module, theirs.fileno(), *words, variables=variables)
        pidfd = os.pidfd_open(pid)
        try:
            return _exchange(ours, noted, job, time.monotonic() + limits.seconds)
        except TimeoutError:
            raise _failed(f"takes more than {limits.seconds:g} s", notes) from None
        except (EOFError, OSError):
            raise _failed(_end_of(pidfd), notes) from None
        finally:
            with suppress(ProcessLookupError):
                os.killpg(pid, signal.SIGKILL)  # with what it may have started
            linux.kill(pidfd, signal.SIGKILL)
            os.waitpid(pid, 0)
            os.close(pidfd)


def _failed(why: str, notes: FileIO) -> JobFailedError:
    error = JobFailedError(why)
    error.noted = shown(notes.read(NOTE_BYTES).rstrip(b"\0").decode(errors="replace"))
    return error


def _exchange(sock: socket.socket, notes: int, job: bytes, limit_s: float) -> bytes:
    """Send the job and receive the answer. Raises TimeoutError, EOFError, OSError."""
    sock.setblocking(False)
    socket.send_fds(sock, [len(job).to_bytes(SIZE_BYTES, "little")], [notes])
    left = memoryview(job)
    while left:
        _wait(sock, select.POLLOUT, limit_s)
        left = left[sock.send(left) :]
    size = int.from_bytes(_received(sock, SIZE_BYTES, limit_s), "little")
    if size > ANSWER_BYTES_MAX:
        raise JobFailedError(f"answered {size} bytes, allowed are {ANSWER_BYTES_MAX}")
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
        return "closed its connection"
    if ended.si_code == os.CLD_EXITED:
        return f"ended with code {ended.si_status}"
    return f"ended with signal {ended.si_status} ({signal.strsignal(ended.si_status)})"


# -- in the process -------------------------------------------------------------------------------


_notes: mmap.mmap | None = None  # shared with the command


def note(what: str) -> None:
    """Tell what this process is about to do, should it not return from it. Takes less than 1 us."""
    if _notes is not None:
        _notes[:] = what.encode()[:NOTE_BYTES].ljust(NOTE_BYTES, b"\0")


def serve(work: Callable[[bytes], bytes]) -> NoReturn:
    """Do the one job of this process by `work`, which raises nothing, and end."""
    global _notes  # noqa: PLW0603 - one of each process
    command, memory_bytes, file_bytes = map(int, sys.argv[1:])
    os.set_inheritable(linux.INHERITED_FD, False)
    os.setsid()
    linux.leave_network()
    linux.die_with(command)
    linux.no_core()
    nowhere = os.open(os.devnull, os.O_RDWR)
    for descriptor in range(3):
        os.dup2(nowhere, descriptor)
    os.chdir("/")
    with socket.socket(fileno=linux.INHERITED_FD) as sock:
        sock.setblocking(True)
        size, (descriptor,), *_ = socket.recv_fds(sock, SIZE_BYTES, 1)  # in one piece: it was sent as one
        _notes = mmap.mmap(descriptor, NOTE_BYTES)
        os.close(descriptor)
        job = _whole(sock, int.from_bytes(size, "little"))
        resource.setrlimit(resource.RLIMIT_AS, (memory_bytes, memory_bytes))
        if file_bytes >= 0:
            resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes, file_bytes))
        answer = work(job)
        with suppress(OSError):  # the command is gone
            sock.sendall(len(answer).to_bytes(SIZE_BYTES, "little"))
            sock.sendall(answer)
    os._exit(0)


def _whole(sock: socket.socket, size: int) -> bytes:
    found = bytearray()
    while len(found) < size:
        if not (some := sock.recv(min(CHUNK_BYTES, size - len(found)))):
            os._exit(1)  # the command is gone
        found += some
    return bytes(found)

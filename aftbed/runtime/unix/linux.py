"""Linux calls that Python does not have, what proc(5) shows of a process, and fresh interpreters.

`PR_SET_PDEATHSIG` (prctl(2)) ties a process to its parent's life; `PR_SET_CHILD_SUBREAPER` makes the
supervisor the parent of whatever its descendants leave behind.
"""

import contextlib
import ctypes
import fcntl
import os
import resource
import select
import signal
import site
import socket
import struct
import sys
import termios
import time
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Final

from aftbed.core.errors import HarnessError

PR_SET_PDEATHSIG: Final = 1
PR_SET_CHILD_SUBREAPER: Final = 36
MADV_POPULATE_WRITE: Final = 23
CLONE_NEWUSER: Final = 0x10000000
CLONE_NEWNET: Final = 0x40000000
PROC_BYTES_MAX: Final = 1 << 16
ADOPTION_SECONDS_MAX: Final = 5.0
FILES_GOOD: Final = 1024  # a supervisor of 37 processes holds 180, more while it adapts
_START: Final = 19  # the field `starttime` of /proc/PID/stat, the state being 0
SLICE_NS: Final = 500_000  # shorter than the default of some ms, long enough for all that a failover orders
REUSED_BYTES_MAX: Final = 32 << 20  # the greatest that mallopt(3) takes on 64 bits
KEPT_BYTES_MAX: Final = 4 * REUSED_BYTES_MAX  # a state as it was read, decoded, restored and encoded
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # malloc.h
INHERITED_FD: Final = 3  # of an interpreter that `start_interpreter` started

_libc: Final = ctypes.CDLL(None)  # without errno, which costs each process that forks some pages of memory
_SIGKILL, _SIGCONT, _TRUE = map(ctypes.c_ulong, (signal.SIGKILL, signal.SIGCONT, 1))
_NO_PRIORITY: Final = os.sched_param(0)


def _prctl(option: int, argument: ctypes.c_ulong) -> None:
    if _libc.prctl(option, argument, 0, 0, 0) != 0:
        raise HarnessError(f"the kernel refuses prctl({option}, {argument.value})")


def die_with(parent: int) -> None:
    """Have the kernel kill this process when `parent` dies. Ends it now if that happened already.

    The signal is bound to the parent of this moment, so this waits until `parent` has adopted the process. A
    dead one never does, and may have died before its child came here.
    """
    if os.getppid() != parent:
        _await_adoption(parent)
    _prctl(PR_SET_PDEATHSIG, _SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def _await_adoption(parent: int) -> None:
    limit = time.monotonic() + ADOPTION_SECONDS_MAX
    while os.getppid() != parent:
        if dead(parent) or time.monotonic() > limit:
            os._exit(1)
        os.sched_yield()


def continue_at_parents_death() -> None:
    """Have the kernel send SIGCONT to this process when its parent dies: if it was stopped, it goes on."""
    _prctl(PR_SET_PDEATHSIG, _SIGCONT)


def proc_text(pid: int, name: str) -> str:
    """The file `name` of proc(5) about `pid`, without a file object, which takes longer than the read. Raises
    OSError.
    """
    descriptor = os.open(f"/proc/{pid}/{name}", os.O_RDONLY | os.O_CLOEXEC)
    try:
        return os.read(descriptor, PROC_BYTES_MAX).decode(errors="replace")
    finally:
        os.close(descriptor)


def _stat(pid: int) -> list[str]:
    """The fields behind the name in `/proc/PID/stat` (proc(5)); none of a process that is gone."""
    try:
        return proc_text(pid, "stat").rpartition(")")[2].split()
    except OSError:
        return []


def started(pid: int) -> int:
    """When the process began, in ticks since the boot; -1 if there is none. Unique together with its pid."""
    fields = _stat(pid)
    return int(fields[_START]) if fields else -1


def state_of(pid: int) -> str:
    """The state letter of proc(5): `T` is stopped by a signal; `""` of a process that is gone."""
    return "".join(_stat(pid)[:1])


def dead(pid: int) -> bool:
    """Whether the process is a zombie, or gone."""
    return state_of(pid) in ("", "X", "Z")


class _SchedAttr(ctypes.Structure):
    _fields_ = (
        ("size", ctypes.c_uint32),
        ("policy", ctypes.c_uint32),
        ("flags", ctypes.c_uint64),
        ("nice", ctypes.c_int32),
        ("priority", ctypes.c_uint32),
        ("runtime", ctypes.c_uint64),
        ("deadline", ctypes.c_uint64),
        ("period", ctypes.c_uint64),
    )


def use_short_slices() -> None:
    """Ask for short time slices for this thread: woken, it runs before threads with long ones.

    sched_setattr(2), `sched_runtime` of SCHED_OTHER (Linux 6.12); no privilege, no larger share of the
    CPU, only sooner. Without it a watcher can wait 3 ms behind a backup that is catching up. A kernel
    that does not know it ignores it.
    """
    number = {"x86_64": 314, "aarch64": 274}.get(os.uname().machine)
    if number is not None:
        attributes = _SchedAttr(size=ctypes.sizeof(_SchedAttr), runtime=SLICE_NS)
        attributes.nice = os.getpriority(os.PRIO_PROCESS, 0)
        _libc.syscall(number, 0, ctypes.byref(attributes), 0)


def use_batch_scheduling() -> None:
    """Do not preempt the process that wakes this one: it blocks in a moment, and then this one runs.

    SCHED_BATCH (sched(7)): the nodes of a chain share a core and wake each other in turn; without it
    some hops take two switches instead of one.
    """
    os.sched_setscheduler(0, os.SCHED_BATCH, _NO_PRIORITY)


def yield_cpu(nice: int) -> None:
    """Run at `nice`, which the kernel counts against the processes of the same session, where it groups them
    by session (sched(7), "The autogroup feature"); against all others too, if this process leads its session.
    """
    os.nice(nice)
    if os.getsid(0) == os.getpid():
        with contextlib.suppress(OSError):  # no groups, or changed too often just now
            Path("/proc/self/autogroup").write_text(str(nice))


def package_environment() -> dict[str, str]:
    """An environment in which an interpreter finds this very package."""
    home, environment = str(Path(__file__).resolve().parents[3]), dict(os.environ)
    if home not in site.getsitepackages():
        path = os.environ.get("PYTHONPATH")
        environment["PYTHONPATH"] = os.pathsep.join((home, path)) if path else home
    return environment


def start_interpreter(
    module: str, descriptor: int, *arguments: str, variables: Mapping[str, str] | None = None
) -> int:
    """Start `python -m module arguments`, which gets `descriptor` as `INHERITED_FD`; its pid.

    `variables` are added to the environment. The module is that of this very package: the working directory
    is not searched (`-P`).
    """
    return os.posix_spawn(
        sys.executable,
        [sys.executable, "-P", "-m", module, *arguments],
        package_environment() | dict(variables or {}),
        file_actions=[(os.POSIX_SPAWN_DUP2, descriptor, INHERITED_FD)],
    )


def become_subreaper() -> None:
    _prctl(PR_SET_CHILD_SUBREAPER, _TRUE)


def set_name(name: str) -> None:
    """The name that `ps` and `/proc/PID/comm` show (15 bytes); a sandbox may keep the old one."""
    try:  # prctl(2) by way of ctypes would write to 40 pages of memory of each process
        comm = os.open("/proc/self/comm", os.O_WRONLY | os.O_CLOEXEC)
    except OSError:
        return
    os.write(comm, name.encode()[:15])
    os.close(comm)


def allow_files() -> int:
    """Raise the soft limit on open files to `FILES_GOOD` if it is lower, as far as allowed; the new limit."""
    files, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    if files == resource.RLIM_INFINITY or files >= FILES_GOOD:
        return FILES_GOOD
    files = FILES_GOOD if most == resource.RLIM_INFINITY else min(most, FILES_GOOD)
    resource.setrlimit(resource.RLIMIT_NOFILE, (files, most))
    return files


def no_core() -> None:
    """Disable core files for this process."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def leave_network() -> bool:
    """Give this process, which has one thread, a network without any device (unshare(2)); False if refused.

    Without privileges that takes a user namespace, which some containers and distributions do not allow.
    """
    return any(_libc.unshare(flags) == 0 for flags in (CLONE_NEWNET, CLONE_NEWUSER | CLONE_NEWNET))


def kill(pidfd: int, sig: signal.Signals) -> bool:
    """Signal the very process behind `pidfd`; False if it is gone."""
    try:
        signal.pidfd_send_signal(pidfd, sig)
    except ProcessLookupError:
        return False
    return True


def trim() -> None:
    """Return memory that is allocated but free to the kernel: a fork copies less, a death unmaps less."""
    _libc.malloc_trim(0)


def reuse_blocks() -> None:
    """Have the memory of blocks up to `REUSED_BYTES_MAX` used again, here and in all forks from here on.

    By default the C library gives it back at once, and each page of the next block is a fault and is cleared:
    for a state of 1 MB that takes longer than to copy and to compare it. Larger blocks go back, and what is
    free above `KEPT_BYTES_MAX`.
    """
    _libc.mallopt(M_MMAP_THRESHOLD, REUSED_BYTES_MAX)
    _libc.mallopt(M_TRIM_THRESHOLD, KEPT_BYTES_MAX)


def waited_ns(pid: int) -> int:
    """How long `pid` has been runnable and did not run so far (schedstats); 0 where that is not known."""
    try:
        return int(proc_text(pid, "schedstat").split()[1])
    except (OSError, ValueError, IndexError):
        return 0


def ends(pidfd: int, seconds: float) -> bool:
    """Whether that process ends within `seconds`."""
    return bool(readable((pidfd,), seconds))


def readable(descriptors: Iterable[int], seconds: float | None) -> set[int]:
    """Those of `descriptors` that are readable or have ended, within `seconds`; None is no limit."""
    poll = select.poll()
    for descriptor in descriptors:
        poll.register(descriptor, select.POLLIN)
    return {descriptor for descriptor, _ in poll.poll(None if seconds is None else seconds * 1e3)}


def reap(pid: int) -> int | None:
    """The exit status of the dead child `pid` (negative: the signal), or None if it is not ours."""
    with contextlib.suppress(ChildProcessError):
        got, status = os.waitpid(pid, os.WNOHANG)
        if got == pid:
            return os.waitstatus_to_exitcode(status)
    return None


def backlog(sock: socket.socket) -> float:
    """How much of what fits is sent and not read yet: 0 to 1 (SIOCOUTQ, unix(7))."""
    waiting = int.from_bytes(fcntl.ioctl(sock, termios.TIOCOUTQ, bytes(4)), sys.byteorder)
    return waiting / sock.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF)


def set_timeouts(sock: socket.socket, receive_seconds: float, send_seconds: float) -> None:
    """Kernel timeouts, which hold for plain reads and writes of the descriptor too."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, _timeval(receive_seconds))
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _timeval(send_seconds))


@lru_cache
def _timeval(seconds: float) -> bytes:
    return struct.pack("ll", int(seconds), int(seconds % 1 * 1e6))

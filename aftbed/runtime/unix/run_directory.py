"""The directories of a run, and which processes belong to it.

The private directory, `$XDG_RUNTIME_DIR/aftbed/ID` or `/tmp/aftbed-UID/ID`, mode 0700, has the control
socket and goes with the run. Without `--record` the record lies inside it and goes too.

It belongs to the process that made it, the command, and is locked by it (flock(2)) from the first moment
on: the kernel releases the lock with that process, so whether a run has an owner is never a guess. The lock
is not inherited: every descendant of the command releases it.
"""

import contextlib
import fcntl
import mmap
import os
import re
import secrets
import select
import shutil
import signal
import socket
import stat
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.errors import ConfigError, HarnessError
from aftbed.runtime.unix import linux

# -- Membership: a process belongs to a run by a mark that it carries, never by its name.
#
# The mark names the run's private directory. What a run executes anew (a zygote) and all that is forked
# from it has it in its environment, `AFTBED_RUN`, which the kernel shows as it was at the exec. The
# supervisor and the warden are forks of a command, whose environment is not the run's. So each maps a page
# of a memfd with the directory in its name, and so has all that is forked from them, whatever descriptors
# it closes. No process has either by accident; both outlive the directory, and both go with the process.
#
# The kernel gives a pid to another process later. Together with the start time of the process it is unique
# (proc(5), `starttime`): see `signalled`.


VARIABLE: Final = "AFTBED_RUN"
_MARK: Final = "aftbed-run:"
_MAPPED: Final = re.compile(rf" /memfd:{_MARK}(.+?)(?: \(deleted\))?$", re.MULTILINE)
_DELETED: Final = " (deleted)"
_marks: Final[list[mmap.mmap]] = []  # kept mapped
_START: Final = 19  # of the fields behind the name in /proc/PID/stat, the state being 0


class Member(msgspec.Struct, frozen=True):
    """A process that carries the mark of `run`, a private directory; `start` is in ticks since the boot."""

    pid: int
    start: int
    run: str
    name: str
    state: str

    def end(self, seconds: float) -> bool:
        """Kill it, and see it dead; False if that was not seen."""
        try:
            pidfd = os.pidfd_open(self.pid)
        except ProcessLookupError:
            return True
        try:
            if not _is(self.pid, self.start, Path(self.run)):
                return True
            linux.kill(pidfd, signal.SIGKILL)
            poll = select.poll()
            poll.register(pidfd, select.POLLIN)
            return bool(poll.poll(seconds * 1e3))
        finally:
            os.close(pidfd)


def mark(private: Path) -> None:
    """Mark this process and what it will fork, for good; nothing that it will execute."""
    descriptor = os.memfd_create(f"{_MARK}{private}", os.MFD_CLOEXEC)
    try:
        os.ftruncate(descriptor, mmap.PAGESIZE)
        _marks.append(mmap.mmap(descriptor, mmap.PAGESIZE, prot=mmap.PROT_READ))
    finally:
        os.close(descriptor)


def signalled(pid: int, start: int, run: Path, sig: signal.Signals) -> bool:
    """Signal the process `pid` if it is the one that began at `start` and belongs to `run`."""
    try:
        pidfd = os.pidfd_open(pid)
    except ProcessLookupError:
        return False
    try:  # looked at behind the open: who it is now is who it is for as long as the pidfd is open
        return _is(pid, start, run) and linux.kill(pidfd, sig)
    finally:
        os.close(pidfd)


def _is(pid: int, start: int, run: Path) -> bool:
    return started(pid) == start and run_of(pid) == run


def _fields(pid: int) -> list[str]:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return []


def started(pid: int) -> int:
    """When the process began, in ticks since the boot; -1 if there is none."""
    fields = _fields(pid)
    return int(fields[_START]) if fields else -1


def state_of(pid: int) -> str:
    """The state letter of proc(5): `T` is stopped by a signal; `""` of a process that is gone."""
    fields = _fields(pid)
    return fields[0] if fields else ""


def run_of(pid: int) -> Path | None:
    """The private directory of the run that the process belongs to, None of any other process."""
    try:
        environment = Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
        mappings = os.fsdecode(Path(f"/proc/{pid}/maps").read_bytes())
    except OSError:
        return None
    for word in environment:
        key, _, value = word.partition(b"=")
        if key == VARIABLE.encode():
            return Path(os.fsdecode(value))
    marks = _MAPPED.findall(mappings)
    return Path(marks[0]) if marks else None


def _links(pid: int) -> list[str]:
    """What the descriptors of the process are open on."""
    found: list[str] = []
    with contextlib.suppress(OSError):
        for descriptor in os.scandir(f"/proc/{pid}/fd"):
            with contextlib.suppress(OSError):  # closed meanwhile
                found.append(str(Path(descriptor).readlink()))
    return found


def _pids() -> Iterator[int]:
    """Of the processes of this user."""
    for entry in os.scandir("/proc"):
        with contextlib.suppress(OSError):
            if entry.name.isdigit() and entry.stat().st_uid == os.getuid():
                yield int(entry.name)


def held(removed: Path) -> bool:
    """Whether a process has the directory open that was removed from that place."""
    return any(f"{removed}{_DELETED}" in _links(pid) for pid in _pids())


def members() -> Iterator[Member]:
    """Every living process of this user that belongs to a run."""
    for pid in _pids():
        start, run, state = started(pid), run_of(pid), state_of(pid)
        try:
            name = Path(f"/proc/{pid}/comm").read_text().rstrip("\n")
        except OSError:
            continue
        if run is not None and state and state not in "ZX" and started(pid) == start:
            yield Member(pid, start, str(run), name, state)


SOCKET_NAME: Final = "control"
ID_BYTES: Final = 3
ANSWER_SECONDS_MAX: Final = 2.0
CONNECT_PAUSE_SECONDS: Final = 0.005

_owned: dict[Path, int] = {}  # by private directory, the descriptor that holds its lock


def root() -> Path:
    """The directory of all runs of this user; made if absent. Raises HarnessError if it is not ours."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if runtime and Path(runtime).is_dir():
        path = Path(runtime) / "aftbed"
    else:
        path = Path(os.environ.get("TMPDIR") or "/tmp") / f"aftbed-{os.getuid()}"
    with contextlib.suppress(FileExistsError):
        path.mkdir(mode=0o700)
    state = path.lstat()
    if not stat.S_ISDIR(state.st_mode) or state.st_uid != os.getuid() or state.st_mode & 0o077:
        raise HarnessError(f"{path}: must be a directory of this user alone (mode 0700); remove it")
    return path


def create() -> Path:
    """A new private directory; its name is the id of the run."""
    path = free()
    make(path)
    return path


def free() -> Path:
    """Where a private directory can be made."""
    while (path := root() / secrets.token_hex(ID_BYTES)).exists():
        pass
    return path


def make(path: Path) -> None:
    """Make it, and own it. Raises HarnessError where another run has just done so, or nobody can."""
    try:
        path.mkdir(mode=0o700)
    except OSError as error:
        raise HarnessError(f"{path}: cannot be made: {error.strerror}; start the run again") from None
    _owned[path] = _locked(path)


def _locked(path: Path) -> int:
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
    except OSError as error:
        os.close(descriptor)
        path.rmdir()
        raise HarnessError(
            f"{path}: cannot be locked: {error.strerror}; set XDG_RUNTIME_DIR or TMPDIR to a local disk"
        ) from None
    return descriptor


def _disown() -> None:
    """In a child: it owns none of the runs of its parent."""
    for descriptor in _owned.values():
        os.close(descriptor)
    _owned.clear()


os.register_at_fork(after_in_child=_disown)


def owned(private: Path) -> bool:
    """Whether the process that made `private` lives; False too where there is no such directory."""
    try:
        descriptor = os.open(private, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    else:
        return False
    finally:
        os.close(descriptor)


def owned_here(private: Path) -> bool:
    """Whether this process has made it."""
    return private in _owned


def record_directory(path: Path) -> Path:
    """Make the directory of a record; raises ConfigError if `path` exists or cannot be made."""
    try:
        path.mkdir(parents=True)
        (path / "journal").mkdir()
    except FileExistsError:
        raise ConfigError(f"--record {path}: exists already; name a directory that does not") from None
    except OSError as error:
        raise ConfigError(f"--record {path}: cannot be made: {error.strerror}") from None
    return path.resolve()


def remove(private: Path) -> None:
    """Remove the private directory of a run that has ended."""
    shutil.rmtree(private, ignore_errors=True)
    if private in _owned:
        os.close(_owned.pop(private))


def live() -> list[str]:
    """The ids of the runs whose supervisor answers, oldest first."""
    found = []
    for path in sorted(root().iterdir(), key=lambda p: p.stat().st_mtime if p.exists() else 0.0):
        try:
            connect(path).close()
        except OSError:
            continue
        found.append(path.name)
    return found


def connect(private: Path) -> socket.socket:
    """A connection to the supervisor of the run in `private`; raises OSError."""
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        _connect(sock, str(private / SOCKET_NAME))
        sock.settimeout(ANSWER_SECONDS_MAX)
    except OSError:
        sock.close()
        raise
    return sock


def _connect(sock: socket.socket, address: str) -> None:
    """A supervisor that is busy has a full queue for a moment; that is no death."""
    limit = time.monotonic() + ANSWER_SECONDS_MAX
    sock.setblocking(False)
    while True:
        try:
            sock.connect(address)
        except BlockingIOError:
            if time.monotonic() > limit:
                raise
            time.sleep(CONNECT_PAUSE_SECONDS)  # connect(2) on a full queue gives no event to wait for
        else:
            return


def find(run: str | None) -> Path:
    """The private directory of run `run`, or of the only one alive. Raises ConfigError."""
    alive = live()
    if run is not None:
        if run not in alive:
            known = ", ".join(alive) or "none"
            raise ConfigError(f"--run {run}: no such run is alive (alive: {known})")
        return root() / run
    if not alive:
        raise ConfigError("no run is alive; start one with `aftbed run`")
    if len(alive) > 1:
        raise ConfigError(f"{len(alive)} runs are alive: name one with --run (alive: {', '.join(alive)})")
    return root() / alive[0]

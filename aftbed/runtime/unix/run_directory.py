"""The directories of a run, and which processes belong to it.

*The private directory*, mode 0700, contains the control socket and is removed with the run. Without
`--record` the record lies inside it and is removed too. It is `$XDG_RUNTIME_DIR/aftbed/ID`; where that is not
set, `$TMPDIR/aftbed-UID/ID`; without both it lies in `/dev/shm` or, where that does not suit, in `/tmp`. The
journals of an experiment cost it an eighth of its time on a disk.

It belongs to the process that made it, the command, which locks it (flock(2)) from the first moment on. The
kernel releases the lock with that process, so whether a run has an owner is never a guess. The lock is not
inherited: every descendant of the command releases it.

*Membership*: a process belongs to a run by a mark that it carries, never by its name. The mark names the
private directory. What a run executes anew (a zygote), and all that is forked from it, has it in its
environment, `AFTBED_RUN`, which the kernel shows as it was at the exec. The supervisor and the warden are
forks of a command, whose environment is not the run's. So each maps a page of a memfd with the directory in
its name, and so has all that is forked from them, whatever descriptors it closes. No process has either by
accident; both outlive the directory, and both end with the process.

The kernel gives a pid to another process later. It is unique only together with the start time of the process
(`linux.started`): see `signalled`.
"""

import contextlib
import fcntl
import mmap
import os
import re
import select
import signal
import socket
import stat
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.errors import ConfigError
from aftbed.runtime.unix import linux

SOCKET_NAME: Final = "control"
SOCKET_PATH_MAX: Final = 107  # bytes, unix(7), without the NUL
HISTORY_NAME: Final = "adaptations.jsonl"  # in the record: a line for each adaptation that has ended
EVENT_LOG_NAME: Final = "events.jsonl"  # in the record: what was printed
BUS_NAME: Final = "bus.log"  # in the record: all frames of the bus
ID_BYTES: Final = 3
ANSWER_SECONDS_MAX: Final = 2.0
CONNECT_PAUSE_SECONDS: Final = 0.005
VARIABLE: Final = "AFTBED_RUN"
MEMORY: Final = Path("/dev/shm")  # shared memory, as a rule
MEMORY_BYTES_MIN: Final = 1 << 30  # less fills up: that of a container has 64 MiB
ELSEWHERE: Final = "set XDG_RUNTIME_DIR or TMPDIR to a directory that this user can write to"

_MARK: Final = "aftbed-run:"
_MAPPED: Final = re.compile(rf" /memfd:{_MARK}(.+?)(?: \(deleted\))?$", re.MULTILINE)
_marks: Final[list[mmap.mmap]] = []  # kept mapped
_owned: Final[dict[Path, int]] = {}  # by private directory, the descriptor that holds its lock


# -- making and removing --------------------------------------------------------------------------


def root() -> Path:
    """The directory of all runs of this user; made if absent. Raises ConfigError if that cannot be, or if it
    is not ours.
    """
    path = _place()
    try:
        with contextlib.suppress(FileExistsError):
            path.mkdir(mode=0o700)
        state = path.lstat()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be made: {error.strerror}; {ELSEWHERE}") from None
    if not stat.S_ISDIR(state.st_mode) or state.st_uid != os.getuid() or state.st_mode & 0o077:
        raise ConfigError(f"{path}: must be a directory of this user alone (mode 0700); remove it")
    return path


def _place() -> Path:
    """Of the directory of all runs, which need not be there."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if runtime and os.path.isdir(runtime):  # noqa: PTH112 - False too where this user may not look
        return Path(runtime) / "aftbed"
    folder = os.environ.get("TMPDIR") or (MEMORY if suits(MEMORY) else "/tmp")
    return Path(folder) / f"aftbed-{os.getuid()}"


def suits(folder: Path) -> bool:
    """Whether runs may lie in this memory: it is large, and libraries can be loaded from there (FMUs are)."""
    try:
        found = os.statvfs(folder)
    except OSError:
        return False
    large = found.f_blocks * found.f_frsize >= MEMORY_BYTES_MIN
    return large and not found.f_flag & (os.ST_NOEXEC | os.ST_RDONLY) and os.access(folder, os.W_OK | os.X_OK)


def free() -> Path:
    """Where a private directory can be made; its name is the id of the run. Raises ConfigError."""
    above = root()
    try:
        str(above).encode()
    except UnicodeEncodeError:  # messages could not carry it
        raise ConfigError(f"{above}: not UTF-8; set XDG_RUNTIME_DIR or TMPDIR to another path") from None
    while (path := above / os.urandom(ID_BYTES).hex()).exists():
        pass
    over = socket_bytes(above) - SOCKET_PATH_MAX
    if over > 0:
        raise ConfigError(
            f"{path / SOCKET_NAME}: {over} bytes too long for the path of a socket;"
            " set XDG_RUNTIME_DIR or TMPDIR to a shorter path"
        )
    return path


def socket_bytes(above: Path) -> int:
    """How long the path of a control socket is, of a run below `above`."""
    return len(os.fsencode(above / ("0" * 2 * ID_BYTES) / SOCKET_NAME))


def make(path: Path) -> None:
    """Make a private directory, and own it.

    Raises ConfigError if another run has just made it, or it cannot be made or locked.
    """
    try:
        path.mkdir(mode=0o700)
    except FileExistsError as error:
        raise ConfigError(f"{path}: cannot be made: {error.strerror}; start the run again") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be made: {error.strerror}; {ELSEWHERE}") from None
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
    except OSError as error:
        os.close(descriptor)
        path.rmdir()
        raise ConfigError(
            f"{path}: cannot be locked: {error.strerror}; set XDG_RUNTIME_DIR or TMPDIR to a local disk"
        ) from None
    _owned[path] = descriptor


def _disown() -> None:
    """In a child: it owns none of the runs of its parent."""
    if not _owned:
        return
    for descriptor in _owned.values():
        os.close(descriptor)
    _owned.clear()


os.register_at_fork(after_in_child=_disown)


def owned(private: Path) -> bool:
    """Whether the process that made `private` lives; False too if there is no such directory."""
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


def remove(private: Path) -> None:
    """Remove the private directory of a run that has ended."""
    import shutil  # noqa: PLC0415 - with it come three libraries of compression, which no node needs

    shutil.rmtree(private, ignore_errors=True)
    if private in _owned:
        os.close(_owned.pop(private))


def record_directory(path: Path) -> Path:
    """Make the directory of a record; raises ConfigError if `path` exists or cannot be made."""
    try:
        path.mkdir(mode=0o700, parents=True)  # whatever the umask: its own command trusts what is in it
        (path / "journal").mkdir(mode=0o700)
    except FileExistsError:
        raise ConfigError(f"--record {path}: exists already; name a directory that does not") from None
    except OSError as error:
        raise ConfigError(f"--record {path}: cannot be made: {error.strerror}") from None
    return path.resolve()


# -- finding live runs ----------------------------------------------------------------------------


def connect(private: Path, seconds: float = ANSWER_SECONDS_MAX) -> socket.socket:
    """A connection to the supervisor of the run in `private`; raises OSError."""
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    limit = time.monotonic() + seconds
    try:
        sock.setblocking(False)
        while True:
            try:
                sock.connect(str(private / SOCKET_NAME))
            except BlockingIOError:  # the queue of a busy supervisor is full for a moment
                if time.monotonic() > limit:
                    raise
                time.sleep(CONNECT_PAUSE_SECONDS)  # connect(2) on a full queue gives no event to wait for
            else:
                break
        sock.settimeout(seconds)
    except OSError:
        sock.close()
        raise
    return sock


def owned_runs() -> list[str]:
    """The ids of the runs whose command lives, the youngest first. Nothing is asked, waited for or made."""
    with contextlib.suppress(OSError):
        found = [path for path in _place().iterdir() if owned(path)]
        return [path.name for path in sorted(found, key=lambda path: -path.stat().st_mtime)]
    return []


def live() -> list[str]:
    """The ids of the runs whose supervisor answers, oldest first."""
    found = []
    for path in sorted(root().iterdir(), key=lambda p: p.stat().st_mtime if p.exists() else 0.0):
        with contextlib.suppress(OSError):
            connect(path).close()
            found.append(path.name)
    return found


def find(run: str | None) -> Path:
    """The private directory of run `run`, or of the only one alive. Raises ConfigError.

    An id may be shortened as long as it means one run.
    """
    alive = live()
    known = ", ".join(alive) or "none"
    meant = [name for name in alive if run and name.startswith(run)]
    if len(meant) > 1:
        raise ConfigError(f"--run {run}: {len(meant)} runs begin so: {', '.join(meant)}")
    run = meant[0] if meant else run
    if run is not None and not meant:
        raise ConfigError(f"--run {run}: no such run is alive (alive: {known})")
    if run is None and not alive:
        raise ConfigError("no run is alive; start one with `aftbed run`")
    if run is None and len(alive) > 1:
        raise ConfigError(f"{len(alive)} runs are alive: name one with --run (alive: {known})")
    return root() / (run or alive[0])


# -- the processes of a run -----------------------------------------------------------------------


class Member(msgspec.Struct, frozen=True, tag="process", tag_field="kind"):
    """A process that carries the mark of `run`, a private directory.

    `start` is in ticks since the boot; `state` as in proc(5), `T` being stopped.
    """

    run: str
    pid: int
    start: int
    name: str
    state: str

    def __str__(self) -> str:
        stopped = ", stopped" if self.state == "T" else ""
        return f"process {self.pid} ({self.name}{stopped}) of run {Path(self.run).name}"

    def end(self, seconds: float) -> bool:
        """Kill it, and wait for its death; False if that was not seen within `seconds`."""
        with _process(self.pid, self.start, Path(self.run)) as pidfd:
            if pidfd is None:
                return True
            linux.kill(pidfd, signal.SIGKILL)
            poll = select.poll()
            poll.register(pidfd, select.POLLIN)
            return bool(poll.poll(seconds * 1e3))


def mark(private: Path) -> None:
    """Mark this process and what it will fork, for good; but nothing that it will execute."""
    descriptor = os.memfd_create(f"{_MARK}{private}", os.MFD_CLOEXEC)
    try:
        os.ftruncate(descriptor, mmap.PAGESIZE)
        _marks.append(mmap.mmap(descriptor, mmap.PAGESIZE, prot=mmap.PROT_READ))
    finally:
        os.close(descriptor)


def signalled(pid: int, start: int, run: Path, sig: signal.Signals) -> bool:
    """Signal the process `pid` if it is the one that began at `start` and belongs to `run`."""
    with _process(pid, start, run) as pidfd:
        return pidfd is not None and linux.kill(pidfd, sig)


@contextlib.contextmanager
def _process(pid: int, start: int, run: Path) -> Iterator[int | None]:
    """A pidfd of the process `pid` that began at `start` and belongs to `run`; None if there is none.

    What /proc shows after the pidfd was opened belongs to the same process for as long as it is open.
    """
    try:
        pidfd = os.pidfd_open(pid)
    except ProcessLookupError:
        yield None
        return
    try:
        yield pidfd if linux.started(pid) == start and run_of(pid) == run else None
    finally:
        os.close(pidfd)


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
    found = _MAPPED.search(mappings)
    return Path(found[1]) if found else None


def members() -> Iterator[Member]:
    """Every living process of this user that belongs to a run."""
    for pid in pids():
        start, run, state = linux.started(pid), run_of(pid), linux.state_of(pid)
        try:
            name = Path(f"/proc/{pid}/comm").read_text().rstrip("\n")
        except OSError:
            continue
        if run is not None and state not in ("", "X", "Z") and linux.started(pid) == start:
            yield Member(str(run), pid, start, name, state)


def held(removed: Path) -> bool:
    """Whether a process has the directory open that was removed from that place."""
    for pid in pids():
        with contextlib.suppress(OSError):
            for descriptor in os.scandir(f"/proc/{pid}/fd"):
                with contextlib.suppress(OSError):  # closed meanwhile
                    if str(Path(descriptor).readlink()) == f"{removed} (deleted)":
                        return True
    return False


def pids() -> Iterator[int]:
    """Of the processes of this user."""
    for entry in os.scandir("/proc"):
        with contextlib.suppress(OSError):
            if entry.name.isdigit() and entry.stat().st_uid == os.getuid():
                yield int(entry.name)

"""Where a run lives: a private directory with its control socket, and the directory of its record.

The private one is `$XDG_RUNTIME_DIR/aftbed/ID` or `/tmp/aftbed-UID/ID`, mode 0700; it goes with the
run. Without `--record` the record lives, and goes, inside it.

It belongs to the process that made it, the command, and is locked by it (flock(2)) from the first moment
on: the kernel lets go of the lock with that process, so whether a run has an owner is never a guess. The
lock is not inherited: whatever else descends from the command, of this run or of another, lets go of it.
"""

import contextlib
import fcntl
import os
import secrets
import shutil
import socket
import stat
import time
from pathlib import Path
from typing import Final

from aftbed.core.errors import ConfigError, HarnessError

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

"""What dead runs have left behind, and its removal.

A run is alive while the command that made it lives: only that one can hold the lock of the run's
directory (`runtime.unix.rundir`). Its supervisor or its warden alone make no run; stopped, they are what
a run can leave at worst, with all their nodes. Nothing is told by a name: a process is one of a run by
its mark (`runtime.unix.members`), a directory by lying where runs of this user lie and having no owner.

Whatever dies, the rest of a run has a second to go (G7). So what is found is looked at again until that
second has passed, and only what stays is reported: a run that is just beginning or just ending is not.

Looked at are the runs of this user below this `XDG_RUNTIME_DIR` (or `TMPDIR`, or `/tmp`). A run has no
other files than those in its directory, and its record. What it shares in memory are memfds, which the
kernel removes with the last process that holds them; so is a port with the hub.
"""

import os
import re
import shutil
import stat
import time
from pathlib import Path
from typing import Final

import msgspec

from aftbed.runtime.unix import members, rundir

GONE_SECONDS_MAX: Final = 1.0  # G7
LOOK_SECONDS: Final = 0.05
END_SECONDS_MAX: Final = 1.0  # of a process that was killed
ROUNDS_MAX: Final = 3  # a process may have started another while it was being killed
_RUN: Final = re.compile(rf"[0-9a-f]{{{2 * rundir.ID_BYTES}}}")


class LeftProcess(msgspec.Struct, frozen=True, tag="process", tag_field="kind"):
    """A process of a dead run; `state` as in proc(5), `T` being stopped."""

    run: str
    pid: int
    start: int
    name: str
    state: str

    def __str__(self) -> str:
        stopped = ", stopped" if self.state == "T" else ""
        return f"process {self.pid} ({self.name}{stopped}) of run {Path(self.run).name}"


class LeftDirectory(msgspec.Struct, frozen=True, tag="directory", tag_field="kind"):
    """The private directory of a dead run, with its record if that was not to be kept."""

    run: str
    sockets: int
    files: int
    bytes_used: int

    def __str__(self) -> str:
        sockets = f"{self.sockets} socket{'s' * (self.sockets != 1)}"
        return f"directory {self.run} ({sockets}, {self.files} files, {self.bytes_used / 1e6:.1f} MB)"


Left = LeftProcess | LeftDirectory


def find() -> list[Left]:
    """What dead runs have left, processes first; a run that ends meanwhile is given its second."""
    limit = time.monotonic() + GONE_SECONDS_MAX
    found = _look()
    while found and time.monotonic() < limit:
        time.sleep(LOOK_SECONDS)  # many processes and directories: no event tells of all of them
        found = _look()
    return found


def clean(found: list[Left]) -> tuple[list[Left], list[Left]]:
    """Remove what was found, unless its run is alive; what is removed, and what could not be."""
    removed: list[Left] = []
    for _ in range(ROUNDS_MAX):
        for left in found:
            if not _alive(Path(left.run)) and _remove(left):
                removed.append(left)
        found = _look()
        if not found:
            break
    return removed, found


def _remove(left: Left) -> bool:
    match left:
        case LeftProcess():
            member = members.Member(left.pid, left.start, left.run, left.name, left.state)
            return member.end(END_SECONDS_MAX)
        case LeftDirectory():
            shutil.rmtree(left.run, ignore_errors=True)
            return not Path(left.run).exists()


def _look() -> list[Left]:
    root = rundir.root()
    belonging = [m for m in members.members() if Path(m.run).parent == root]
    there = {path for path in root.iterdir() if _is_run(path)}
    dead = {run for run in there | {Path(m.run) for m in belonging} if not _alive(run)}
    processes = [
        LeftProcess(m.run, m.pid, m.start, m.name, m.state) for m in belonging if Path(m.run) in dead
    ]
    return [*sorted(processes, key=lambda p: (p.run, p.pid)), *map(_directory, sorted(there & dead))]


def _is_run(path: Path) -> bool:
    """Whether it can be a run's: what else lies there is not ours."""
    try:
        state = path.lstat()
    except OSError:
        return False
    ours = stat.S_ISDIR(state.st_mode) and state.st_uid == os.getuid()
    return ours and _RUN.fullmatch(path.name) is not None


def _alive(run: Path) -> bool:
    """Whether its command lives, though somebody may have removed the directory of a run that goes on."""
    return rundir.owned(run) if run.exists() else members.held(run)


def _directory(run: Path) -> LeftDirectory:
    sockets = files = used = 0
    for folder, _, names in os.walk(run):
        for name in names:
            try:
                state = os.lstat(os.path.join(folder, name))  # noqa: PTH118 - os.walk speaks in strings
            except OSError:
                continue
            sockets, files = sockets + stat.S_ISSOCK(state.st_mode), files + stat.S_ISREG(state.st_mode)
            used += state.st_blocks * 512
    return LeftDirectory(str(run), sockets, files, used)

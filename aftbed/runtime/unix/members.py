"""Which processes belong to a run: told by a mark that they carry, never by their names.

The mark names the run's private directory. What a run executes anew (a zygote) and all that is forked
from it has it in its environment, `AFTBED_RUN`, which the kernel shows as it was at the exec. The
supervisor and the warden are forks of a command, whose environment is not the run's. So each has a page of
a memfd with the directory in its name mapped into its memory, and so has all that is forked from them,
whatever descriptors it closes. Nobody has either by accident, both outlive the directory itself, and both
go with the process.

A pid alone says nothing, since the kernel gives it to another process later. Together with the start time
of the process it does (proc(5), `starttime`): see `signalled`.
"""

import contextlib
import mmap
import os
import re
import select
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import msgspec

from aftbed.runtime.unix import linux

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

"""Undo that always runs: what a fault leaves behind is written down before it is done.

A process that was stopped stays stopped, whoever stopped it. So the supervisor writes into its ledger, a
file in the run's private directory, whom it is about to stop and until when; it wakes the warden; it stops
the process; and when it has let it go on, and seen it run, it writes that. If the supervisor does not come
to that, since it is dead or stopped itself, the warden does it in its place, some milliseconds after the
time: a process of its own, so a fault has an end even where its author has met his.

| who | when | does |
|---|---|---|
| supervisor | before SIGSTOP | `Stopped`, with the time it is due to be undone; 0: with the run |
| supervisor | after SIGCONT, the process seen running | `Undone` |
| warden | `LATE_NS_MAX` after that time, without an `Undone` | SIGCONT, seen running; `Undone`, an event |
| warden | at the end of the run | SIGKILL of what is still there |

Both strike through a pidfd, and only a process with the start time that was written and the mark of this
run (`runtime.unix.members`). A line is one write to a file opened for appending: it is there whole, or it
is the last one and torn, and is not read.
"""

import contextlib
import os
import signal
import time
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.errors import StepFailed
from aftbed.runtime.unix import members

LEDGER_NAME: Final = "undo"
LATE_NS_MAX: Final = 25_000_000  # a supervisor with a full hand is no dead one
SEEN_SECONDS_MAX: Final = 0.2
LOOK_SECONDS: Final = 0.001


class Stopped(msgspec.Struct, frozen=True, tag=True):
    """The process is about to get SIGSTOP; `due_ns` is monotonic, 0 for as long as the run lasts."""

    name: str
    pid: int
    start: int
    due_ns: int


class Undone(msgspec.Struct, frozen=True, tag=True):
    """It runs again, or it is gone; `by` the supervisor or the warden."""

    pid: int
    start: int
    by: str


Entry = Stopped | Undone
_decode: Final = msgspec.json.Decoder(Entry).decode


class Ledger:
    """What is to be undone, as the supervisor or the warden writes it; `waker` is the warden's eventfd."""

    def __init__(self, private: Path, waker: int, by: str = "supervisor") -> None:
        self._path, self._waker, self._by = private / LEDGER_NAME, waker, by

    def ahead(self, name: str, pid: int, for_ms: int) -> None:
        """Before SIGSTOP of `pid`, a child of this process. Raises StepFailed if it cannot be written."""
        due_ns = time.monotonic_ns() + for_ms * 1_000_000 if for_ms else 0
        try:
            self._write(Stopped(name, pid, members.started(pid), due_ns))
            os.eventfd_write(self._waker, 1)
        except OSError as error:
            raise StepFailed(f"{name} is not stopped: its undo cannot be written: {error.strerror}") from None

    def undone(self, pid: int) -> None:
        """`pid` has been seen running. Without this line the warden looks for itself."""
        self.closed(pid, members.started(pid))

    def closed(self, pid: int, start: int) -> None:
        """The same of a process that may be gone."""
        with contextlib.suppress(OSError):
            self._write(Undone(pid, start, self._by))

    def _write(self, entry: Entry) -> None:
        with open(self._path, "ab", buffering=0) as file:
            file.write(msgspec.json.encode(entry) + b"\n")


class Book:
    """The ledger as it is read: what is still to be undone, by process."""

    def __init__(self, private: Path) -> None:
        self._path, self._at = private / LEDGER_NAME, 0
        self.open: dict[tuple[int, int], Stopped] = {}

    def read(self) -> None:
        """Take in what has been written since the last call."""
        try:
            with open(self._path, "rb") as file:
                file.seek(self._at)
                found = file.read()
        except OSError:
            return  # nothing has been stopped yet
        whole = found[: found.rfind(b"\n") + 1]
        self._at += len(whole)
        for line in whole.splitlines():
            self.take(line)

    def take(self, line: bytes) -> None:
        """One line; what is none is not believed."""
        try:
            entry = _decode(line)
        except msgspec.MsgspecError:
            return
        key = (entry.pid, entry.start)
        if isinstance(entry, Undone):
            self.open.pop(key, None)
            return
        earlier = self.open.get(key)
        if earlier is None or (earlier.due_ns and (not entry.due_ns or entry.due_ns > earlier.due_ns)):
            self.open[key] = entry  # stopped twice: the longer one counts

    def overdue(self, now_ns: int) -> list[Stopped]:
        """What the supervisor should have undone by now."""
        return [s for s in self.open.values() if s.due_ns and s.due_ns + LATE_NS_MAX <= now_ns]

    def patience_ms(self, now_ns: int) -> float | None:
        """How long until something is overdue; None where nothing will be."""
        dues = [s.due_ns + LATE_NS_MAX - now_ns for s in self.open.values() if s.due_ns]
        return max(0.0, min(dues) / 1e6) if dues else None


class Ending(Enum):
    """What became of a process that was to be let go on."""

    GONE = "was gone"
    RAN = "ran already"
    THAWED = "thawed"
    STUCK = "does not go on"


def thaw(stopped: Stopped, private: Path) -> Ending:
    """Let the very process that was stopped go on, if it is of the run in `private`, and see it run."""
    if members.started(stopped.pid) != stopped.start:
        return Ending.GONE
    if members.state_of(stopped.pid) != "T":
        return Ending.RAN
    if not members.signalled(stopped.pid, stopped.start, private, signal.SIGCONT):
        return Ending.GONE
    return Ending.THAWED if _seen_running(stopped.pid) else Ending.STUCK


def _seen_running(pid: int) -> bool:
    limit = time.monotonic() + SEEN_SECONDS_MAX
    while members.state_of(pid) == "T":
        if time.monotonic() > limit:
            return False
        time.sleep(LOOK_SECONDS)  # the end of a stop is an event for the parent alone
    return True


def undo_overdue(book: Book, ledger: Ledger, private: Path) -> Iterator[str]:
    """Undo what the supervisor did not; what was done, for people."""
    now_ns = time.monotonic_ns()
    for stopped in book.overdue(now_ns):
        ending = thaw(stopped, private)
        del book.open[stopped.pid, stopped.start]
        if ending is not Ending.STUCK:
            ledger.closed(stopped.pid, stopped.start)
        if ending in (Ending.THAWED, Ending.STUCK):
            late_ms = (now_ns - stopped.due_ns) / 1e6
            yield f"{stopped.name} ({stopped.pid}), stopped {late_ms:.0f} ms over its time: {ending.value}"


def kill_open(book: Book, private: Path) -> None:
    """The run has ended: what was stopped with it, and is still there, ends too."""
    for stopped in book.open.values():
        members.signalled(stopped.pid, stopped.start, private, signal.SIGKILL)

"""Nothing of a run outlives it: faults are undone, and what dead runs left is found and removed.

*Undo.* A process that was stopped stays stopped, so a stop is written down before it is made. The ledger is a
file in the run's private directory:

| process | when | does |
|---|---|---|
| supervisor | before SIGSTOP | writes `Stopped`, with the time at which it is to be undone; 0: with the run |
| supervisor | after SIGCONT, once the process was seen running | writes `Undone` |
| warden | `LATE_NS_MAX` after that time, without an `Undone` | SIGCONT; seen running: `Undone`, an event |
| warden | at the end of the run | SIGKILL of what is still there |

Both act through a pidfd, and only on a process with the start time that was written and the mark of this
run (`runtime.unix.run_directory`). A line is one write to a file opened for appending: it is there whole,
or it is the last one, torn, and is not read.

*Leftovers* of dead runs are what `aftbed doctor` finds. *The warden* is the process that undoes, kills and
removes if the supervisor and the command of its run do not.
"""

import contextlib
import json
import os
import re
import select
import shutil
import signal
import stat
import time
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import Final, NoReturn

import msgspec

from aftbed.core.errors import StepFailed
from aftbed.runtime.unix import linux, run_directory

LEDGER_NAME: Final = "undo"
LATE_NS_MAX: Final = 25_000_000  # a supervisor with a full hand is no dead one
SEEN_SECONDS_MAX: Final = 0.2
LOOK_SECONDS: Final = 0.001


class StoppedProcess(msgspec.Struct, frozen=True, tag=True):
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


Entry = StoppedProcess | Undone
_decode: Final = msgspec.json.Decoder(Entry).decode


class UndoLedger:
    """What is to be undone, as the supervisor or the warden writes it; `waker` is the warden's eventfd."""

    def __init__(self, private: Path, waker: int, by: str = "supervisor") -> None:
        self._path, self._waker, self._by = private / LEDGER_NAME, waker, by

    def ahead(self, name: str, pid: int, for_ms: int) -> None:
        """Before SIGSTOP of `pid`, a child of this process. Raises StepFailed if it cannot be written."""
        due_ns = time.monotonic_ns() + for_ms * 1_000_000 if for_ms else 0
        try:
            self._write(StoppedProcess(name, pid, run_directory.started(pid), due_ns))
            os.eventfd_write(self._waker, 1)
        except OSError as error:
            raise StepFailed(f"{name} is not stopped: its undo cannot be written: {error.strerror}") from None

    def undone(self, pid: int) -> None:
        """`pid` has been seen running. Without this line the warden looks for itself."""
        self.closed(pid, run_directory.started(pid))

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
        self.open: dict[tuple[int, int], StoppedProcess] = {}

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

    def overdue(self, now_ns: int) -> list[StoppedProcess]:
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


def thaw(stopped: StoppedProcess, private: Path) -> Ending:
    """Let the very process that was stopped go on, if it is of the run in `private`, and see it run."""
    if run_directory.started(stopped.pid) != stopped.start:
        return Ending.GONE
    if run_directory.state_of(stopped.pid) != "T":
        return Ending.RAN
    if not run_directory.signalled(stopped.pid, stopped.start, private, signal.SIGCONT):
        return Ending.GONE
    return Ending.THAWED if _seen_running(stopped.pid) else Ending.STUCK


def _seen_running(pid: int) -> bool:
    limit = time.monotonic() + SEEN_SECONDS_MAX
    while run_directory.state_of(pid) == "T":
        if time.monotonic() > limit:
            return False
        time.sleep(LOOK_SECONDS)  # the end of a stop is an event for the parent alone
    return True


def undo_overdue(book: Book, ledger: UndoLedger, private: Path) -> Iterator[str]:
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
        run_directory.signalled(stopped.pid, stopped.start, private, signal.SIGKILL)


# -- Leftovers of dead runs, and their removal.
#
# A run is alive while the command that made it lives: only that one can hold the lock of the run's directory.
# A process belongs to a run by its mark, never by a name; a directory, by lying where runs of this user lie
# and having no owner.
#
# Whatever dies, the rest of a run has a second to go (G7). So what is found is looked at again until that
# second has passed, and only what stays is reported: a run that is just beginning or just ending is not.
#
# Searched are the runs of this user below this `XDG_RUNTIME_DIR` (or `TMPDIR`, or `/tmp`). A run has no other
# files than those in its directory, and its record. What it shares in memory are memfds, which the kernel
# removes with the last process that holds them.


GONE_SECONDS_MAX: Final = 1.0  # G7
LEFTOVER_LOOK_SECONDS: Final = 0.05
END_SECONDS_MAX: Final = 1.0  # of a process that was killed
ROUNDS_MAX: Final = 3  # a process may have started another while it was being killed
_RUN: Final = re.compile(rf"[0-9a-f]{{{2 * run_directory.ID_BYTES}}}")


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
        time.sleep(LEFTOVER_LOOK_SECONDS)  # many processes and directories: no event tells of all of them
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
            member = run_directory.Member(left.pid, left.start, left.run, left.name, left.state)
            return member.end(END_SECONDS_MAX)
        case LeftDirectory():
            shutil.rmtree(left.run, ignore_errors=True)
            return not Path(left.run).exists()


def _look() -> list[Left]:
    root = run_directory.root()
    belonging = [m for m in run_directory.members() if Path(m.run).parent == root]
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
    return run_directory.owned(run) if run.exists() else run_directory.held(run)


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


# -- The warden.
#
# The supervisor cleans up after the command, and the command after the supervisor. If both die, or if one
# dies while the other is stopped, the warden does it. It is a small process, forked first, that waits for
# the ends of two pipes, and for what the supervisor has promised to undo and has not.


GRACE_SECONDS: Final = 0.6  # G7 allows a second in all


class Watched(msgspec.Struct, frozen=True):
    """A run, and what its warden holds of it: reading ends of pipes, a pidfd, an eventfd."""

    private: Path
    record: Path
    started_ns: int
    command_end: int
    supervisor_end: int
    supervisor_pidfd: int
    waker: int


def watch(run: Watched) -> NoReturn:
    """Wait until command and supervisor are gone; kill a supervisor that outlives its command."""
    linux.set_name("aftbed-warden")
    run_directory.mark(run.private)
    book = Book(run.private)
    _undo_until_command_ends(run, book)
    rest = select.poll()
    rest.register(run.supervisor_end, 0)
    if not rest.poll(GRACE_SECONDS * 1e3):
        linux.kill(run.supervisor_pidfd, signal.SIGKILL)
        rest.poll(GRACE_SECONDS * 1e3)
    kill_open(book, run.private)
    run_directory.remove(run.private)
    os._exit(0)


def _undo_until_command_ends(run: Watched, book: Book) -> None:
    poll = select.poll()
    poll.register(run.command_end, 0)  # only POLLHUP: nothing is ever written
    poll.register(run.waker, select.POLLIN)
    ledger = UndoLedger(run.private, run.waker, "warden")
    while True:
        ready = {fd for fd, _ in poll.poll(book.patience_ms(time.monotonic_ns()))}
        if run.waker in ready:
            os.eventfd_read(run.waker)
        book.read()
        for done in undo_overdue(book, ledger, run.private):
            _tell(run, done)
        if run.command_end in ready:
            return


def _tell(run: Watched, text: str) -> None:
    """An event in the record, beside those of the supervisor."""
    t_ms = round((time.monotonic_ns() - run.started_ns) / 1e6, 3)
    line = json.dumps({"t_ms": t_ms, "event": "undone", "text": f"by the warden: {text}"})
    try:
        with open(run.record / "events.jsonl", "ab", buffering=0) as file:
            file.write(line.encode() + b"\n")
    except OSError:
        return  # the undo counts, not the word of it

"""Nothing of a run outlives it: faults are undone, and what dead runs left is found and removed.

*Undo.* A process that was stopped stays stopped, so a stop is written down before it is made. The ledger is a
file in the run's private directory:

| process | when | does |
|---|---|---|
| supervisor | before SIGSTOP | writes `StoppedProcess`, with the time when it is to be undone; 0: never |
| supervisor | after SIGCONT, once the process was seen running | writes `Undone` |
| warden | `LATE_NS_MAX` after that time, without an `Undone` | SIGCONT; seen running: `Undone`, an event |
| warden | at the end of the run | SIGKILL of what is still stopped |

Both act through a pidfd, and only on a process with the start time that was written and the mark of this
run (`runtime.unix.run_directory`). A line is one write to a file opened for appending: it is complete, or
it is the last one, torn, and is not read.

*The warden* is a small process that is forked before anything of the run exists. The supervisor cleans up
after the command, and the command after the supervisor. If both die, or if one dies while the other is
stopped, the warden does it. A supervisor or warden that is stopped when the command dies is continued by the
kernel (`PR_SET_PDEATHSIG`), and does its part.

*Leftovers* of dead runs are what `aftbed doctor` finds.
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
from aftbed.runtime.unix.run_directory import Member

LEDGER_NAME: Final = "undo"
LATE_NS_MAX: Final = 25_000_000  # that a busy supervisor may be late
SEEN_SECONDS_MAX: Final = 0.2
POLL_SECONDS: Final = 0.001
GRACE_SECONDS: Final = 0.6  # for a supervisor without a command, then for its death; G7 allows 1 s in all

GONE_SECONDS_MAX: Final = 1.0  # G7
LEFTOVER_POLL_SECONDS: Final = 0.05
END_SECONDS_MAX: Final = 1.0  # of a process that was killed
ROUNDS_MAX: Final = 3  # a process may have started another one while it was being killed
_RUN: Final = re.compile(rf"[0-9a-f]{{{2 * run_directory.ID_BYTES}}}")


# -- the ledger -----------------------------------------------------------------------------------


class StoppedProcess(msgspec.Struct, frozen=True, tag="Stopped"):
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
decode_entry: Final = msgspec.json.Decoder(Entry).decode


class UndoLedger:
    """The ledger as the supervisor or the warden writes it; `waker` is the warden's eventfd."""

    def __init__(self, private: Path, waker: int, by: str = "supervisor") -> None:
        self._path, self._waker, self._by = private / LEDGER_NAME, waker, by

    def ahead(self, name: str, pid: int, for_ms: int) -> None:
        """Record that `pid`, a child of this process, is about to get SIGSTOP. Raises StepFailed if it
        cannot be written.
        """
        due_ns = time.monotonic_ns() + for_ms * 1_000_000 if for_ms else 0
        try:
            self._write(StoppedProcess(name, pid, linux.started(pid), due_ns))
            os.eventfd_write(self._waker, 1)
        except OSError as error:
            raise StepFailed(f"{name} is not stopped: its undo cannot be written: {error.strerror}") from None

    def undone(self, pid: int, start: int | None = None) -> None:
        """Record that `pid` was seen running, or gone. Without this line the warden acts."""
        with contextlib.suppress(OSError):
            self._write(Undone(pid, linux.started(pid) if start is None else start, self._by))

    def _write(self, entry: Entry) -> None:
        with open(self._path, "ab", buffering=0) as file:
            file.write(msgspec.json.encode(entry) + b"\n")


class LedgerReader:
    """The entries that are still to be undone, by process."""

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
        """Read one line; a line that is no entry is skipped."""
        try:
            entry = decode_entry(line)
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
        """The entries that the supervisor should have undone by `now_ns`."""
        return [s for s in self.open.values() if s.due_ns and s.due_ns + LATE_NS_MAX <= now_ns]

    def patience_ms(self, now_ns: int) -> float | None:
        """Time until an entry is overdue, in ms; None if there is none."""
        dues = [s.due_ns + LATE_NS_MAX - now_ns for s in self.open.values() if s.due_ns]
        return max(0.0, min(dues) / 1e6) if dues else None


class ThawOutcome(Enum):
    """What became of a process that was to be continued."""

    GONE = "was gone"
    RAN = "ran already"
    THAWED = "thawed"
    STUCK = "does not go on"


def thaw(stopped: StoppedProcess, private: Path) -> ThawOutcome:
    """Continue the stopped process, if it belongs to the run in `private`, and check that it runs."""
    if linux.started(stopped.pid) != stopped.start:
        return ThawOutcome.GONE
    if linux.state_of(stopped.pid) != "T":
        return ThawOutcome.RAN
    if not run_directory.signalled(stopped.pid, stopped.start, private, signal.SIGCONT):
        return ThawOutcome.GONE
    limit = time.monotonic() + SEEN_SECONDS_MAX
    while linux.state_of(stopped.pid) == "T":
        if time.monotonic() > limit:
            return ThawOutcome.STUCK
        time.sleep(POLL_SECONDS)  # the end of a stop is an event for the parent alone
    return ThawOutcome.THAWED


def undo_overdue(reader: LedgerReader, ledger: UndoLedger, private: Path) -> Iterator[str]:
    """Undo what the supervisor did not undo; yields what was done, for people."""
    now_ns = time.monotonic_ns()
    for stopped in reader.overdue(now_ns):
        outcome = thaw(stopped, private)
        del reader.open[stopped.pid, stopped.start]
        if outcome is not ThawOutcome.STUCK:
            ledger.undone(stopped.pid, stopped.start)
        if outcome in (ThawOutcome.THAWED, ThawOutcome.STUCK):
            late_ms = (now_ns - stopped.due_ns) / 1e6
            yield f"{stopped.name} ({stopped.pid}), stopped {late_ms:.0f} ms over its time: {outcome.value}"


def kill_open(reader: LedgerReader, private: Path) -> None:
    """Kill what is still stopped after the run has ended."""
    for stopped in reader.open.values():
        run_directory.signalled(stopped.pid, stopped.start, private, signal.SIGKILL)


# -- the warden -----------------------------------------------------------------------------------


def watch(
    *,
    private: Path,
    record: Path,
    started_ns: int,
    command_end: int,
    supervisor_end: int,
    supervisor_pidfd: int,
    waker: int,
) -> NoReturn:
    """Be the warden of a run: undo what is overdue until its command is gone, then end what is left.

    It has the reading ends of two pipes, a pidfd and an eventfd.
    """
    linux.set_name("aftbed-warden")
    run_directory.mark(private)
    reader, ledger = LedgerReader(private), UndoLedger(private, waker, "warden")
    poll, ready = select.poll(), set[int]()
    poll.register(command_end, 0)  # only POLLHUP: nothing is ever written
    poll.register(waker, select.POLLIN)
    while command_end not in ready:
        ready = {fd for fd, _ in poll.poll(reader.patience_ms(time.monotonic_ns()))}
        if waker in ready:
            os.eventfd_read(waker)
        reader.read()
        for done in undo_overdue(reader, ledger, private):
            _record_undo(record, started_ns, done)
    supervisor = select.poll()
    supervisor.register(supervisor_end, 0)
    if not supervisor.poll(GRACE_SECONDS * 1e3):
        linux.kill(supervisor_pidfd, signal.SIGKILL)
        supervisor.poll(GRACE_SECONDS * 1e3)
    kill_open(reader, private)
    run_directory.remove(private)
    os._exit(0)


def _record_undo(record: Path, started_ns: int, text: str) -> None:
    """An event in the record, beside those of the supervisor."""
    t_ms = round((time.monotonic_ns() - started_ns) / 1e6, 3)
    line = json.dumps({"t_ms": t_ms, "event": "undone", "text": f"by the warden: {text}"})
    with (
        contextlib.suppress(OSError),  # the undo counts, not its record
        open(record / run_directory.EVENT_LOG_NAME, "ab", buffering=0) as file,
    ):
        file.write(line.encode() + b"\n")


# -- leftovers of dead runs -----------------------------------------------------------------------
#
# A run is alive while the command that made it lives: no other process can hold the lock of its directory. A
# process belongs to a run by its mark, never by a name; a directory, by its place among those of this user's
# runs. Searched are the runs of this user below this `XDG_RUNTIME_DIR` (or where they lie without it).
#
# After any death the rest of a run has a second to end (G7). So what is found is looked at again until that
# second has passed, and only what stays is reported: no run that is just beginning or ending.
#
# A run has no other files than those in its directory, and its record. What it shares in memory are memfds,
# which the kernel removes with the last process that has them. A judge, or a simulation, unpacks an FMU
# elsewhere (`functions.fmu`): the lock of that directory says whether its process lives.


class LeftDirectory(msgspec.Struct, frozen=True, tag="directory", tag_field="kind"):
    """The private directory of a dead run, with its record if that was not to be kept."""

    run: str
    sockets: int
    files: int
    bytes_used: int

    def __str__(self) -> str:
        sockets = f"{self.sockets} socket{'s' * (self.sockets != 1)}"
        return f"directory {self.run} ({sockets}, {self.files} files, {self.bytes_used / 1e6:.1f} MB)"


class LeftModel(msgspec.Struct, frozen=True, tag="model", tag_field="kind"):
    """An FMU that a dead process had unpacked."""

    run: str
    bytes_used: int

    def __str__(self) -> str:
        return f"model {self.run} ({self.bytes_used / 1e6:.1f} MB)"


Left = Member | LeftDirectory | LeftModel


def find() -> list[Left]:
    """What dead runs have left, processes first; a run that is just ending gets one second."""
    limit = time.monotonic() + GONE_SECONDS_MAX
    found = _leftovers()
    while found and time.monotonic() < limit:
        time.sleep(LEFTOVER_POLL_SECONDS)  # many processes and directories: no event announces all of them
        found = _leftovers()
    return found


def clean(found: list[Left]) -> tuple[list[Left], list[Left]]:
    """Remove what was found, unless its run is alive; what is removed, and what could not be."""
    removed: list[Left] = []
    for _ in range(ROUNDS_MAX):
        removed += [left for left in found if not _alive(Path(left.run)) and _remove(left)]
        found = _leftovers()
        if not found:
            break
    return removed, found


def _remove(left: Left) -> bool:
    match left:
        case Member():
            return left.end(END_SECONDS_MAX)
        case LeftModel(run):
            from aftbed.functions.fmu import remove_dead  # noqa: PLC0415 - no run needs it

            return remove_dead(Path(run))
        case LeftDirectory(run):
            shutil.rmtree(run, ignore_errors=True)
            return not Path(run).exists()


def _leftovers() -> list[Left]:
    root = run_directory.root()
    members = [m for m in run_directory.members() if Path(m.run).parent == root]
    directories = {path for path in root.iterdir() if _is_run(path)}
    dead = {run for run in directories | {Path(m.run) for m in members} if not _alive(run)}
    processes = [m for m in members if Path(m.run) in dead]
    return [
        *sorted(processes, key=lambda p: (p.run, p.pid)),
        *map(_directory, sorted(directories & dead)),
        *_models(),
    ]


def _models() -> list[LeftModel]:
    from aftbed.functions.fmu import left_behind  # noqa: PLC0415 - no run needs it

    return [LeftModel(str(path), _directory(path).bytes_used) for path in left_behind()]


def _is_run(path: Path) -> bool:
    """Whether `path` can be the directory of a run: the folder may hold other things."""
    try:
        state = path.lstat()
    except OSError:
        return False
    ours = stat.S_ISDIR(state.st_mode) and state.st_uid == os.getuid()
    return ours and _RUN.fullmatch(path.name) is not None


def _alive(run: Path) -> bool:
    """Whether the run's command lives, even if the directory of the run was removed."""
    return run_directory.owned(run) if run.exists() else run_directory.held(run)


def _directory(run: Path) -> LeftDirectory:
    sockets = files = used = 0
    for folder, _, names in os.walk(run):
        for name in names:
            try:
                state = os.lstat(os.path.join(folder, name))  # noqa: PTH118 - os.walk gives strings
            except OSError:
                continue
            sockets, files = sockets + stat.S_ISSOCK(state.st_mode), files + stat.S_ISREG(state.st_mode)
            used += state.st_blocks * 512
    return LeftDirectory(str(run), sockets, files, used)

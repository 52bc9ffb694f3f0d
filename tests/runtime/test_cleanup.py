"""The ledger of what is to be undone: what is read in it, when it is due, and on which processes it acts."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.core.errors import StepFailed
from aftbed.runtime.unix import cleanup, linux, run_directory
from aftbed.runtime.unix.cleanup import (
    LATE_NS_MAX,
    LedgerReader,
    StoppedProcess,
    ThawOutcome,
    UndoLedger,
    Undone,
)

MS = 1_000_000


def book_of(*entries: cleanup.Entry) -> LedgerReader:
    book = LedgerReader(Path("nowhere"))
    for entry in entries:
        book.take(msgspec.json.encode(entry))
    return book


def stopped(due_ms: int, pid: int = 7, start: int = 1) -> StoppedProcess:
    return StoppedProcess("a/server", pid, start, due_ms * MS)


@pytest.fixture
def waker() -> Iterator[int]:
    descriptor = os.eventfd(0)
    yield descriptor
    os.close(descriptor)


# -- what is read


def test_what_was_undone_is_not_due(tmp_path: Path, waker: int) -> None:
    ledger, book = UndoLedger(tmp_path, waker), LedgerReader(tmp_path)
    book.read()
    assert book.open == {}, "nothing has been written yet"
    me, start = os.getpid(), linux.started(os.getpid())
    before_ns = time.monotonic_ns()
    ledger.ahead("a/server", me, 50)
    assert os.eventfd_read(waker) == 1, "the warden is woken"
    book.read()
    found = book.open[me, start]
    assert found.name == "a/server" and before_ns + 50 * MS <= found.due_ns <= time.monotonic_ns() + 50 * MS
    ledger.undone(me)
    book.read()
    assert book.open == {}


def test_the_later_of_two_ends_counts() -> None:
    def due(*entries: cleanup.Entry) -> list[int]:
        return [entry.due_ns // MS for entry in book_of(*entries).open.values()]

    assert due(stopped(100), stopped(30)) == due(stopped(30), stopped(100)) == [100]
    assert due(stopped(100), stopped(0)) == due(stopped(0), stopped(100)) == [0], "for good is the latest"
    assert due(stopped(100), Undone(7, 1, "supervisor"), stopped(30)) == [30]


def test_another_process_with_the_same_pid_is_another() -> None:
    book = book_of(stopped(100, start=1), stopped(200, start=2), Undone(7, 1, "supervisor"))
    assert list(book.open) == [(7, 2)]


def test_it_is_overdue_when_the_supervisor_had_its_time() -> None:
    book = book_of(stopped(100), stopped(0, pid=8), stopped(500, pid=9))
    edge_ns = 100 * MS + LATE_NS_MAX
    assert book.overdue(edge_ns - 1) == []
    assert [s.pid for s in book.overdue(edge_ns)] == [7]
    assert book.patience_ms(100 * MS) == LATE_NS_MAX / MS
    assert book.patience_ms(edge_ns + 5) == 0.0


def test_what_lasts_as_long_as_the_run_wakes_no_process() -> None:
    assert book_of().patience_ms(0) is None
    assert book_of(stopped(0)).patience_ms(10**18) is None
    assert book_of(stopped(0)).overdue(10**18) == []


def test_a_torn_line_is_read_when_it_is_whole(tmp_path: Path) -> None:
    line = msgspec.json.encode(stopped(100)) + b"\n"
    book = LedgerReader(tmp_path)
    with open(tmp_path / cleanup.LEDGER_NAME, "ab", buffering=0) as file:
        file.write(line[:20])
        book.read()
        assert book.open == {}
        file.write(line[20:] + line[:5])
        book.read()
    assert list(book.open) == [(7, 1)]


@given(st.binary())
def test_no_line_ends_the_warden(line: bytes) -> None:
    book = book_of(stopped(100))
    book.take(line)
    assert (7, 1) in book.open


@given(st.lists(st.tuples(st.booleans(), st.integers(1, 3), st.integers(0, 5))))
def test_open_is_what_was_stopped_since_its_last_undo(steps: list[tuple[bool, int, int]]) -> None:
    book, expected = book_of(), dict[int, list[int]]()
    for stops, pid, due_ms in steps:
        entry = stopped(due_ms, pid) if stops else Undone(pid, 1, "warden")
        book.take(msgspec.json.encode(entry))
        expected[pid] = [*expected.get(pid, []), due_ms] if stops else []
    wanted = {pid: 0 if 0 in dues else max(dues) for pid, dues in expected.items() if dues}
    assert {pid: s.due_ns // MS for (pid, _), s in book.open.items()} == wanted


def test_what_cannot_be_written_is_not_done(tmp_path: Path, waker: int) -> None:
    ledger = UndoLedger(tmp_path / "gone", waker)
    message = "a/server is not stopped: its undo cannot be written: No such file or directory"
    with pytest.raises(StepFailed, match=message):
        ledger.ahead("a/server", os.getpid(), 50)


# -- on which processes it acts


Victim = Callable[[Path | None], StoppedProcess]


@pytest.fixture
def victim() -> Iterator[Victim]:
    """Starts a process, of a run or of none, and stops it."""
    started: list[subprocess.Popen[bytes]] = []

    def start(run: Path | None) -> StoppedProcess:
        words = [sys.executable, "-c", "print(flush=True); input()"]
        environment = os.environ | ({run_directory.VARIABLE: str(run)} if run else {})
        process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment)
        started.append(process)
        assert process.stdout is not None and process.stdout.readline() == b"\n"
        os.kill(process.pid, signal.SIGSTOP)
        os.waitid(os.P_PID, process.pid, os.WSTOPPED)
        return StoppedProcess("a/server", process.pid, linux.started(process.pid), 1)

    yield start
    for process in started:
        process.kill()
        process.communicate()


@pytest.mark.process
def test_a_stopped_process_of_the_run_goes_on(tmp_path: Path, victim: Victim) -> None:
    found = victim(tmp_path)
    assert cleanup.thaw(found, tmp_path) is ThawOutcome.THAWED
    assert linux.state_of(found.pid) != "T"
    assert cleanup.thaw(found, tmp_path) is ThawOutcome.RAN


@pytest.mark.process
def test_a_process_of_another_run_or_of_none_is_not_touched(tmp_path: Path, victim: Victim) -> None:
    for found in (victim(tmp_path / "another"), victim(None)):
        assert cleanup.thaw(found, tmp_path) is ThawOutcome.GONE
        cleanup.kill_open(book_of(found), tmp_path)
        assert linux.state_of(found.pid) == "T"


@pytest.mark.process
def test_a_process_that_got_the_pid_later_is_not_touched(tmp_path: Path, victim: Victim) -> None:
    found = victim(tmp_path)
    earlier = msgspec.structs.replace(found, start=found.start - 1)
    assert cleanup.thaw(earlier, tmp_path) is ThawOutcome.GONE
    cleanup.kill_open(book_of(earlier), tmp_path)
    assert linux.state_of(found.pid) == "T"


@pytest.mark.process
def test_what_is_overdue_is_undone_once_and_told(tmp_path: Path, victim: Victim, waker: int) -> None:
    found = victim(tmp_path)
    book = book_of(found)
    told = list(cleanup.undo_overdue(book, UndoLedger(tmp_path, waker, "warden"), tmp_path))
    assert len(told) == 1 and told[0].startswith(f"a/server ({found.pid}), stopped ")
    assert told[0].endswith(" ms over its time: thawed")
    assert book.open == {}
    line = (tmp_path / cleanup.LEDGER_NAME).read_bytes()
    assert cleanup.decode_entry(line) == Undone(found.pid, found.start, "warden")


@pytest.mark.process
def test_what_is_stopped_for_good_ends_with_its_run(tmp_path: Path, victim: Victim) -> None:
    found = victim(tmp_path)
    cleanup.kill_open(book_of(found), tmp_path)
    ending = os.waitid(os.P_PID, found.pid, os.WEXITED | os.WNOWAIT)
    assert ending is not None and ending.si_status == signal.SIGKILL

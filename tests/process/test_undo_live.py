"""Undo that always runs: what a fault stopped goes on in time, whoever else dies or is stopped meanwhile."""

import signal
import time
from pathlib import Path
from typing import Final

import pytest
from liveruns import ENDLESS, GONE_SECONDS_MAX, Home, Started, state_of, under_load, until

from aftbed.inject.grammar import Trigger
from aftbed.inject.hang import Hang
from aftbed.inject.model import Fault
from aftbed.runtime.unix import cleanup, control_client, linux
from aftbed.runtime.unix.options import LoadRun

pytestmark = pytest.mark.process

FOR_MS: Final = 200
BUSY_SECONDS: Final = 0.15  # what a machine with something else to do may add


def hang(target: str, for_ms: int = 0) -> control_client.InjectCommand:
    return control_client.InjectCommand(Fault(Hang(for_ms), target, Trigger()))


def entries(run: Started) -> list[cleanup.Entry]:
    """The ledger of the run, line by line."""
    lines = (run.private / cleanup.LEDGER_NAME).read_bytes().splitlines()
    return [cleanup.decode_entry(line) for line in lines]


def test_a_stop_is_written_before_it_is_done_and_its_undo_behind_it(home: Home) -> None:
    with under_load(home, ENDLESS) as run:
        pid = run.pid("engine")
        began_ns = time.monotonic_ns()
        control_client.ask(run.private, hang("engine", 60))
        stopped, state, now_ns = entries(run), state_of(pid), time.monotonic_ns()
        assert isinstance(stopped[0], cleanup.StoppedProcess)
        assert (state == "T" and len(stopped) == 1) or now_ns >= stopped[0].due_ns
        assert (stopped[0].name, stopped[0].pid, stopped[0].start) == (
            "engine",
            pid,
            linux.started(pid),
        )
        assert began_ns + 60e6 <= stopped[0].due_ns <= time.monotonic_ns() + 60e6
        # Where a busy machine makes the supervisor late, the warden has undone it before. Where both are
        # late, the node has been found to hang, and replaced.
        undone = [cleanup.Undone(pid, stopped[0].start, by) for by in ("supervisor", "warden")]
        until(lambda: any(one in entries(run)[1:] for one in undone), "the undo")
        assert state_of(pid) != "T"
        assert run.stop().verdict.verdict == "pass"


def test_what_a_stopped_supervisor_stopped_is_thawed_by_the_warden_in_time(home: Home) -> None:
    with under_load(home, ENDLESS) as run:
        pid = run.pid("engine")
        began = time.monotonic()
        control_client.ask(run.private, hang("engine", FOR_MS))
        run.strike("supervisor", signal.SIGSTOP)
        assert state_of(pid) == "T"
        until(lambda: state_of(pid) != "T", "the stopped node to go on")
        seconds = time.monotonic() - began
        assert FOR_MS / 1e3 <= seconds < FOR_MS / 1e3 + cleanup.LATE_NS_MAX / 1e9 + BUSY_SECONDS
        assert state_of(run.launched.supervisor) == "T"
        until(lambda: len(entries(run)) == 2, "the word of it")
        assert entries(run)[1] == cleanup.Undone(pid, linux.started(pid), "warden")
        run.strike("supervisor", signal.SIGCONT)
        assert run.pid("engine") == pid
        events = run.launched.record / "events.jsonl"
        told = f"by the warden: engine ({pid}), stopped"  # written behind the ledger
        until(lambda: told in events.read_text(), "the event of it")
        assert run.stop().verdict.verdict == "pass"


def test_a_supervisor_that_is_killed_at_once_leaves_no_zygote(home: Home) -> None:
    """It is still being loaded when its parent dies, and cannot be told by a signal yet."""
    with Started(home, LoadRun(100, 200.0)) as run:
        pid = run.launched.supervisor
        children = Path(f"/proc/{pid}/task/{pid}/children")
        until(children.read_text, "a zygote")
    assert home.seconds_to_clean() < GONE_SECONDS_MAX

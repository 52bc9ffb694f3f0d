"""What the death of a child says: a journal without room is trouble of the harness and no crash of a node."""

import os
import signal
import socket
from pathlib import Path

import pytest

from aftbed.core.errors import HarnessError
from aftbed.runtime.interface import ProcessKind
from aftbed.runtime.unix.cleanup import UndoLedger
from aftbed.runtime.unix.process_pool import UnixProcess, reap
from aftbed.runtime.unix.transport import Line, decode_report


def process_of(name: str, kind: ProcessKind, *bricks: tuple[str, str]) -> UnixProcess:
    ours, theirs = socket.socketpair()
    theirs.close()
    process = UnixProcess(name, kind, Line(ours, decode_report), UndoLedger(Path("/nonexistent"), -1))
    process.bricks = bricks
    return process


def dead(journal: str, sig: signal.Signals) -> UnixProcess:
    """A node with that journal, killed by `sig` and not reaped yet."""
    process = process_of("client", ProcessKind.NODE)
    process.pid, process.journal = os.posix_spawn("/bin/sleep", ["sleep", "60"], {}), journal
    os.kill(process.pid, sig)
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    process.line.close()
    return process


def test_a_journal_without_room_is_named() -> None:
    text = (
        "client was killed by SIGBUS, as where a journal finds no room: is the disk of /records/journal full?"
    )
    with pytest.raises(HarnessError, match=text.replace("?", r"\?")):
        reap(dead("/records/journal/client.1.journal", signal.SIGBUS))


@pytest.mark.parametrize(
    ("journal", "sig"), [("/records/journal/client.1.journal", signal.SIGKILL), ("", signal.SIGBUS)]
)
def test_other_deaths_are_no_trouble(journal: str, sig: signal.Signals) -> None:
    process = dead(journal, sig)
    assert reap(process) and not reap(process)


def test_at_the_end_watchdogs_are_killed_first_and_the_hub_after_its_clients() -> None:
    everything = [
        process_of("hub", ProcessKind.SERVICE),
        process_of("vehicle", ProcessKind.SERVICE),
        process_of("client", ProcessKind.NODE, ("client", "client")),
        process_of("a/watchdog", ProcessKind.NODE, ("a/watchdog", "watchdog")),
    ]
    try:
        in_turn = sorted(everything, key=UnixProcess.killed_in_turn)
        assert [one.name for one in in_turn] == ["a/watchdog", "vehicle", "client", "hub"]
    finally:
        for one in everything:
            one.close()

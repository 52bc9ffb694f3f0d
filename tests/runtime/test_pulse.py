"""The pulse of a node that waits: for mail, or, suspended, for orders. A brick that loops stops it."""

import os
import select
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import pytest

from aftbed.core.brick import Brick, Effect
from aftbed.core.messages import AnyMessage, Rebound, Request, encode
from aftbed.runtime.node import Node
from aftbed.runtime.unix.journal_files import JournalFile, JournalHeader
from aftbed.runtime.unix.linux import set_timeouts
from aftbed.runtime.unix.node_io import UnixIO
from aftbed.runtime.unix.transport import PULSE_SECONDS, Line, decode_order

SECONDS_MAX: Final = 5.0
BEATS: Final = 4


class Idle(Brick):
    """Nothing ever comes."""

    def open_ports(self) -> tuple[str, ...]:
        return ("in",)

    def quiescent(self) -> bool:
        return True

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        return []


class Looping(Idle):
    """Loops over a few beats, and tells whether the pulse stood still after the first of them."""

    def __init__(self, journal: Path, told: int) -> None:
        self._journal, self._told = journal, told

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        if isinstance(msg, Rebound):
            return []
        header = JournalHeader(self._journal)
        seen = [self._pulse_after(header, beats) for beats in (2, BEATS)]
        os.write(self._told, b"still" if seen[0] == seen[1] else b"beats")
        return []

    def _pulse_after(self, header: JournalHeader, beats: int) -> int:
        until_s = time.monotonic() + beats * PULSE_SECONDS
        while time.monotonic() < until_s:
            pass
        return header.pulse_ns()


@contextmanager
def waiting(journal: Path, brick: Brick, *, suspended: bool = False, mail: bytes = b"") -> Iterator[int]:
    """A node in a process of its own, which ends when its line does."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    pid = os.fork()
    if not pid:
        ours.close()
        set_timeouts(theirs, 60.0, 2.0)  # so that it is nowhere else while it waits
        io = UnixIO(Line(theirs, decode_order), JournalFile(journal, "idle"))
        node = Node("idle", io)
        node.add("idle", brick)
        node.bind_input("idle", "in", os.dup(ends[0].fileno()))
        node.suspended = suspended
        io.start_pulse()
        io.serve()
    theirs.close()
    if mail:
        ends[1].send(mail)
    try:
        yield pid
    finally:
        os.kill(pid, 9)
        os.waitpid(pid, 0)
        for end in (ours, *ends):
            end.close()


@pytest.mark.parametrize("suspended", [False, True])
def test_a_node_that_waits_shows_that_it_lives(tmp_path: Path, suspended: bool) -> None:
    journal, seen = tmp_path / "idle.journal", set[int]()
    with waiting(journal, Idle(), suspended=suspended):
        limit = time.monotonic() + SECONDS_MAX
        header: JournalHeader | None = None
        while len(seen) < BEATS:
            assert time.monotonic() < limit, f"{len(seen)} beats"
            if header is None and journal.exists() and journal.stat().st_size:
                header = JournalHeader(journal)
            seen |= {header.pulse_ns()} - {0} if header is not None else set()
            os.sched_yield()
        assert header is not None
        header.close()


def test_a_node_whose_brick_loops_shows_no_pulse(tmp_path: Path) -> None:
    journal, (reading, told) = tmp_path / "idle.journal", os.pipe()
    try:
        with waiting(journal, Looping(journal, told), mail=encode(Request(1, 1, b""))):
            assert select.select([reading], [], [], SECONDS_MAX)[0], "the brick told nothing"
            assert os.read(reading, 5) == b"still"
    finally:
        os.close(reading)
        os.close(told)

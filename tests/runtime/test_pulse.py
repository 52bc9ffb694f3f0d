"""The pulse of a node that waits: for mail, or, suspended, for orders. Only a brick that blocks stops it."""

import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import pytest

from aftbed.core.brick import Brick, Effect
from aftbed.core.messages import AnyMessage
from aftbed.runtime.node import Node
from aftbed.runtime.unix.journal_files import JournalFile, JournalHeader
from aftbed.runtime.unix.linux import set_timeouts
from aftbed.runtime.unix.node_io import UnixIO
from aftbed.runtime.unix.transport import Line, decode_order

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


@contextmanager
def waiting(journal: Path, *, suspended: bool) -> Iterator[int]:
    """A node in a process of its own, which ends when its line does."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    mail = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    pid = os.fork()
    if not pid:
        ours.close()
        set_timeouts(theirs, 60.0, 2.0)  # so that it is nowhere else while it waits
        io = UnixIO(Line(theirs, decode_order), JournalFile(journal, "idle"))
        node = Node("idle", io)
        node.add("idle", Idle())
        node.bind_input("idle", "in", os.dup(mail[0].fileno()))
        node.suspended = suspended
        io.start_pulse()
        io.serve()
    theirs.close()
    try:
        yield pid
    finally:
        os.kill(pid, 9)
        os.waitpid(pid, 0)
        for end in (ours, *mail):
            end.close()


@pytest.mark.parametrize("suspended", [False, True])
def test_a_node_that_waits_shows_that_it_lives(tmp_path: Path, suspended: bool) -> None:
    journal, seen = tmp_path / "idle.journal", set[int]()
    with waiting(journal, suspended=suspended):
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

"""The warden: what undoes, removes and kills when nobody else is left to.

The supervisor cleans up after the command, and the command after the supervisor. If both die, or if
one dies while the other is stopped, the warden does it: a small process forked first, which does
nothing but wait for the ends of two pipes, and for what the supervisor has promised to undo and has
not (`runtime.unix.undo`): a stopped process goes on in time though its supervisor is dead or stopped too.
"""

import json
import os
import select
import signal
import time
from pathlib import Path
from typing import Final, NoReturn

import msgspec

from aftbed.runtime.unix import linux, members, rundir, undo

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
    members.mark(run.private)
    book = undo.Book(run.private)
    _undo_until_command_ends(run, book)
    rest = select.poll()
    rest.register(run.supervisor_end, 0)
    if not rest.poll(GRACE_SECONDS * 1e3):
        linux.kill(run.supervisor_pidfd, signal.SIGKILL)
        rest.poll(GRACE_SECONDS * 1e3)
    undo.kill_open(book, run.private)
    rundir.remove(run.private)
    os._exit(0)


def _undo_until_command_ends(run: Watched, book: undo.Book) -> None:
    poll = select.poll()
    poll.register(run.command_end, 0)  # only POLLHUP: nothing is ever written
    poll.register(run.waker, select.POLLIN)
    ledger = undo.Ledger(run.private, run.waker, "warden")
    while True:
        ready = {fd for fd, _ in poll.poll(book.patience_ms(time.monotonic_ns()))}
        if run.waker in ready:
            os.eventfd_read(run.waker)
        book.read()
        for done in undo.undo_overdue(book, ledger, run.private):
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

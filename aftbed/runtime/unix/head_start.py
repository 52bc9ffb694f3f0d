"""The supervisor of a run begins before the command knows what to run.

A command takes as long to import typer and to read its options as a supervisor and its zygotes take to
import what they need. So `aftbed run` forks the supervisor before it imports anything (`begin`), and the two
go on side by side. The supervisor, small as it is then, imports what all processes of a run have in common
and forks the zygotes; it belongs to no run, and there is nothing to remove. `launch` takes it over (`taken`)
and tells it what to run. If the command ends without a run, whatever ends it, its line ends, and so do the
supervisor and what it has forked.

In a process that has imported more already, a supervisor is forked when there is a run (`fork`).
"""

import os
import signal
import socket
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from select import POLLIN, poll
from typing import Final, NoReturn

from aftbed.runtime.unix import interrupts

END_SECONDS_MAX: Final = 0.8  # G7 allows 1 s
WORDS_WITHOUT_BUS: Final = ("--load", "--requests")
MODEL_SUFFIX: Final = ".fmu"  # of a function for which there is much to import
_begun: Final[list["Start"]] = []  # at most one


class Start:
    """A child that is going to be the supervisor of a run. `line` is our end of its line."""

    def __init__(self, pid: int, line: socket.socket) -> None:
        self.pid, self.line = pid, line

    def end(self) -> None:
        """End it, where there is no run for it: it reaps what it has forked."""
        self.line.close()
        pidfd = os.pidfd_open(self.pid)
        ended = poll()
        ended.register(pidfd, POLLIN)
        if not ended.poll(END_SECONDS_MAX * 1e3):
            os.kill(self.pid, signal.SIGKILL)  # our child, not reaped yet
        os.close(pidfd)
        os.waitpid(self.pid, 0)


def fork(supervise: Callable[[socket.socket], object]) -> Start:
    """Fork the child, which calls `supervise` with its end of the line. Raises OSError."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        pid = interrupts.fork()
        if pid == 0:
            try:
                ours.close()
                supervise(theirs)
            except BaseException:  # noqa: BLE001 - the last frame of this process
                sys.excepthook(*sys.exc_info())
            finally:
                os._exit(1)  # never into what the command does next
    return Start(pid, ours)


def begin(words: Sequence[str]) -> None:
    """Fork the supervisor of the run that the options `words` describe."""
    if "--help" in words:
        return
    has_bus = not any(word.startswith(WORDS_WITHOUT_BUS) for word in words)
    model = next((word for word in words if MODEL_SUFFIX in word), "")
    with suppress(OSError):  # then the launch says so
        _begun.append(fork(lambda line: _supervise(line, has_bus, model)))


def taken() -> Start | None:
    """The supervisor that has begun, for one run."""
    return _begun.pop() if _begun else None


def end() -> None:
    """End a supervisor that no run has taken."""
    if (start := taken()) is not None:
        start.end()


def _supervise(line: socket.socket, has_bus: bool, model: str) -> NoReturn:
    os.setsid()  # a terminal's Ctrl-C reaches the command alone
    interrupts.ignore()
    from aftbed.runtime.unix.supervisor_process import begin_early  # noqa: PLC0415 - in the child

    begin_early(line, has_bus=has_bus, application=model)

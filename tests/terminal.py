"""A terminal for tests: a function in a process of its own on a pty, and what its screen shows."""

import contextlib
import fcntl
import os
import select
import signal
import struct
import sys
import termios
import time
from collections.abc import Callable
from typing import Final, Self

import pyte

SECONDS_MAX: Final = 60.0


class Terminal:
    """`body` runs as the leader of a session on a pty; its return value is the exit code."""

    def __init__(self, body: Callable[[], int], columns: int = 80, rows: int = 24) -> None:
        self.screen = pyte.Screen(columns, rows)
        self._stream = pyte.ByteStream(self.screen)
        self.raw = b""
        self._status: int | None = None
        self.fd, theirs = os.openpty()
        self._set_size(columns, rows)
        self.before = self.modes  # nothing has set the terminal yet
        self.pid = os.fork()
        if self.pid == 0:
            os.close(self.fd)
            _be(body, theirs)
        os.close(theirs)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._status is None:
            os.kill(self.pid, signal.SIGKILL)
            os.waitpid(self.pid, 0)
        os.close(self.fd)

    # -- what it shows ------------------------------------------------------------------------

    @property
    def lines(self) -> list[str]:
        return [line.rstrip() for line in self.screen.display]

    @property
    def text(self) -> str:
        return "\n".join(self.lines)

    def style_of(self, text: str) -> pyte.screens.Char:
        """The first cell of `text`."""
        for row, line in enumerate(self.screen.display):
            if text in line:
                return self.screen.buffer[row][line.index(text)]
        raise AssertionError(f"{text!r} is not shown:\n{self.text}")

    def until(self, reached: Callable[[], bool], what: str) -> None:
        """Read until `reached`, or the test fails."""
        limit = time.monotonic() + SECONDS_MAX
        while not reached():
            assert time.monotonic() < limit, f"waited for {what}:\n{self.text}"
            if not self.read(0.05) and self.ended():
                assert reached(), f"ended before {what}:\n{self.text}\n{self.raw[-2000:]!r}"

    def until_shown(self, text: str) -> None:
        self.until(lambda: text in self.text, repr(text))

    def read(self, seconds: float) -> bool:
        """Take what it prints; False if it prints nothing."""
        poll = select.poll()
        poll.register(self.fd, select.POLLIN)
        if not poll.poll(seconds * 1e3):
            return False
        try:
            data = os.read(self.fd, 65536)
        except OSError:  # no process has the terminal open any more
            return False
        self.raw += data
        self._stream.feed(data)
        return bool(data)

    @property
    def modes(self) -> list[object]:
        """As stty shows them."""
        return termios.tcgetattr(self.fd)

    # -- what its user does -------------------------------------------------------------------

    def type(self, text: str) -> None:
        os.write(self.fd, text.encode())

    def resize(self, columns: int, rows: int) -> None:
        self.screen.resize(rows, columns)
        self._set_size(columns, rows)

    def _set_size(self, columns: int, rows: int) -> None:
        fcntl.ioctl(self.fd, termios.TIOCSWINSZ, struct.pack("4H", rows, columns, 0, 0))

    # -- its end ------------------------------------------------------------------------------

    def ended(self) -> bool:
        if self._status is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self._status = os.waitstatus_to_exitcode(status) if pid else None
        return self._status is not None

    def code(self) -> int:
        """Wait for its end: the exit code, negative for a signal."""
        self.until(self.ended, "the end")
        while self.read(0.0):
            pass
        assert self._status is not None
        return self._status


def _be(body: Callable[[], int], terminal: int) -> None:
    """The child: `body` with fresh standard streams, and never back into the tests."""
    code = 99
    try:
        for sig in (signal.SIGINT, signal.SIGTSTP, signal.SIGHUP, signal.SIGQUIT, signal.SIGWINCH):
            signal.signal(sig, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        os.login_tty(terminal)
        os.environ["TERM"] = "xterm"
        sys.stdin = open(0, closefd=False)  # noqa: SIM115 - for as long as the process
        sys.stdout, sys.stderr = (open(fd, "w", closefd=False) for fd in (1, 2))  # noqa: SIM115 - the same
        code = body()
        sys.stdout.flush()
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else 1
    except BaseException:  # noqa: BLE001 - the last frame of this process
        sys.excepthook(*sys.exc_info())
        with contextlib.suppress(OSError):
            sys.stderr.flush()
        code = 1
    finally:
        os._exit(code)

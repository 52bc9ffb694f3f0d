"""A terminal as one picture: redrawn where it has changed, with keys, and given back as it was.

**A terminal that does not read** (Ctrl-S, a window that hangs) must not stop the process. So the screen opens
the terminal once more: O_NONBLOCK belongs to an open file, and standard output is also the shell's. What the
terminal does not take is kept, and no new picture is drawn before it is written: pictures are dropped, and
what is kept is never more than one.

**Signals.** Handlers only wake `descriptors`; `attend` then acts, where nothing is half done. SIGWINCH:
everything is drawn again, at the new size. SIGTSTP (Ctrl-Z): the terminal is given back, the process stops,
and takes the terminal again when it is continued. SIGHUP and SIGQUIT: it is given back, and the process dies
of the signal as it would have done. SIGINT and SIGTERM are the caller's, which leaves the `with` block.

**In the background** (`&`, `bg`) nothing is drawn, read or set, since the kernel would stop the process for
it. The picture comes with `fg`.
"""

import contextlib
import os
import re
import signal
import sys
import termios
import tty
from collections.abc import Callable, Sequence
from enum import Enum
from types import FrameType, TracebackType
from typing import Any, Final, NamedTuple, Self

from rich.cells import cell_len, set_cell_size

from aftbed.cli.colour import Style, has_colour, is_capable
from aftbed.core.errors import shown
from aftbed.runtime.unix import linux

PERIOD_S: Final = 0.05  # between two pictures, at least
IDLE_S: Final = 0.5  # between two looks whether the process is in the foreground
SIZE_IF_UNKNOWN: Final = (80, 24)
COLUMNS_MAX, ROWS_MAX = 1000, 500  # drawn of a terminal that says that it has more
KEYS_BYTES_MAX: Final = 4096  # read at once

_ENTER: Final = b"\x1b[?1049h\x1b[?25l\x1b[2J"  # the other screen, no cursor, clear
_LEAVE: Final = b"\x1b[0m\x1b[?25h\x1b[%d;1H\r\n\x1b[?1049l"  # below all, where there is no other screen
_KEY: Final = re.compile(r"\x1b\[[0-9;?]*[A-Za-z~]|\x1bO[A-Za-z]|[\s\S]")
_FATAL: Final = (signal.SIGHUP, signal.SIGQUIT)


class StyledText(NamedTuple):
    """A part of a line."""

    text: str
    style: Style = Style.PLAIN


Line = tuple[StyledText, ...]


class Key(Enum):
    """A key that is no character."""

    ENTER = ("\r", "\n")
    ESCAPE = ("\x1b", "\x04")  # Ctrl-D too
    ERASE = ("\x7f", "\x08")
    ERASE_LINE = ("\x15",)
    ERASE_WORD = ("\x17",)
    LEFT = ("\x1b[D", "\x1bOD", "\x02")
    RIGHT = ("\x1b[C", "\x1bOC", "\x06")
    HOME = ("\x1b[H", "\x1bOH", "\x1b[1~", "\x01")
    END = ("\x1b[F", "\x1bOF", "\x1b[4~", "\x05")
    UP = ("\x1b[A", "\x1bOA", "\x10")
    DOWN = ("\x1b[B", "\x1bOB", "\x0e")


_KEYS: Final = {sent: key for key in Key for sent in key.value}


def keys_in(typed: str) -> list[Key | str]:
    """The keys and characters in what a terminal has sent; what is neither is left out."""
    found = (_KEYS.get(one, one) for one in _KEY.findall(typed))
    return [one for one in found if isinstance(one, Key) or one.isprintable()]


def fitted(line: Line, width: int) -> Line:
    """`line` in `width` cells, filled with spaces; what others wrote in it cannot move the cursor."""
    spans, left = list[StyledText](), width
    for text, style in line:
        clean = shown(text).replace("\n", " ")
        taken = min(left, cells(clean))
        spans.append(StyledText(set_cell_size(clean, taken), style))
        left -= taken
    filler = line[-1].style if line and line[-1].style is Style.TITLE else Style.PLAIN
    return (*spans, StyledText(" " * left, filler))


def cells(text: str) -> int:
    """How many cells of a terminal `text` takes: none for a mark that is put on the character before it."""
    return len(text) if text.isascii() else cell_len(text)


def opened() -> "Screen | None":
    """The screen of standard output; None if there is no such terminal, or it is another user's."""
    if not is_capable():
        return None
    try:
        return Screen()
    except OSError:
        return None


class Screen:
    """The terminal on standard output, and the keys of the one on standard input, while in a `with` block.

    Raises OSError if the terminal cannot be opened.
    """

    def __init__(self) -> None:
        self._colour = has_colour()
        self._encoding = sys.stdout.encoding
        self._output = os.open("/proc/self/fd/1", os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
        self._input = sys.stdin.fileno() if _is_terminal(sys.stdin.fileno()) else -1
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._before: dict[signal.Signals, Callable[[int, FrameType | None], Any] | int | None] = {}
        self._pending_signals: list[signal.Signals] = []
        self._modes: list[object] | None = None  # of the input, before
        self._taken = False  # the terminal shows the picture
        self._unwritten = b""
        self._drawn: dict[int, bytes] = {}  # by row
        self._size = (0, 0)

    def __enter__(self) -> Self:
        for sig in (signal.SIGWINCH, signal.SIGTSTP, *_FATAL):
            before = signal.getsignal(sig)
            if before is not signal.SIG_IGN:
                self._before[sig] = signal.signal(sig, self._note)
        self._take()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        left = self._give_back(at_end=True)
        for sig, handler in self._before.items():
            signal.signal(sig, handler)
        os.close(self._output)
        os.close(self._wake)
        if left:  # the terminal does not read now: first of all when it does again
            with contextlib.suppress(OSError):
                sys.stdout.buffer.write(left)  # in its order, when the next line is printed

    # -- what the caller uses -----------------------------------------------------------------

    @property
    def has_keys(self) -> bool:
        return self._input >= 0

    @property
    def descriptors(self) -> tuple[int, ...]:
        """When one of them is readable, `attend` is worth calling."""
        return (self._wake, self._input) if self.has_keys and self._taken else (self._wake,)

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows."""
        try:
            columns, rows = os.get_terminal_size(self._output)
        except OSError:
            columns = rows = 0
        if columns <= 0 or rows <= 0:
            return SIZE_IF_UNKNOWN
        return min(columns, COLUMNS_MAX), min(rows, ROWS_MAX)

    def can_show(self, text: str) -> bool:
        """Whether the terminal's encoding has all characters of `text`."""
        return text.encode(self._encoding, "replace").decode(self._encoding) == text

    @property
    def is_stale(self) -> bool:
        """Whether the terminal shows something else than what was drawn last, at its size."""
        return self._taken and (self._size != self.size or bool(self._unwritten))

    def attend(self) -> list[Key | str]:
        """Do what signals asked for; the keys that were typed. May stop the process, or end it."""
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._wake)
        while self._pending_signals:
            self._obey(self._pending_signals.pop(0))
        if self._taken != self._in_foreground():
            if self._taken:  # a shell has put it into the background, and set its own modes
                self._forget()
            else:
                self._take()
        return self._typed()

    def draw(self, lines: Sequence[Line]) -> bool:
        """Show `lines`, one a row; False if that is not possible now."""
        if not self._taken or not self._written():
            return False
        size = self.size
        if size != self._size:
            self._size, self._drawn, self._unwritten = size, {}, b"\x1b[0m\x1b[2J"
        columns, rows = size
        for row in range(rows):
            line = self._encoded(fitted(lines[row] if row < len(lines) else (), columns))
            if self._drawn.get(row) != line:
                self._drawn[row] = line
                self._unwritten += b"\x1b[%d;1H" % (row + 1) + line
        self._written()
        return True

    # -- the terminal -------------------------------------------------------------------------

    def _encoded(self, line: Line) -> bytes:
        parts = (
            f"\x1b[{style.value}m{text}\x1b[0m"
            if style is not Style.PLAIN and (self._colour or style is Style.TITLE)
            else text
            for text, style in line
        )
        return "".join(parts).encode(self._encoding, "replace")

    def _written(self) -> bool:
        """Write what is left to write, as much as the terminal takes; whether it took all."""
        with contextlib.suppress(OSError):  # it does not read now, or is gone, which a signal tells
            while self._unwritten:
                self._unwritten = self._unwritten[os.write(self._output, self._unwritten) :]
        return not self._unwritten

    def _in_foreground(self) -> bool:
        """Whether the terminal is ours to set. A terminal that no shell controls is."""
        try:
            return os.tcgetpgrp(self._output) == os.getpgrp()
        except OSError:
            return True

    def _take(self) -> None:
        if not self._in_foreground():
            return
        if self.has_keys:
            try:
                self._modes = termios.tcgetattr(self._input)
                tty.setcbreak(self._input, termios.TCSANOW)
            except termios.error:
                self._input = -1
        self._taken, self._unwritten, self._drawn, self._size = True, _ENTER, {}, (0, 0)

    def _give_back(self, *, at_end: bool) -> bytes:
        """Set the terminal as it was; what it has not taken of that."""
        if not self._taken:
            return b""
        _, rows = self.size
        if self._modes is not None:
            with contextlib.suppress(termios.error):
                termios.tcsetattr(self._input, termios.TCSANOW, self._modes)  # type: ignore[arg-type]
                if at_end:  # what was typed for the picture is not for the shell
                    termios.tcflush(self._input, termios.TCIFLUSH)
        self._unwritten = _LEAVE % rows
        self._written()
        left = self._unwritten
        self._forget()
        return left

    def _forget(self) -> None:
        self._taken, self._modes, self._unwritten = False, None, b""

    def _typed(self) -> list[Key | str]:
        if not (self._taken and self.has_keys and linux.readable((self._input,), 0)):
            return []
        try:
            data = os.read(self._input, KEYS_BYTES_MAX)
        except OSError:
            data = b""
        if not data:
            self._input = -1  # hung up: it stays readable
        return keys_in(data.decode(errors="replace"))

    # -- signals ------------------------------------------------------------------------------

    def _note(self, signum: int, frame: FrameType | None) -> None:
        if signum != signal.SIGWINCH:  # the size is looked up for each picture
            self._pending_signals.append(signal.Signals(signum))
        else:
            self._size = (0, 0)
        os.eventfd_write(self._wake, 1)

    def _obey(self, sig: signal.Signals) -> None:
        """Stop, or die, as if there were no screen."""
        self._give_back(at_end=sig in _FATAL)
        signal.signal(sig, signal.SIG_DFL)
        os.kill(os.getpid(), sig)
        signal.signal(sig, self._note)  # continued
        self._take()


def _is_terminal(descriptor: int) -> bool:
    try:
        return os.isatty(descriptor)
    except OSError:
        return False

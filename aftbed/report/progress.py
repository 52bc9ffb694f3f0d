"""How far a long command is: a count, a rate and the time that is left, on standard error.

A terminal has one line, which fits its width, is drawn anew in place, and is erased at the end. Anything else
(a pipe, the log of a CI) gets a plain line every LINE_S, and none where the command prints JSON
(`plain=False`). The line is drawn when something is counted. It has no thread, which would be forked with the
processes that do the work, and no timer, which would disturb what is measured.

The time that is left is estimated from the mean rate up to now.
"""

import os
import sys
import time
from types import TracebackType
from typing import Final, Self

from aftbed.core.errors import shown

REDRAW_S: Final = 0.1
LINE_S: Final = 30.0  # between two plain lines
BAR: Final = 20  # characters
WIDTH: Final = 80  # of a terminal that does not tell its own
ERASE: Final = "\r\x1b[K"


def spaced(number: float) -> str:
    """A whole number in groups of three digits, as `8 867`."""
    return f"{number:,.0f}".replace(",", " ")


def clock(seconds: float) -> str:
    """`0:08`, `1:02:03`."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def pace(done: float, total: float, seconds: float, unit: str = "") -> str:
    """`120 of 400 runs, 35/s, 0:08 left`, of what was done in so many seconds.

    The unit "s" is that of time itself, which has no rate. A total of 0 is one that is not known yet.
    """
    count = f"{spaced(done)} of {spaced(total)}" if total else spaced(done)
    words = [f"{count}{f' {unit}' if unit else ''}"] if done or total else []
    rate = done / max(seconds, 1e-9)
    if done and unit != "s":
        words.append(_per_second(rate))
    if 0 < done < total:
        words.append(f"{clock((total - done) / rate)} left")
    return ", ".join(words)


def _per_second(rate: float) -> str:
    if rate < 1:
        return f"{60 * rate:.2g}/min"
    return f"{spaced(rate) if rate >= 10 else f'{rate:.2g}'}/s"


class ProgressLine:
    """A context manager. `show` tells how far the command is, `print` prints a line to standard output."""

    def __init__(self, what: str, total: float = 0, unit: str = "", *, plain: bool = True) -> None:
        self._what, self._total, self._unit, self._plain = what, total, unit, plain
        self._drawn = sys.stderr.isatty()
        self._done = 0.0
        self._note = ""
        self._began_s = time.monotonic()
        self._shown_s = self._began_s - (REDRAW_S if self._drawn else 0.0)

    def __enter__(self) -> Self:
        self._look(at_once=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._erase()
        self._drawn = self._plain = False

    def show(self, done: float, total: float | None = None, note: str | None = None) -> None:
        """So much of `total` is done; `note` stands behind it. Drawn at most every REDRAW_S."""
        is_new = total is not None and total != self._total
        self._done = done
        self._total = self._total if total is None else total
        self._note = self._note if note is None else note
        self._look(at_once=is_new)

    def step(self, note: str) -> None:
        """What is done next, of a few things that each take long: shown at once, also in a pipe."""
        self._note = note
        if self._drawn:
            self._look(at_once=True)
        elif self._plain:
            self._line()

    def print(self, text: str) -> None:
        """Print to standard output, which may be the same terminal."""
        self._erase()
        print(text, flush=True)
        self._look(at_once=self._drawn)

    def text(self) -> str:
        """As the line has it, without the bar."""
        counts = pace(self._done, self._total, time.monotonic() - self._began_s, self._unit)
        return "; ".join(filter(None, (f"{self._what}: {counts}" if counts else self._what, self._note)))

    def _look(self, *, at_once: bool = False) -> None:
        """Show it if it is time."""
        now_s = time.monotonic()
        if self._drawn and (at_once or now_s >= self._shown_s + REDRAW_S):
            self._shown_s = now_s
            self._draw()
        elif not self._drawn and self._plain and now_s >= self._shown_s + LINE_S:
            self._line()

    def _line(self) -> None:
        self._shown_s = time.monotonic()
        print(shown(self.text()), file=sys.stderr, flush=True)

    def _draw(self) -> None:
        columns = _columns()
        text = shown(" ".join(self.text().split()))
        full = int(BAR * min(1.0, self._done / self._total)) if self._total else 0
        bar = f"[{'#' * full}{'.' * (BAR - full)}] "
        if self._total and len(bar) + len(text) < columns:
            text = bar + text
        self._write(f"{ERASE}{text[: columns - 1]}")

    def _erase(self) -> None:
        if self._drawn:
            self._write(ERASE)

    def _write(self, text: str) -> None:
        try:
            sys.stderr.write(text)
            sys.stderr.flush()
        except OSError:  # the terminal is gone
            self._drawn = False


def _columns() -> int:
    try:
        return os.get_terminal_size(sys.stderr.fileno()).columns or WIDTH
    except (OSError, ValueError):
        return WIDTH

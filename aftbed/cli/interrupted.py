"""What a command says that Ctrl-C has ended."""

import contextlib
import signal
import sys
from collections.abc import Callable, Iterator
from typing import Final

from aftbed.core.errors import shown

EXIT_INTERRUPTED: Final = 128 + signal.SIGINT


def interrupted(kept: str = "") -> int:
    """Say on standard error that it was, and what is kept of it, or how to go on; the exit code.

    On a terminal, what the terminal itself says (^C), or a line of progress says, is erased.
    """
    from aftbed.report.progress import ERASE  # noqa: PLC0415 - of commands that were interrupted

    with contextlib.suppress(OSError):
        erase = ERASE if sys.stderr.isatty() else ""
        print(erase + shown(f"aftbed: interrupted{': ' if kept else ''}{kept}"), file=sys.stderr)
    return EXIT_INTERRUPTED


@contextlib.contextmanager
def told_if_interrupted(kept: Callable[[], str]) -> Iterator[None]:
    """End the command, as `interrupted` says, where an interrupt comes out of the block."""
    try:
        yield
    except KeyboardInterrupt:
        raise SystemExit(interrupted(kept())) from None

"""Ctrl-C: what must not be cut short by it, and whether it came. SIGTERM, as of timeout(1), is the same.

An interrupt is a KeyboardInterrupt wherever the command is. A second one may come while the command cleans up
behind the first: what removes files or starts processes is done in `uninterrupted`. So are the large imports:
the interpreter turns what is raised in some places of an import into another error, or drops it.
"""

import contextlib
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Final

ENDS: Final = (signal.SIGINT, signal.SIGTERM)
_came: list[int] = []


def listen() -> None:
    """Count the interrupts of this process; where Ctrl-C is ignored, as behind `&`, it stays so."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)
    if signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        signal.signal(signal.SIGTERM, _interrupt)


def ignore() -> None:
    """From now on; for a process that is about to end, or that leaves interrupts to the command.

    SIGTERM ends it, so that a node can be killed by hand.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


def came() -> bool:
    """Whether this command was interrupted; False in a process that does not `listen`."""
    return bool(_came)


def _interrupt(number: int, frame: FrameType | None) -> None:
    _came.append(number)
    raise KeyboardInterrupt


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """An interrupt is raised only after it; a process that is started in it receives none, then or later.

    The mask is for this thread and for that process, which SIGTERM still ends. The handlers are for SIGTERM,
    and for interrupts that the kernel gives to another thread of this process (libraries have some): Python
    would raise them here all the same.
    """
    came: list[int] = []
    command = os.getpid()
    try:
        before = {s: signal.signal(s, lambda number, _: came.append(number)) for s in ENDS}
    except ValueError:  # not the main thread: interrupts are not for it
        yield
        return
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        if os.getpid() != command:
            ignore()
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        else:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
            for number, handler in before.items():
                signal.signal(number, handler)
            if came:
                signal.raise_signal(came[0])


def fork() -> int:
    """As os.fork(2), but that the child leaves interrupts to this process, from its first moment on."""
    with uninterrupted():
        return os.fork()


@contextlib.contextmanager
def scratch_directory(prefix: str, folder: Path | None = None) -> Iterator[Path]:
    """A new directory, in `folder` or where temporary files are, which is removed whatever interrupts."""
    import tempfile  # noqa: PLC0415 - workers import this module, and need none

    with contextlib.ExitStack() as standing:
        with uninterrupted():
            path = Path(tempfile.mkdtemp(prefix=prefix, dir=folder))
            standing.callback(_remove, path)
        yield path


def _remove(path: Path) -> None:
    import shutil  # noqa: PLC0415 - the same

    with uninterrupted():
        shutil.rmtree(path, ignore_errors=True)

"""The command line: parses, prints, and maps a verdict to an exit code.

What surrounds a command is dealt with here, once for all commands: standard streams that are closed, that
take no more, or whose encoding lacks some characters; and what the system refused that no command foresees.
"""

import contextlib
import errno
import gc
import io
import os
import select
import signal
import sys
from collections.abc import Iterator
from typing import Final, TextIO

from aftbed.cli.interrupted import interrupted
from aftbed.core.errors import ConfigError, HarnessError, PeerError, shown
from aftbed.runtime.unix import interrupts

EXIT_USAGE: Final = 2
EXIT_TROUBLE: Final = 3
EXIT_READER_GONE: Final = 128 + signal.SIGPIPE
NO_ROOM: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
STREAMS: Final = (("stdin", "r"), ("stdout", "w"), ("stderr", "w"))  # by descriptor


def main() -> None:
    """The console script `aftbed`."""
    fresh = "typer" not in sys.modules  # this interpreter has been started for this command
    try:
        try:
            code = _run(fresh=fresh)
        except KeyboardInterrupt:  # outside of a command, or once more while it cleaned up
            code = interrupted()
        if fresh:
            interrupts.ignore()  # nothing is left that it could end
    except KeyboardInterrupt:  # once more
        if fresh:
            interrupts.ignore()
        code = interrupted()
    for stream in (sys.stdout, sys.stderr):
        if not _taken(stream):  # the interpreter would try again at its end, and complain
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    sys.exit(code)


def _run(*, fresh: bool) -> int:
    """Run the command; its exit code."""
    try:
        _prepare()
        if fresh:  # what is imported stays; to look for garbage in it takes a tenth of the time
            interrupts.listen()
            gc.disable()  # until the command has been imported: see `lazy`
        with _head_start(sys.argv[1:]) if fresh else contextlib.nullcontext():
            return _call()
    except ConfigError as error:
        return interrupted() if interrupts.came() else _explain(EXIT_USAGE, f"error: {error}")
    except (HarnessError, PeerError) as error:  # a run that was cut short is no trouble
        return interrupted() if interrupts.came() else _explain(EXIT_TROUBLE, f"trouble: {error}")
    except OSError as error:
        return interrupted() if interrupts.came() else _failed(error)


def _prepare() -> None:
    """Make the process what a command relies on, whatever it was started with.

    A standard descriptor that is closed becomes the null device: otherwise a socket of the run would get its
    number, and what is printed would go there. Children are waited for, so SIGCHLD may not be ignored.
    """
    for number, (name, mode) in enumerate(STREAMS):
        try:
            os.fstat(number)
        except OSError:
            opened = os.open(os.devnull, os.O_RDWR)
            if opened == number:
                os.set_inheritable(number, True)
            else:
                os.dup2(opened, number)
                os.close(opened)
            setattr(sys, name, open(number, mode, closefd=False))  # noqa: SIM115 - for as long as the process
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)


@contextlib.contextmanager
def _head_start(words: list[str]) -> Iterator[None]:
    """Let the supervisor of a run begin before the command is imported.

    In a fresh interpreter only: what is in this process is copied with each process of the run.
    """
    if words[:1] != ["run"]:
        yield
        return
    from aftbed.runtime.unix import head_start  # noqa: PLC0415 - of runs only

    head_start.begin(words[1:])
    try:
        yield
    finally:
        head_start.end()


def _call() -> int:
    """Call the command; its exit code. What it printed has been written."""
    for word in sys.argv[1:]:
        try:
            word.encode()
        except UnicodeEncodeError:  # neither messages nor JSON could carry it
            raise ConfigError(f"{word!a}: not UTF-8; choose another name, or set LANG=C.UTF-8") from None
    with interrupts.uninterrupted():
        from aftbed.cli.app import app  # noqa: PLC0415 - typer, behind the head start of a run

    code: object = 0
    streams = sys.stdout, sys.stderr
    try:
        app()
    except SystemExit as ended:
        if isinstance(ended.__context__, BrokenPipeError):  # typer makes code 1 of it, and replaces streams
            sys.stdout, sys.stderr = streams
            raise ended.__context__ from None
        if isinstance(getattr(ended.__context__, "__cause__", None), KeyboardInterrupt):  # code 130 of typer
            interrupted()
        code = ended.code
    sys.stdout.flush()
    return code if isinstance(code, int) else 0


def _explain(code: int, text: str) -> int:
    """Print one line for the user; `code`."""
    with contextlib.suppress(OSError):
        print(shown(f"aftbed: {text}"), file=sys.stderr)
    return code


def _failed(error: OSError) -> int:
    """The exit code of a command that the system refused something. A reader that is gone needs no words."""
    if isinstance(error, BrokenPipeError) and (_reader_gone(sys.stdout) or _reader_gone(sys.stderr)):
        return EXIT_READER_GONE
    if isinstance(error, FileNotFoundError) and not error.filename:  # of getcwd(2)
        return _explain(EXIT_USAGE, "error: the working directory was removed; change to another one")
    what = error.filename or ("the output" if error.errno in NO_ROOM else "")
    return _explain(EXIT_TROUBLE, f"trouble: {f'{what}: ' if what else ''}{error.strerror or error}")


def _reader_gone(stream: TextIO) -> bool:
    """Whether the stream is a pipe or a socket from which nobody reads any more."""
    poll = select.poll()
    poll.register(stream.fileno(), 0)
    return any(events & select.POLLERR for _, events in poll.poll(0))


def _taken(stream: TextIO) -> bool:
    """Whether the stream takes what is still to be written."""
    try:
        stream.flush()
    except OSError:
        return False
    return True

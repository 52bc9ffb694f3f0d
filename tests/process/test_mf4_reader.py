"""An MF4 is read in a process of its own: its death is an error, and it dies with the command.

The log is a FIFO. The command reads its first bytes from it; the reader, which opens it again, waits in vain.
"""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from liveruns import WAIT_SECONDS_MAX, ended, until

pytestmark = pytest.mark.process


def reader_of(command: int) -> int:
    """The process that the command has started to read the log, or 0."""
    children = Path(f"/proc/{command}/task/{command}/children").read_text().split()
    lines = {int(pid): Path(f"/proc/{pid}/cmdline").read_bytes() for pid in children}
    return next((pid for pid, line in lines.items() if b"aftbed.interop.logs" in line), 0)


@contextmanager
def waiting_reader(folder: Path) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    """A command that converts an MF4, and the process of its reader."""
    os.mkfifo(folder / "a.mf4")
    words = [sys.executable, "-m", "aftbed", "log", "convert", folder / "a.mf4", folder / "a.log"]
    own = os.environ | {"TMPDIR": str(folder)}  # a command that is killed leaves its scratch directory there
    with subprocess.Popen(words, stderr=subprocess.PIPE, env=own) as command:
        try:
            (folder / "a.mf4").write_bytes(b"MDF     4.10    ")  # waits until the command opens it
            yield command, until(lambda: reader_of(command.pid), "its reader")
        finally:
            command.kill()


def test_the_death_of_the_reader_is_an_error(tmp_path: Path) -> None:
    with waiting_reader(tmp_path) as (command, reader):
        os.kill(reader, signal.SIGKILL)
        _, errors = command.communicate(timeout=WAIT_SECONDS_MAX)
    assert command.returncode == 2 and not (tmp_path / "a.log").exists()
    words = b"a.mf4: not an MF4 that can be read: torn or malformed: its reader ended with signal 9 (Killed)"
    assert words in errors


def test_the_reader_dies_with_the_command(tmp_path: Path) -> None:
    with waiting_reader(tmp_path) as (command, reader):
        command.kill()
        assert ended(reader)

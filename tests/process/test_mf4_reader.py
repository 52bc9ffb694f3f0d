"""An MF4 is read by a process of its own: its death is an error, and it dies with its command."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest
from liveruns import WAIT_SECONDS_MAX, ended, until

from aftbed.vehicle.logs.convert import WRITERS
from aftbed.vehicle.logs.frames import Log, LoggedFrame

pytestmark = pytest.mark.process

LOG: Final = Log(tuple(LoggedFrame(1000 * n, "can0", 0x100, bytes(8)) for n in range(20_000)))


def reader_of(command: int) -> int:
    """The process that it has started to read, or 0."""
    children = Path(f"/proc/{command}/task/{command}/children").read_text().split()
    lines = {int(pid): Path(f"/proc/{pid}/cmdline").read_bytes() for pid in children}
    return next((pid for pid, line in lines.items() if b"spawn_main" in line), 0)


def test_an_mf4_whose_reader_dies_is_malformed(tmp_path: Path) -> None:
    source, sink = tmp_path / "a.mf4", tmp_path / "a.log"
    WRITERS["mf4"](LOG, source)
    words = [sys.executable, "-m", "aftbed", "log", "convert", source, sink]
    with subprocess.Popen(words, stderr=subprocess.PIPE) as command:
        os.kill(until(lambda: reader_of(command.pid), "its reader"), signal.SIGKILL)
        _, errors = command.communicate(timeout=WAIT_SECONDS_MAX)
    assert command.returncode == 2 and not sink.exists()
    assert b"a.mf4: not an MF4 that can be read: torn or malformed: its reader ended with -9\n" in errors


READING = """
import os, signal
from multiprocessing import get_context
from aftbed.vehicle.logs.mf4file import _die_with_parent

def stuck():
    _die_with_parent()
    print(os.getpid(), flush=True)
    while True:
        signal.pause()

if __name__ == "__main__":
    reader = get_context("spawn").Process(target=stuck)
    reader.start()
    reader.join()
"""


def test_the_reader_of_an_mf4_dies_with_its_command(tmp_path: Path) -> None:
    script = tmp_path / "reading.py"
    script.write_text(READING)
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE) as command:
        assert command.stdout is not None
        reader = int(command.stdout.readline())
        command.kill()
        assert ended(reader)

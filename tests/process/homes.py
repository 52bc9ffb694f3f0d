"""The home of a test: the XDG_RUNTIME_DIR of its runs, and what is left in it when they are over.

Whatever descends from a test carries the name of its home in its environment (`/proc/PID/environ`), or in a
mapping (`command_process.mark`), or is a fork of this process whose pid is known. So after a test it is
certain whether any of its processes is left. Other tests, and other people's processes, may run beside it.
"""

import contextlib
import os
import shutil
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final, TypeVar

import pytest

from aftbed.runtime.unix import linux
from aftbed.runtime.unix.run_directory import suits

WAIT_SECONDS_MAX: Final = 60.0  # a wait ends with its event: this is for machines under load
LOOK_SECONDS: Final = 0.005  # between two looks at what no descriptor tells
GONE_SECONDS_MAX: Final = 1.0  # G7
PATIENCE_SECONDS: Final = 5.0  # how long a test waits for what G7 allows a second
FORKED: Final = "/of/the/test"  # the home in the environment of a forked command, which its mapping names
SHARED_MEMORY: Final = Path("/dev/shm")
PREFIX: Final = "aft-"

Found = TypeVar("Found")


def until(look: Callable[[], Found], what: str, seconds: float = WAIT_SECONDS_MAX) -> Found:
    """What `look` returns as soon as that is true. Fails the test at the deadline, saying `what`."""
    limit = time.monotonic() + seconds
    while not (found := look()):
        if time.monotonic() > limit:
            pytest.fail(f"waited {seconds} s for {what}")
        time.sleep(LOOK_SECONDS)
    return found


def _pids() -> set[int]:
    return {int(name) for name in os.listdir("/proc") if name.isdigit()}  # noqa: PTH208 - five times faster


def _shared_memory() -> set[Path]:
    """What there is but homes, and semaphores: a run has none, and no mapping says whose one is (glibc
    renames it).
    """
    return {path for path in SHARED_MEMORY.iterdir() if not path.name.startswith(("sem.", PREFIX))}


def _name_and_state(pid: int) -> str:
    """`a/server S` (proc(5)); of one that has just gone, nothing."""
    with contextlib.suppress(OSError):
        name, _, rest = Path(f"/proc/{pid}/stat").read_text().partition("(")[2].rpartition(") ")
        return f"{name} {rest[:1]}"
    return ""


class Home:
    """The XDG_RUNTIME_DIR of one test. Its path is short: a socket's may have 108 bytes."""

    def __init__(self) -> None:
        folder = SHARED_MEMORY if suits(SHARED_MEMORY) else "/tmp"
        self.path = Path(tempfile.mkdtemp(prefix=PREFIX, dir=folder))
        self._mark = f"XDG_RUNTIME_DIR={self.path}".encode()
        self._before = _pids()
        self._shared = _shared_memory()
        self._forks: set[tuple[int, int]] = set()  # with the time of their start: a pid is given again

    def forked(self, pid: int) -> None:
        """A child of this process, which does not carry the name of the home, runs in it."""
        self._forks.add((pid, linux.started(pid)))

    def processes(self) -> list[int]:
        """The pids of what runs in this home, this process aside.

        What ran before the home was made is not looked at: a machine has hundreds of processes. A test that
        starts more than all pids there are may so overlook one.
        """
        return [pid for pid in _pids() - self._before if self._is_ours(pid)]

    def _is_ours(self, pid: int) -> bool:
        process = Path(f"/proc/{pid}")
        try:
            if (pid, linux.started(pid)) in self._forks:
                return not linux.dead(pid)
            environment = (process / "environ").read_bytes().split(b"\0")
            if f"XDG_RUNTIME_DIR={FORKED}".encode() in environment:
                return f"/memfd:{self.path} " in (process / "maps").read_text()
            return self._mark in environment
        except OSError:
            return False

    def runs(self) -> list[Path]:
        """The private directories there are, of runs alive or dead."""
        root = self.path / "aftbed"
        return list(root.iterdir()) if root.exists() else []

    def left(self) -> list[str]:
        """Everything that a run would have left behind (G7)."""
        found = [f"process {pid} ({_name_and_state(pid)})" for pid in self.processes()]
        found += [f"directory {path}" for path in self.runs()]
        new = _shared_memory() - self._shared
        return found + [f"shared memory {p}" for p in new if not self._is_mapped_elsewhere(p)]

    def _is_mapped_elsewhere(self, path: Path) -> bool:
        """Whether somebody else's process has it: other tests, and others, run beside this one."""
        ours = {*self.processes(), os.getpid()}
        for process in Path("/proc").iterdir():
            if process.name.isdigit() and int(process.name) not in ours:
                with contextlib.suppress(OSError):
                    if f" {path}" in (process / "maps").read_text():
                        return True
        return False

    def seconds_to_clean(self) -> float:
        """How long it takes from now until nothing is left."""
        began = time.monotonic()
        until(lambda: not self.left(), f"the end of {self.left()}", PATIENCE_SECONDS)
        return time.monotonic() - began

    def sweep(self) -> None:
        """After a failed test: end what is its own, so that the next test starts clean."""
        for pid in self.processes():
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                continue
        shutil.rmtree(self.path, ignore_errors=True)


@pytest.fixture(autouse=True)
def home(monkeypatch: pytest.MonkeyPatch) -> Iterator[Home]:
    """A place of its own for each test, and nothing may be left in it."""
    place = Home()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(place.path))
    yield place
    limit = time.monotonic() + GONE_SECONDS_MAX
    looked, left = time.monotonic(), place.left()
    while left and looked < limit:  # a look takes time, and tells what was there when it began
        time.sleep(LOOK_SECONDS)
        looked, left = time.monotonic(), place.left()
    place.sweep()
    assert not left, f"left behind: {left}"

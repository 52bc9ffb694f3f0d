"""To which run a process belongs: its mark outlives descriptors, and no other process gets it by accident."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from aftbed.runtime.unix import linux, run_directory

pytestmark = pytest.mark.process

Forked = Callable[[Callable[[], None]], int]


@pytest.fixture
def forked() -> Iterator[Forked]:
    """Forks a child that does something and then waits to be killed; its pid, once it has done it."""
    children: list[int] = []

    def fork(act: Callable[[], None]) -> int:
        told, telling = os.pipe()
        child = os.fork()
        if child == 0:
            try:
                act()
                os.write(telling, b"!")
                signal.pause()
            finally:
                os._exit(0)
        children.append(child)
        assert os.read(told, 1) == b"!"
        os.close(told)
        os.close(telling)
        return child

    yield fork
    for child in children:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def test_who_is_not_marked_belongs_to_no_run(forked: Forked) -> None:
    child = forked(lambda: None)
    assert run_directory.run_of(child) is run_directory.run_of(os.getpid()) is None
    assert child not in {m.pid for m in run_directory.members()}


def test_a_mark_is_known_by_its_directory(forked: Forked, tmp_path: Path) -> None:
    run = tmp_path / "a directory with a space (deleted)"
    child = forked(lambda: run_directory.mark(run))
    assert run_directory.run_of(child) == run
    found = {m.pid: m for m in run_directory.members()}[child]
    assert (found.run, found.start) == (str(run), linux.started(child))


def test_a_mark_stays_where_all_descriptors_are_closed(forked: Forked, tmp_path: Path) -> None:
    """A zygote closes what it does not know."""

    def act() -> None:
        run_directory.mark(tmp_path)
        for descriptor in range(3, 20):
            try:
                if not _is_pipe(os.fstat(descriptor)):
                    os.close(descriptor)
            except OSError:
                continue

    assert run_directory.run_of(forked(act)) == tmp_path


def _is_pipe(state: os.stat_result) -> bool:
    return (state.st_mode & 0o170000) == 0o010000


def test_what_is_executed_is_marked_by_its_environment(tmp_path: Path) -> None:
    words = [sys.executable, "-c", "print(flush=True); input()"]
    environment = os.environ | {run_directory.VARIABLE: str(tmp_path)}
    with subprocess.Popen(words, stdin=-1, stdout=-1, env=environment) as process:
        assert process.stdout is not None and process.stdout.readline() == b"\n"
        assert run_directory.run_of(process.pid) == tmp_path
        process.kill()


def test_a_process_is_ended_only_if_it_still_is_that_one(forked: Forked, tmp_path: Path) -> None:
    child = forked(lambda: run_directory.mark(tmp_path))
    found = {m.pid: m for m in run_directory.members()}[child]
    other = run_directory.Member(found.run, child, found.start + 1, found.name, found.state)
    assert other.end(1.0), "that one is gone"
    assert linux.state_of(child) == "S"
    assert found.end(1.0)
    assert linux.state_of(child) == "Z"

"""A campaign that is interrupted ends: at any moment, while its workers start too, once and again (G7)."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from liveruns import GONE_SECONDS_MAX, WAIT_SECONDS_MAX, Home, until
from sampling import every

from aftbed.campaign import ledger
from aftbed.cli.interrupted import EXIT_INTERRUPTED
from aftbed.runtime.unix.worker_pool import RUN_END_SECONDS_MAX

pytestmark = pytest.mark.process

JOBS = 2


class Interrupted:
    """A campaign in a process group of its own, as a terminal has it."""

    def __init__(self, home: Home, out: Path) -> None:
        self.home, self.out = home, out
        command = ["campaign", "run", "crash", "--out", str(out), "--jobs", str(JOBS)]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "aftbed", *command],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )

    def children(self) -> list[int]:
        """The workers that it has begun."""
        pid = self.process.pid
        return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]

    def imports(self, worker: int) -> bool:
        """Whether it is past the interpreter's own start."""
        return "/msgspec/" in Path(f"/proc/{worker}/maps").read_text()

    def pipes(self) -> int:
        """How many ends of pipes it has."""
        count = 0
        for fd in Path(f"/proc/{self.process.pid}/fd").iterdir():
            with suppress(FileNotFoundError):  # closed meanwhile
                count += "socket:" in str(fd.readlink())
        return count

    def results(self, count: int) -> bool:
        path = self.out / ledger.NAME
        return path.exists() and path.read_bytes().count(b"\n") > count

    def interrupt(self) -> None:
        os.killpg(self.process.pid, signal.SIGINT)

    def end(self) -> tuple[int, str]:
        """Exit code and errors."""
        errors = self.process.communicate(timeout=WAIT_SECONDS_MAX)[1]
        return self.process.returncode, errors.decode()


@pytest.fixture
def campaign(home: Home, tmp_path: Path) -> Iterator[Interrupted]:
    started = Interrupted(home, tmp_path / "out")
    yield started
    started.process.kill()
    started.process.communicate()


MOMENTS: dict[str, Callable[[Interrupted], bool]] = {
    "the first worker starts": lambda c: len(c.children()) >= 1,
    "the second worker starts": lambda c: len(c.children()) >= JOBS,
    "the workers import": lambda c: any(c.imports(worker) for worker in c.children()),
    "runs are under way": lambda c: c.results(1),
}


def check_end(code: int, errors: str, out: Path) -> None:
    """What is kept of it, and how to go on: nothing else."""
    assert code == EXIT_INTERRUPTED
    last = errors.splitlines()[-1]
    assert last.startswith("aftbed: interrupted: ") and f"experiments are kept in {out}; go on: " in last
    assert f"--out {out} --jobs {JOBS} --resume; reports: aftbed campaign report {out}" in last
    assert "Traceback" not in errors


@pytest.mark.parametrize("moment", every(3, tuple(MOMENTS)))
def test_it_ends_and_nothing_is_left(campaign: Interrupted, moment: str) -> None:
    until(lambda: MOMENTS[moment](campaign), moment)
    campaign.interrupt()
    check_end(*campaign.end(), campaign.out)
    assert campaign.home.seconds_to_clean() < GONE_SECONDS_MAX


def test_another_interrupt_does_not_wait_for_what_is_under_way(campaign: Interrupted) -> None:
    """The workers are stopped: nothing that they are at comes to its end by itself."""
    until(lambda: campaign.results(1), "a result")
    pipes = campaign.pipes()
    for worker in campaign.children():
        os.kill(worker, signal.SIGSTOP)
    campaign.interrupt()
    until(lambda: campaign.pipes() < pipes, "it to end its workers")
    began_s = time.monotonic()
    campaign.interrupt()
    check_end(*campaign.end(), campaign.out)
    assert time.monotonic() - began_s < RUN_END_SECONDS_MAX / 2
    assert campaign.home.seconds_to_clean() < GONE_SECONDS_MAX

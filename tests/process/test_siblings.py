"""Several runs of one command: each ends with the command, and none waits for another."""

import os
import signal
import subprocess
import sys
from typing import Final

import pytest
from liveruns import GONE_SECONDS_MAX, PATIENCE_SECONDS, Home, Started, ended, readable, state_of, until

from aftbed.runtime.unix import run_directory
from aftbed.runtime.unix.options import LoadRun

pytestmark = pytest.mark.process

RUNS: Final = 3
KEEPERS: Final = ("aftbed-supervis", "aftbed-warden")
COMMAND: Final = f"""
from aftbed.runtime.unix.launch import launch, options_for
from aftbed.runtime.unix.options import LoadRun

work = LoadRun(100_000, 20.0)
held = [launch(*options_for(ftm="none", placement="single", work=work)) for _ in range({RUNS})]
for one in held:
    next(report for report in one.reports() if b"started" in report.data)
print(*(one.supervisor for one in held), flush=True)
input()
"""


def test_the_runs_of_a_killed_command_do_not_wait_for_each_other(home: Home) -> None:
    """The keepers of the last one are stopped; it was forked when the command held the ends of the others."""
    words = [sys.executable, "-c", COMMAND]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as command:
        assert command.stdout is not None
        pids = [int(word) for word in command.stdout.readline().split()]
        last = run_directory.run_of(pids[-1])
        keepers = [m for m in run_directory.members() if m.run == str(last) and m.name in KEEPERS]
        assert len(keepers) == len(KEEPERS)
        for keeper in keepers:
            os.kill(keeper.pid, signal.SIGSTOP)
        until(lambda: all(state_of(keeper.pid) == "T" for keeper in keepers), "them to stop")
        command.kill()
        command.wait()
        assert home.seconds_to_clean() < GONE_SECONDS_MAX


def test_a_stopped_warden_does_not_hold_up_its_command(home: Home) -> None:
    with Started(home, LoadRun(50, 500.0)) as run:
        until(lambda: ended(run.launched.supervisor), "the end of the supervisor")
        os.kill(run.launched.warden, signal.SIGSTOP)
        assert run.finish().verdict.verdict == "pass"


def test_a_child_of_a_child_closes_nothing_that_is_not_the_command_s(home: Home) -> None:
    """What the command held has other owners by the same numbers there."""
    with Started(home, LoadRun(100_000, 200.0)) as run:
        held = run.launched._life[0]
        run.wait_for("started")
        told, telling = os.pipe()
        child = os.fork()
        if child == 0:
            os.dup2(telling, held)  # let go of, the number is free
            if os.fork() == 0:
                os.write(held, b"open")
            os._exit(0)
        os.waitpid(child, 0)
        assert readable(told, PATIENCE_SECONDS)
        assert os.read(told, 8) == b"open"
        os.close(told)
        os.close(telling)

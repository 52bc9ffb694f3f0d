"""What a test is told to have left behind is its own."""

import subprocess

import pytest
from liveruns import Home, until

from aftbed.runtime.unix import linux

pytestmark = pytest.mark.process


def test_a_fork_of_the_test_is_left_behind_until_it_is_dead(home: Home) -> None:
    with subprocess.Popen(["sleep", "60"], env={}) as child:
        try:
            home.forked(child.pid)
            until(lambda: home.left() == [f"process {child.pid} (sleep S)"], "the name of the command")
        finally:
            child.kill()
    assert home.left() == []


def test_a_process_with_the_pid_of_a_dead_fork_is_not_of_the_test(
    home: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    with subprocess.Popen(["sleep", "60"], env={}) as child:
        try:
            with monkeypatch.context() as patched:
                patched.setattr(linux, "started", lambda pid: 1)
                home.forked(child.pid)
            assert home.left() == []
        finally:
            child.kill()

"""`kill -9` of a command at the first sign of its run: there is somebody to remove it already (G7)."""

import signal
import subprocess
import sys

import pytest
from liveruns import GONE_SECONDS_MAX, Home, until

pytestmark = pytest.mark.process


@pytest.mark.parametrize("attempt", range(4))
def test_a_directory_that_has_just_been_made_is_removed(home: Home, attempt: int) -> None:
    command = [sys.executable, "-m", "aftbed", "run", "--load", "1000"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as running:
        try:
            until(home.runs, "the directory of the run")
        finally:
            running.send_signal(signal.SIGKILL)
    assert home.seconds_to_clean() < GONE_SECONDS_MAX, home.left()

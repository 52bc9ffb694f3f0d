"""The processes of `aftbed explore`: gone with their command, whatever ends it (promise G7)."""

import signal
import subprocess
import sys

import pytest
from liveruns import GONE_SECONDS_MAX, PATIENCE_SECONDS, Home, until
from sampling import every

pytestmark = pytest.mark.process

JOBS = 2


@pytest.mark.parametrize("end", every(2, (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)))
def test_no_simulator_outlives_its_command(home: Home, end: signal.Signals) -> None:
    command = [sys.executable, "-m", "aftbed", "explore", "pairs", "--jobs", str(JOBS), "--json"]
    explored = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        until(lambda: len(home.processes()) == 1 + JOBS, "the simulators")
        explored.send_signal(end)
        explored.wait(PATIENCE_SECONDS)
        assert home.seconds_to_clean() < GONE_SECONDS_MAX
    finally:
        explored.kill()
        explored.wait()

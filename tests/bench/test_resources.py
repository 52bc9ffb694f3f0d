"""What is waited for before the CPU time of an idle run is counted."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from aftbed.bench import runs
from aftbed.core.errors import HarnessError
from aftbed.runtime.unix import control_client
from aftbed.runtime.unix.control_client import ProcessRow

SLEEPS, WORKS = "import sys; sys.stdin.read()", "while True: pass"


@contextmanager
def spare(code: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A run with one process beside the graph, which executes `code`."""
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE) as child:
        rows = [ProcessRow("spare", "spare", child.pid, False)]
        monkeypatch.setattr(control_client, "processes", lambda private: rows)
        try:
            yield
        finally:
            child.kill()


def test_a_run_is_at_rest_when_its_spares_sleep(monkeypatch: pytest.MonkeyPatch) -> None:
    with spare(SLEEPS, monkeypatch):
        runs.wait_until_at_rest(Path())


def test_a_run_whose_spares_are_still_at_work_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runs, "REST_SECONDS_MAX", 0.5)
    with spare(WORKS, monkeypatch), pytest.raises(HarnessError, match=r"not at rest within 0\.5 s"):
        runs.wait_until_at_rest(Path())

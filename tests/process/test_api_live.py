"""`aftbed.run` on real processes: from any thread, and whatever ends the caller."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from counting_function import REQUESTS, Forgetful, Sum
from liveruns import WAIT_SECONDS_MAX, Home, home, only_run, readable, until

import aftbed

assert home  # a fixture

pytestmark = pytest.mark.process

CRASH = "crash primary at server.exit nth 7"
LONG = """
import aftbed, counting_function as functions
try:
    aftbed.run(functions.Sum, functions.REQUESTS, count=100_000, rate=100, runtime="unix")
except KeyboardInterrupt:
    print("interrupted", flush=True)
    input()
"""


def test_a_real_run_from_another_thread_leaves_the_process_as_it_was(tmp_path: Path) -> None:
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGCHLD)]
    found: list[aftbed.RunReport] = []

    def call() -> None:
        found.append(aftbed.run(Sum, REQUESTS, inject=CRASH, runtime="unix", record=tmp_path / "record"))

    thread = threading.Thread(target=call)
    thread.start()
    thread.join(WAIT_SECONDS_MAX)
    (report,) = found
    assert (report.verdict, report.reasons, report.failures) == ("pass", (), ())
    assert (report.requests.sent, len(report.failovers)) == (30, 1)
    assert [one.receipt.value for one in report.faults] == ["activated"]
    assert report.record == tmp_path / "record"
    assert json.loads((report.record / "run.json").read_text())["application"].endswith(":Sum")
    assert "aftbed run" in report.command and f"--record {report.record}" in report.command
    assert handlers == [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGCHLD)]


def test_a_real_run_of_a_function_that_loses_its_state_fails() -> None:
    report = aftbed.run(Forgetful, REQUESTS, inject=CRASH, runtime="unix")
    assert report.verdict == "fail"
    assert any("one_history" in reason for reason in report.reasons)


@contextlib.contextmanager
def caller_of_a_run() -> Iterator[subprocess.Popen[bytes]]:
    """A program that has called a long run; killed at the end."""
    path = os.pathsep.join((str(Path(aftbed.__file__).parents[1]), str(Path(__file__).parents[1] / "api")))
    caller = subprocess.Popen(
        [sys.executable, "-c", LONG],
        env=os.environ | {"PYTHONPATH": path},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    with caller:
        try:
            run = only_run()
            until(lambda: any(run.glob("record/journal/*")), "journals")
            yield caller
        finally:
            caller.kill()


def test_nothing_is_left_of_a_run_whose_caller_is_killed(home: Home) -> None:
    with caller_of_a_run() as caller:
        caller.kill()
        caller.wait(WAIT_SECONDS_MAX)
        home.seconds_to_clean()


def test_an_interrupted_call_has_ended_its_run(home: Home) -> None:
    with caller_of_a_run() as caller:
        caller.send_signal(signal.SIGINT)
        assert caller.stdout is not None
        assert readable(caller.stdout.fileno(), WAIT_SECONDS_MAX)
        assert caller.stdout.readline() == b"interrupted\n"
        assert (home.processes(), home.runs()) == ([caller.pid], [])

"""The supervisor of `aftbed run` begins before its command imports anything, and ends with it."""

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest
from liveruns import GONE_SECONDS_MAX, SHORT, Home, until

from aftbed.runtime.unix import linux

pytestmark = pytest.mark.process

# At each fork of the command itself: what it has imported.
NOTING: Final = """
import os, sys
command, forks = os.getpid(), []
def note(event, arguments):
    if event == "os.fork" and os.getpid() == command:
        forks.append(set(sys.modules))
sys.addaudithook(note)
from aftbed.cli import main
sys.argv = ["aftbed", "run", *sys.argv[1:]]
try: main()
finally:
    for modules in forks: print(*sorted(modules), file=sys.stderr)
"""
PRINTING: Final = """
from aftbed.vehicle.aeb.function import AebFunction
class Loud(AebFunction):
    def execute(self, request):
        print("I am loud", flush=True)
        return super().execute(request)
"""


def run(*words: str, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "aftbed", "run", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, cwd=folder)


@pytest.mark.parametrize("words", [("--load", "5"), ("--scenario", str(SHORT), "--pace", "max")])
def test_a_command_forks_its_supervisor_first_and_imports_no_judge_before_the_run(
    words: tuple[str, ...],
) -> None:
    command = [sys.executable, "-c", NOTING, *words, "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    supervisor, warden = (set(line.split()) for line in done.stderr.splitlines())
    assert not {"typer", "msgspec", "ctypes", "aftbed.cli.app"} & supervisor
    assert "aftbed.runtime.unix.launch" in warden
    ours = {name for name in warden if name.startswith("aftbed.")}
    assert not [
        name for name in ours if name.startswith(("aftbed.judge", "aftbed.campaign", "aftbed.report"))
    ]
    assert (
        not {"pydantic", "email", "importlib.metadata", "rich", "can", "cantools", "numpy", "jinja2"} & warden
    )
    assert ("yaml" in warden) == ("--scenario" in words)


@pytest.mark.parametrize(
    "words", [("--load", "nonsense"), ("--load",), ("--seed", "-1"), ("--scenario", "none")]
)
def test_a_command_without_a_run_leaves_no_process(words: tuple[str, ...]) -> None:
    """All processes have its standard streams: what reads them would wait for the last one."""
    done = run(*words)
    assert done.returncode == 2 and done.stdout == "" and "Traceback" not in done.stderr


@contextlib.contextmanager
def killed(*words: str) -> Iterator[int]:
    """The pid of the supervisor of a command that is killed behind the block, and leaves nothing."""
    arguments = [sys.executable, "-m", "aftbed", "run", *words]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as command:
        children = Path(f"/proc/{command.pid}/task/{command.pid}/children")
        try:
            until(children.read_text, "the supervisor")
            yield int(children.read_text().split()[0])
        finally:
            command.send_signal(signal.SIGKILL)
        command.communicate(timeout=GONE_SECONDS_MAX)  # to the end: no process of it has the output open


@pytest.mark.usefixtures("home")
def test_the_supervisor_of_a_command_that_is_killed_ends_with_its_zygotes() -> None:
    """Whenever that is: here, as soon as there is a supervisor."""
    with killed("--scenario", "ccrs-20"):
        pass


@pytest.mark.usefixtures("home")
def test_a_supervisor_that_was_stopped_ends_with_its_command() -> None:
    with killed("--load", "5") as supervisor:
        name = Path(f"/proc/{supervisor}/comm")
        until(lambda: name.read_text().startswith("aftbed-"), "the supervisor, with its name")
        os.kill(supervisor, signal.SIGSTOP)
        until(lambda: linux.state_of(supervisor) == "T", "that it stops")


def test_a_drive_that_looks_like_a_load_has_its_bus_all_the_same(tmp_path: Path) -> None:
    done = run("--scenario", str(SHORT), "--pace", "max", "--json", "--record", "--load", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "--load" / "bus.log").stat().st_size > 0


def test_what_a_node_prints_is_in_the_record_and_nowhere_else(tmp_path: Path, home: Home) -> None:
    """Its zygote was forked with the output of the command, before there was a record."""
    (tmp_path / "loud.py").write_text(PRINTING)
    record = tmp_path / "record"
    app = f"{tmp_path}/loud.py:Loud"
    done = run("--load", "5", "--app", app, "--ftm", "none", "--force", "--json", "--record", str(record))
    assert done.returncode == 0, done.stderr
    assert "I am loud" not in done.stdout + done.stderr
    assert (record / "processes.log").read_text().count("I am loud") == 5
    assert not home.left()

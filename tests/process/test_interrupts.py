"""Ctrl-C in every long command: to all its processes, as a terminal does; to the command alone; and twice.
And SIGTERM: to all, as timeout(1) does; to a command behind `&` in a script, where Ctrl-C is ignored.

A command is interrupted when its line of progress says that it is at work.
"""

import json
import os
import pty
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Final, NamedTuple, Self

import pytest
from homes import WAIT_SECONDS_MAX, Home, home, until
from liveruns import called, readable
from sampling import every

from aftbed.cli.interrupted import EXIT_INTERRUPTED
from aftbed.report.progress import ERASE

__all__ = ["home"]
pytestmark = pytest.mark.process


class LongCommand(NamedTuple):
    """`begun`: what its progress says when it is to be interrupted; `kept`: what its last line says."""

    words: str
    begun: str
    kept: str = ""


COMMANDS: Final = (
    LongCommand("sim --seeds 0..100000 --jobs 2", "of 100 001 runs", "runs were done; --seeds "),
    LongCommand("sim --swarm --minutes 60 --jobs 2", "of 3 600 s", "runs were done; --seed "),
    LongCommand("explore crash --jobs 2", " of ", "nothing is kept"),
    LongCommand("explore pairs --jobs 2", " of ", "nothing is kept"),
    LongCommand("explore adapt --jobs 1", " of ", "nothing is kept"),
    LongCommand("explore order --jobs 2 --bound 100000", "0 of ", "nothing is kept"),
    LongCommand("scenario table ncap --jobs 2", "0 of ", "rows were driven; nothing is kept"),
    LongCommand("scenario ftti --jobs 2", "0 of ", "searches were done; nothing is kept"),
    LongCommand("campaign run bitflip --runtime sim --out kept --jobs 2", " of ", "--resume"),
    LongCommand("campaign run crash --out kept --jobs 2", "0 of ", "--resume"),
    LongCommand("app check aftbed.vehicle.aeb.variants:Cautious --count 20000", "0 of 4 processes"),
    LongCommand("ftm resilience --adaptations 500", "ftm resilience"),
    LongCommand("bench cycle --count 1000 --rounds 40", "1 of "),
    LongCommand("bench hops --count 20000", "bench hops"),
    LongCommand("bench recovery --kills 40 --rounds 40", "1 of "),
    LongCommand("bench adapt --adaptations 40 --rounds 40", "1 of "),
    LongCommand("bench launch", "0 of "),
    LongCommand("bench memory", "bench memory"),
    LongCommand("bench campaign --experiments 20 --rounds 2", "1 of "),
    LongCommand("bench simulator --count 100000 --rounds 2", "0 of "),
    LongCommand("bench state --rounds 1000", "0 of "),
    LongCommand("bench soak --minutes 60 --record kept", "of 3 600 s", "the record is kept in kept"),
    LongCommand("bench all --quick", "bench all: 0 of "),
    LongCommand("bench paper --quick", "bench paper"),
)
CONTROL: Final = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|\r")
HOW: Final = ("to all", "to the command", "twice", "by SIGTERM", "in the background")
BEHIND: Final = ("sh", "-c", 'trap "" INT; exec "$@"', "sh")


class Interrupted:
    """A command with its errors on a terminal, in a directory of its own, also for temporary files."""

    def __init__(self, words: str, folder: Path, how: str = "to the command") -> None:
        self.how = how
        self.folder, self.temporary = folder / "work", folder / "tmp"
        self.folder.mkdir()
        self.temporary.mkdir()
        self._terminal, theirs = pty.openpty()
        self.process = subprocess.Popen(
            [*(BEHIND if how == "in the background" else ()), sys.executable, "-m", "aftbed", *words.split()],
            stdout=subprocess.DEVNULL,
            stderr=theirs,
            start_new_session=True,
            cwd=self.folder,
            env=os.environ | {"TMPDIR": str(self.temporary)},
        )
        os.close(theirs)
        self.errors = ""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self._terminal)

    def wait_for(self, words: str) -> None:
        """Until it has said them."""
        until(lambda: words in self.errors or not self.says_more(), words)
        assert words in self.errors, self.errors

    def says_more(self) -> bool:
        """Wait for what it says next; False at its end."""
        if not readable(self._terminal, WAIT_SECONDS_MAX):
            pytest.fail(f"it says nothing more: {self.errors[-500:]!r}")
        try:
            data = os.read(self._terminal, 65536)
        except OSError:  # the other end is closed
            return False
        self.errors += data.decode()
        return bool(data)

    def interrupt(self) -> None:
        match self.how:
            case "to the command":
                os.kill(self.process.pid, signal.SIGINT)
            case "in the background":
                os.kill(self.process.pid, signal.SIGTERM)
            case "by SIGTERM":
                os.killpg(self.process.pid, signal.SIGTERM)
            case _:
                os.killpg(self.process.pid, signal.SIGINT)

    def end(self) -> int:
        """Its exit code."""
        while self.says_more():
            pass
        return self.process.wait(WAIT_SECONDS_MAX)

    def lines(self) -> list[str]:
        """What is left of its errors when its line of progress is erased."""
        lines = self.errors.replace("\r\n", "\n").split("\n")
        return [CONTROL.sub("", line.rpartition(ERASE)[2]) for line in lines]


def named(value: LongCommand | str) -> str:
    """For the name of a test."""
    return value if isinstance(value, str) else value.words.partition(" --")[0]


CASES: Final = [(command, how) for how in HOW for command in COMMANDS]


@pytest.mark.parametrize(("command", "how"), every(9, CASES), ids=named)
def test_it_ends_with_130_and_leaves_nothing(
    home: Home, tmp_path: Path, command: LongCommand, how: str
) -> None:
    with Interrupted(command.words, tmp_path, how) as began:
        began.wait_for(command.begun)
        began.interrupt()
        if how == "twice" and began.says_more():  # its line is erased: it cleans up
            began.interrupt()
        code, lines = began.end(), began.lines()
    assert code == EXIT_INTERRUPTED, began.errors
    assert not any("Traceback" in line or "Exception" in line for line in lines), began.errors
    assert lines[-2].startswith("aftbed: interrupted") and lines[-1] == "", lines
    if how != "twice":
        assert command.kept in lines[-2]
    assert list(began.temporary.iterdir()) == []
    assert {path.name for path in began.folder.iterdir()} <= {"kept"}
    until(lambda: not home.left(), f"the end of {home.left()}")


def test_what_an_interrupted_campaign_says_goes_on(home: Home, tmp_path: Path) -> None:
    words = "campaign run bitflip --runtime sim --experiments 4 --out kept --jobs 1"
    with Interrupted(words, tmp_path) as began:
        began.wait_for(" of ")
        began.interrupt()
        assert began.end() == EXIT_INTERRUPTED
    last = began.lines()[-2]
    go_on = last.partition("go on: aftbed ")[2].partition(";")[0]
    done = subprocess.run(
        [sys.executable, "-m", "aftbed", *go_on.split()],
        cwd=began.folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode in (0, 1), done.stderr
    assert "records and reports: kept" in done.stdout


def test_a_node_can_be_killed_by_hand(home: Home) -> None:
    """SIGTERM, as of kill(1), is heeded by the command alone as an interrupt."""
    line = [sys.executable, "-m", "aftbed", "run", "--load", "2000@500", "--json"]
    with subprocess.Popen(line, stdout=subprocess.PIPE, text=True) as command:
        pids: dict[str, int] = {}
        until(lambda: pids.update(nodes()) or "a/server" in pids, "a run")
        os.kill(pids["a/server"], signal.SIGTERM)
        out, _ = command.communicate(timeout=WAIT_SECONDS_MAX)
    found = json.loads(out)
    assert (found["verdict"], len(found["failovers"])) == ("pass", 1), found


def nodes() -> dict[str, int]:
    """The pids of the nodes of the live run, by name; none before there is one."""
    done = called("ps", "--json")
    return {row["name"]: row["pid"] for row in json.loads(done.out)} if done.code == 0 else {}


# A command that is interrupted where it imports a module, or where a class of it names a property.
IMPORTING: Final = """
import functools, os, signal, sys
from aftbed.cli import main

def interrupt(moment):
    if moment in moments:
        moments.remove(moment)
        os.kill(os.getpid(), signal.SIGINT)

def named(self, owner, name, real=functools.cached_property.__set_name__):
    interrupt(name)
    real(self, owner, name)

moments, sys.argv = sys.argv[1].split(), ["aftbed", *sys.argv[2:]]
functools.cached_property.__set_name__ = named
sys.addaudithook(lambda event, given: interrupt(given[0]) if event == "import" else None)
main()
"""


@pytest.mark.parametrize(
    ("words", "moments"),
    [
        (("explore", "crash"), "_ends_latent"),
        (("run", "--count", "9"), "typer aftbed.report.progress"),
    ],
    ids=["the interpreter makes another error of it", "again while the end is said"],
)
def test_an_interrupt_while_modules_are_imported_ends_the_command(
    home: Home, words: tuple[str, ...], moments: str
) -> None:
    command = [sys.executable, "-c", IMPORTING, moments, *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=WAIT_SECONDS_MAX)
    assert (done.returncode, done.stderr) == (EXIT_INTERRUPTED, "aftbed: interrupted\n")
    until(lambda: not home.left(), f"the end of {home.left()}")

"""The commands in the pages are run, page by page, in an empty directory, and end as the page says."""

import contextlib
import json
import os
import re
import select
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import command_line
import pytest
from liveruns import PLAIN, called, forked
from pages import PAGES, ROOT, Block, Command, blocks, names, table

from aftbed.judge.verdict import CHECKERS

SECONDS_MAX: Final = 180.0  # of one command, on a machine under load
PAGE_SECONDS_MAX: Final = 900
INCONCLUSIVE: Final = 3
STARVED: Final = re.compile(r"^ *because +ftti: a node waited [\d.]+ ms for a CPU", re.MULTILINE)
STARVED_MAX: Final = 3  # times that one command is run
DOCS: Final = ROOT / "docs"
BELOW_THE_TABLE: Final = ("value", "at_rest", "assertions")  # with a bitflip; of simulated runs
LONG_DRIVE: Final = """\
description: an empty road, for as long as the page's commands take
duration_s: 600
ego: {speed_kmh: 80}
expect: {outcome: no_braking}
"""
PYTHON: Final[dict[str, tuple[str, ...]]] = {
    "python": (),
    "pytest": ("-m", "pytest", "-q", "-p", "no:cacheprovider", *command_line.PLUGIN),
}
_PLACEHOLDER: Final = re.compile(r"\.\.\.|\b[0-9a-f]{6}\b|\b\d+(?= late)")  # left out, ids, real time

pytestmark = pytest.mark.process


@pytest.fixture
def private(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Live runs of this test only: its own place for their sockets, whose path has to be short."""
    path = Path(tempfile.mkdtemp(prefix="aft-", dir="/tmp"))
    for name in (
        "XDG_RUNTIME_DIR",
        "TMPDIR",
    ):  # with what others of this user have left, doctor is not content
        monkeypatch.setenv(name, str(path))
    yield path
    left = list((path / "aftbed").iterdir()) if (path / "aftbed").exists() else []
    shutil.rmtree(path)
    assert left == [], "a run was left behind"


def aftbed(words: list[str], folder: Path, *, live: bool = False) -> subprocess.CompletedProcess[str]:
    """Run one command of a page to its end, in this process if it starts none.

    One about a `live` run has a process of its own, as a person's: the run deals with it meanwhile. One that
    cannot judge a time, because a node of its run has waited for a CPU, is run again.
    """
    for _ in range(STARVED_MAX):
        if words[0] in PLAIN and not live:
            with contextlib.chdir(folder):
                done = called(*words)
        else:
            done = forked(*words, folder=folder, seconds=SECONDS_MAX)
        if done.code != INCONCLUSIVE or STARVED.search(done.out) is None:
            break
    return subprocess.CompletedProcess(words, done.code, done.out, done.err)


def python(words: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """Run `python FILE` or `pytest ...` of a page with this interpreter."""
    return command_line.called(sys.executable, *PYTHON[words[0]], *words[1:], folder=folder)


class LiveRun:
    """A drive in the background, for the commands of a second terminal."""

    def __init__(self, folder: Path) -> None:
        (folder / "long.yaml").write_text(LONG_DRIVE)
        arguments = ["run", "--scenario", "long.yaml"]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "aftbed", *arguments],
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
        )
        self._text = b""
        self._read_until(b"started: ")

    def _read_until(self, words: bytes) -> None:
        """Read its output until `words` stand in it; with `b""`, to its end."""
        assert self._process.stdout is not None
        limit = time.monotonic() + SECONDS_MAX
        poll = select.poll()
        poll.register(self._process.stdout, select.POLLIN)
        while not words or words not in self._text:
            assert poll.poll(max(0.0, limit - time.monotonic()) * 1e3), self._text.decode()
            got = os.read(self._process.stdout.fileno(), 65536)
            if not got:
                assert not words, self._text.decode()
                return
            self._text += got

    @property
    def alive(self) -> bool:
        """Whether the command has not ended."""
        return self._process.poll() is None

    def end(self) -> None:
        """Have it end, if no command of the page has, and see it to its end."""
        if self.alive:
            self._process.terminate()
        self._read_until(b"")
        self._process.wait(SECONDS_MAX)
        assert self._process.stdout is not None
        self._process.stdout.close()

    def kill(self) -> None:
        """Whatever happened."""
        self._process.kill()
        self._process.wait()
        assert self._process.stdout is not None
        self._process.stdout.close()


def matches(shown: str, output: str) -> bool:
    """Whether the line `shown` begins a line of `output`; what is `_PLACEHOLDER` stands for anything."""
    pattern = ".*".join(re.escape(part) for part in _PLACEHOLDER.split(shown))
    return re.search(f"^{pattern}", output, re.MULTILINE) is not None


def check(block: Block, command: Command, done: subprocess.CompletedProcess[str]) -> None:
    """Compare how a command ended with what its block says."""
    where = f"{block.page}:{block.number}: $ {command.line}\n{done.stdout}{done.stderr}"
    assert done.returncode == int(block.value("exit", "0")), where
    if "exact" in block.words:
        for shown in command.shown:
            assert matches(shown, done.stdout + done.stderr), f"{where}\nnot found: {shown}"


def run_page(page: Path, folder: Path, lives: list[LiveRun]) -> int:
    """Run all commands of `page`; how many there were. `lives` gets live runs, for the caller to end."""
    count = 0
    for block in blocks(page):
        if name := block.value("file"):
            (folder / name).write_text("\n".join(block.lines) + "\n")
        if block.language != "console" or "norun" in block.words:
            continue
        for command in block.commands():
            words = shlex.split(command.line)
            if words[0] in PYTHON:
                check(block, command, python(words, folder))
                count += 1
            if words[0] != "aftbed":
                continue
            if "each" in block.words and lives:  # what one command does would meet the next one
                lives.pop().end()
            if "live" in block.words and not (lives and lives[-1].alive):
                lives.append(LiveRun(folder))
            check(block, command, aftbed(words[1:], folder, live="live" in block.words))
            count += 1
            if words[1] == "stop":
                lives.pop().end()
        if "each" in block.words:
            lives.pop().end()
    return count


@pytest.mark.timeout(PAGE_SECONDS_MAX)
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=page.name, marks=pytest.mark.xdist_group(page.name))
        for page in PAGES
        if page.name != "contributing.md"
    ],
)
def test_the_commands_of_a_page_end_as_it_says(page: Path, tmp_path: Path, private: Path) -> None:
    shutil.copy(ROOT / "dbc" / "aftbed.dbc", tmp_path)
    lives: list[LiveRun] = []
    try:
        run_page(page, tmp_path, lives)
        for live in lives:
            live.end()
    finally:
        for live in lives:
            live.kill()


ONLY_WITH_A_POLICY: Final = {"policy", "proposals"}


def test_the_document_of_a_run_is_described_key_by_key(tmp_path: Path, private: Path) -> None:
    done = aftbed(["run", "--scenario", "ccrs-20", "--pace", "max", "--json"], tmp_path)
    found = json.loads(done.stdout)
    keys = [name for row in table(DOCS / "commands.md", "key") for name in names(row[0])]
    assert set(keys) == set(found) | ONLY_WITH_A_POLICY
    described = [names(row[0])[0] for row in table(DOCS / "record.md", "check")]
    assert [name for name in described if name in found["checks"]] == list(found["checks"])
    assert {*described, *BELOW_THE_TABLE} == {checker.name for checker in CHECKERS}


@pytest.mark.parametrize(
    "text",
    [
        "```console\n$ aftbed status\n```\n",
        "```console exit=2 exact\n$ aftbed status\naftbed: all is well\n```\n",
    ],
    ids=["another exit code", "another output"],
)
def test_a_page_that_is_wrong_is_refused(text: str, tmp_path: Path, private: Path) -> None:
    page = tmp_path / "wrong.md"
    page.write_text(text)
    with pytest.raises(AssertionError, match="no run is alive"):
        run_page(page, tmp_path, [])

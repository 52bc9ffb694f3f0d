"""The examples of docs/contributing.md work: each is applied to a copy of the package, which is then used.

In a section, a block with `file=PATH` is written to PATH; a `diff` block replaces its lines with `-` by those
with `+` (lines with a blank stand around them), and must fit exactly one place of its file. Then the
commands of the section are run with the copy.
"""

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest
from pages import ROOT, Block, Command, blocks
from test_commands import check

pytestmark = pytest.mark.process

PAGE: Final = ROOT / "docs" / "contributing.md"
SECONDS_MAX: Final = 180


def sections() -> dict[str, list[Block]]:
    """The blocks below each heading of the second level."""
    heading, found = "", dict[str, list[Block]]()
    numbered = dict(enumerate(PAGE.read_text().splitlines(), 1))
    by_line = {block.number: block for block in blocks(PAGE)}
    for number, line in numbered.items():
        if line.startswith("## "):
            heading = line[3:]
        if number in by_line:
            found.setdefault(heading, []).append(by_line[number])
    return found


SECTIONS: Final = sections()


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A copy of the package, with its bytecode."""
    shutil.copytree(ROOT / "aftbed", tmp_path / "aftbed")
    shutil.copytree(ROOT / "dbc", tmp_path / "dbc")
    return tmp_path


def apply(block: Block, project: Path) -> None:
    path = project / block.value("file")
    if block.language != "diff":
        path.write_text("\n".join(block.lines) + "\n")
        return
    text = path.read_text()
    old = "\n".join(line[1:] for line in block.lines if line[0] in " -")
    new = "\n".join(line[1:] for line in block.lines if line[0] in " +")
    assert text.count(old) == 1, f"{block.page}:{block.number}: fits {text.count(old)} places of {path.name}"
    path.write_text(text.replace(old, new))


def aftbed(command: Command, project: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "aftbed", *shlex.split(command.line)[1:]],
        cwd=project,
        env=os.environ | {"PYTHONPATH": str(project)},
        capture_output=True,
        text=True,
        timeout=SECONDS_MAX,
        check=False,
    )


@pytest.mark.timeout(600)
@pytest.mark.parametrize("section", SECTIONS)
def test_an_example_works(section: str, project: Path) -> None:
    commands = 0
    for block in SECTIONS[section]:
        if block.value("file"):
            apply(block, project)
        elif block.language == "console":
            for command in block.commands():
                check(block, command, aftbed(command, project))
                commands += 1
    assert commands, "no command shows that it works"


def test_every_kind_of_addition_has_its_example() -> None:
    assert set(SECTIONS) == {
        "A mechanism",
        "A fault kind",
        "An event",
        "A check",
        "A scenario",
        "A campaign",
        "A command",
    }

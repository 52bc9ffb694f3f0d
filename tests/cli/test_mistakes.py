"""What a new user does wrong, with the whole message of each: the table is mistakes.txt.

A mistake is a line `$ aftbed ...`, and below it what is printed behind `aftbed: error: `; `...` at its end
stands for the rest. The files that they name are FILES below.
"""

import re
import shlex
from pathlib import Path
from typing import Final

import pytest
from fakerun import Call, Output

from aftbed.cli.app import COMMANDS

TABLE: Final = Path(__file__).parent / "mistakes.txt"
PROMPT: Final = "$ aftbed "
SCENARIO: Final = "description: a car\nduration_s: 9\nego: {speed_kmh: 50}\n"
CAMPAIGN: Final = (
    "campaign: mine\nabout: x\nseed: 1\nsystem: {runtime: sim, requests: 40}\nmechanisms: [pbr]\n"
)
FILES: Final = {
    "empty.yaml": "",
    "notes.yaml": "todo: buy milk: 1 l\n",
    "unit.yaml": SCENARIO + "lead: {ttc_s: 4, speed: 0}\nexpect: {outcome: stop}\n",
    "both.yaml": SCENARIO + "lead: {ttc_s: 4, gap_m: 50, speed_kmh: 0}\nexpect: {outcome: stop}\n",
    "faults.yaml": CAMPAIGN + "faults:\n- {name: crash, fault: kill primary}\nstop: {experiments: 4}\n",
    "names.yaml": CAMPAIGN
    + "faults:\n- {name: crash, fault: crash primary, mechanisms: [lfr]}\nstop: {experiments: 4}\n",
    "policy.yaml": "dwell_s: 5\nrules:\n- {when: {event: crash, quiet_s: 1}, then: swich lfr}\n",
    "table.yaml": "rows:\n- {mechanism: lrf, cpus: 2}\n",
    "script.yaml": "purpose: x\ncommit:\n- {suspnd: a/protocol}\n",
    "mine.py": "class Mine: pass\n",
    "times.json": '{"from": "pbr", "to": 3}',
    "empty.log": "",
    "empty.xosc": "",
    "empty.zip": "",
    "folder/a.txt": "",
}


def rows() -> list[tuple[str, str]]:
    """Each command line, without the name of the program, and its message."""
    blocks = re.split(rf"^{re.escape(PROMPT)}", TABLE.read_text(), flags=re.MULTILINE)[1:]
    return [(head, message) for head, _, message in (block.partition("\n") for block in blocks)]


ROWS: Final = rows()


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The files that the mistakes are about, in the current directory."""
    for name, content in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(content)
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(("words", "message"), ROWS, ids=[words for words, _ in ROWS])
def test_a_mistake_is_told_in_our_words(refused: Output, words: str, message: str) -> None:
    found = refused(*shlex.split(words)).removeprefix("aftbed: error: ").replace(f"{Path.cwd()}/", "")
    shown, cut, _ = message.partition("...\n")
    assert found.startswith(shown) if cut else found == message


def test_every_command_has_a_mistake() -> None:
    assert set(COMMANDS) <= {words.split()[0] for words, _ in ROWS}
    assert len(ROWS) >= 40 and len({words for words, _ in ROWS}) == len(ROWS)


def test_a_group_without_a_command_gets_its_help(call: Call) -> None:
    code, out, err = call("campaign")
    assert (code, out) == (2, "") and err.startswith("Usage: ") and "Commands:" in err

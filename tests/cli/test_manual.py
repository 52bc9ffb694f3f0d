"""The manual page: what is in it, and that the programs which show it take it without a warning."""

import shutil
import subprocess
from pathlib import Path

import pytest
from fakerun import Output

from aftbed.cli.completer import complete
from aftbed.cli.manual import EXAMPLES, manual_page

READERS = {
    "man": ["man", "--warnings", "-l"],
    "groff": ["groff", "-man", "-Tutf8", "-ww"],
    "mandoc": ["mandoc", "-Tlint"],
}
NO_DATE = 'WARNING: missing date, using "": TH'  # the page is as old as the code that prints it


@pytest.fixture(scope="module")
def page() -> str:
    return manual_page()


@pytest.mark.parametrize("reader", list(READERS))
def test_it_is_read_without_a_warning(reader: str, page: str, tmp_path: Path) -> None:
    if shutil.which(reader) is None:
        pytest.skip(f"{reader} is not installed")
    path = tmp_path / "aftbed.1"
    path.write_text(page, encoding="ascii")
    done = subprocess.run([*READERS[reader], path], capture_output=True, text=True, check=False)
    said = done.stdout if reader == "mandoc" else done.stderr
    assert [line for line in said.splitlines() if not line.endswith(NO_DATE)] == []


def test_it_has_each_command_with_its_options(page: str) -> None:
    for words in (["run"], ["inject", "bitflip"], ["adapt", "compose"], ["scenario", "ftti"]):
        at = page.index(f".SS aftbed {' '.join(words)}\n")
        section = page[at : page.find(".SS", at + 1)]
        options = [word for word, _ in complete([*words, "--"]).words if word != "--help"]
        missing = [option for option in options if option.replace("-", r"\-") not in section]
        assert missing == [], words
    assert ".SS aftbed completion answer" not in page, "it is for the scripts"


def test_it_says_what_no_help_says(page: str) -> None:
    for title in ("NAME", "SYNOPSIS", "EXIT STATUS", "ENVIRONMENT", "FILES", "EXAMPLES", "SEE ALSO"):
        assert f"\n.SH {title}\n" in page


def test_each_example_is_a_command_that_there_is() -> None:
    for _, line in EXAMPLES:
        words = line.removeprefix('eval "$(').removesuffix(')"').split()
        assert words[0] == "aftbed" and complete([words[1]]).words, line


def test_it_is_printed_where_no_terminal_is(output: Output, page: str) -> None:
    assert output("man") == page

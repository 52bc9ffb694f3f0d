"""The README and the pages of `docs/`, taken apart: fenced blocks, tables, links, sections.

A fenced block's first line says what it is, and what a test does with it:

    ```console                 run each `$ aftbed ...` in order, exit code 0 expected
    ```console exit=2          another exit code
    ```console exact           and every line shown must stand in the output, as far as it is shown
    ```console live            run it against a live run, which the test starts
    ```console norun           do not run it
    ```console live each       each command with a live run of its own
    ```yaml file=NAME          write it to NAME before what follows is run
    ```diff file=NAME          see `test_contributing`
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import msgspec

ROOT: Final = Path(__file__).resolve().parents[2]
PAGES: Final = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))

_LINK: Final = re.compile(r"(?<!!)\[[^\]]+\]\(([^)\s]+)\)")
_IMAGE: Final = re.compile(r"!\[[^\]]+\]\(([^)\s]+)\)")
_HEADING: Final = re.compile(r"#{1,6} (.+)")
_CODE: Final = re.compile(r"`([^`]+)`")


class Command(msgspec.Struct, frozen=True):
    """A command as shown, without its `$`, and the lines shown below it."""

    line: str
    shown: tuple[str, ...]


class Block(msgspec.Struct, frozen=True):
    """A fenced block; `words` are those behind its language."""

    page: str
    number: int
    language: str
    words: tuple[str, ...]
    lines: tuple[str, ...]

    def value(self, key: str, default: str = "") -> str:
        """`VALUE` of a word `KEY=VALUE`."""
        return next((w.partition("=")[2] for w in self.words if w.startswith(f"{key}=")), default)

    def commands(self) -> list[Command]:
        """What stands behind `$ `, with its output."""
        found: list[tuple[str, list[str]]] = []
        for line in self.lines:
            if line.startswith("$ "):
                found.append((line[2:], []))
            elif found:
                found[-1][1].append(line)
        return [Command(line, tuple(shown)) for line, shown in found]


def blocks(page: Path) -> Iterator[Block]:
    """The fenced blocks of `page`, in order. A block that is not closed is an error."""
    inside: tuple[int, str] | None = None
    lines: list[str] = []
    for number, line in enumerate(page.read_text().splitlines(), 1):
        if not line.startswith("```"):
            lines.append(line)
        elif inside is None:
            inside, lines = (number, line[3:].strip()), []
        else:
            language, *words = inside[1].split() or [""]
            yield Block(page.name, inside[0], language, tuple(words), tuple(lines))
            inside = None
    assert inside is None, f"{page.name}:{inside}: the block is not closed"


def prose(page: Path) -> str:
    """The text without its fenced blocks."""
    kept, fenced = [], False
    for line in page.read_text().splitlines():
        if line.startswith("```"):
            fenced = not fenced
        elif not fenced:
            kept.append(line)
    return "\n".join(kept)


def links(page: Path) -> list[str]:
    """The targets of all links."""
    return _LINK.findall(prose(page))


def images(page: Path) -> list[str]:
    """The targets of all images; each has words, for screen readers."""
    return _IMAGE.findall(prose(page))


def anchors(page: Path) -> set[str]:
    """The anchors that the headings make, as code hosts make them."""
    found = set()
    for line in prose(page).splitlines():
        heading = _HEADING.fullmatch(line)
        if heading:
            words = re.sub(r"[^\w\- ]", "", heading[1].lower())
            found.add(words.replace(" ", "-"))
    return found


def sections(page: Path) -> dict[str, str]:
    """The prose below each heading of the second level, by heading."""
    found: dict[str, str] = {}
    title = ""
    for line in prose(page).splitlines():
        if line.startswith("## "):
            title = line[3:]
        if title:
            found[title] = found.get(title, "") + line + "\n"
    return found


def table(page: Path, first_heading: str) -> list[tuple[str, ...]]:
    """The rows of all tables of `page` whose first column is headed `first_heading`."""
    rows: list[tuple[str, ...]] = []
    taking = False
    for line in prose(page).splitlines():
        if not line.startswith("|"):
            taking = False
            continue
        cells = tuple(cell.strip() for cell in line.strip("|").split("|"))
        if taking and not set(cells[0]) <= set("-: "):
            rows.append(cells)
        taking = taking or cells[0] == first_heading
    return rows


def names(cell: str) -> list[str]:
    """What stands in `backticks` in a cell."""
    return _CODE.findall(cell)

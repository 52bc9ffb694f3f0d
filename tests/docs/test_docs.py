"""The documentation is true: its names exist, its links lead somewhere, its options are all there are."""

import pkgutil
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest
import typer
from pages import PAGES, ROOT, anchors, blocks, images, links, names, prose, sections, table
from requestpath import REQUEST_PATH

from aftbed.cli import EXIT_READER_GONE, EXIT_USAGE
from aftbed.cli.app import app
from aftbed.cli.interrupted import EXIT_INTERRUPTED
from aftbed.cli.lazy import LazyCommand
from aftbed.core.events import BY_LABEL
from aftbed.core.graph import PLACEMENTS
from aftbed.ftm.compose import EXPRESSIONS, build
from aftbed.ftm.registry import EMITTERS
from aftbed.inject import targets
from aftbed.interop.logs import EXTENDED, FD, FrameKind
from aftbed.judge.verdict import EXIT_CODES
from aftbed.vehicle.can.candump import Refusal
from aftbed.vehicle.can.dbc_file import load_dbc
from aftbed.vehicle.ecus import BRAKE_POLICIES
from aftbed.vehicle.scenarios.library import load_scenario, scenario_names

DOCS: Final = ROOT / "docs"
README: Final = ROOT / "README.md"
PICTURE_BYTES_MAX: Final = 200_000
NOT_OURS: Final = {"--rewrite"}  # options of other programs
_PATH: Final = re.compile(r"(?<![\w./-])aftbed/[\w/]+(?:\.py|/)(?!\w)")
_FILE: Final = re.compile(r"(?:[a-z_]+/)*[a-z_]+\.py")
_MODULE: Final = re.compile(r"(?<![\w./-])aftbed(?:\.\w+){2,}")


def commands() -> Iterator[tuple[str, list[str]]]:
    """Every command of the command line, as `inject crash`, with the options and arguments it takes."""

    def walk(command: object, path: tuple[str, ...]) -> Iterator[tuple[str, list[str]]]:
        if isinstance(command, LazyCommand):
            command = command.load()
        children = getattr(command, "commands", None)
        if children is not None:
            for name, child in children.items():
                yield from walk(child, (*path, name))
            return
        options = []
        for parameter in command.params:  # type: ignore[attr-defined]
            if parameter.param_type_name == "argument":
                options.append(parameter.name.upper())
            else:
                options += [*parameter.opts, *parameter.secondary_opts]
        yield " ".join(path), options

    return walk(typer.main.get_command(app), ())


COMMANDS: Final = dict(commands())


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_relative_link_leads_somewhere(page: Path) -> None:
    for link in (*links(page), *images(page)):
        if "://" in link:
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), f"{page.name}: {link}"
        assert target.is_relative_to(ROOT), f"{page.name}: {link} leads out of the project"
        if anchor:
            assert anchor in anchors(target), f"{page.name}: {link}; there are {sorted(anchors(target))}"


def test_every_picture_is_small_and_shown() -> None:
    shown = {(page.parent / image).resolve() for page in PAGES for image in images(page)}
    pictures = set((DOCS / "pictures").iterdir())
    assert pictures <= shown and len(pictures) >= 4
    assert all(path.stat().st_size < PICTURE_BYTES_MAX for path in pictures), (
        "make pictures makes them smaller"
    )


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_block_is_of_a_known_kind(page: Path) -> None:
    allowed = {"each", "exact", "live", "norun"}
    for block in blocks(page):
        strange = {w for w in block.words if w not in allowed and w.partition("=")[0] not in ("exit", "file")}
        assert not strange, f"{page.name}:{block.number}: {strange}"
        if block.language == "console":
            assert block.commands(), f"{page.name}:{block.number}: no command"


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_an_example(command: str) -> None:
    examples = [c.line for block in blocks(DOCS / "commands.md") for c in block.commands()]
    assert any(f"{line} ".startswith(f"aftbed {command} ") for line in examples)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_option_that_is_named_exists(page: Path) -> None:
    known = {name for options in COMMANDS.values() for name in options} | {"--help", "--version"}
    named = {name.split()[0].rstrip(",") for name in names(prose(page)) if name.startswith("--")}
    assert named - known <= NOT_OURS


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_module_that_is_named_exists(page: Path) -> None:
    made = {block.value("file") for block in blocks(page)}
    text = page.read_text()
    for name in (*_PATH.findall(text), *(n for n in names(prose(page)) if _FILE.fullmatch(n))):
        found = any((folder / name).exists() for folder in (ROOT, ROOT / "aftbed"))
        bare = "/" not in name and any(any((ROOT / top).rglob(name)) for top in ("aftbed", "tests"))
        assert found or bare or name in made, f"{page.name}: {name}"
    for name in _MODULE.findall(text):
        if not any(path.removesuffix(".py").replace("/", ".") == name for path in made):
            pkgutil.resolve_name(name)


def test_every_command_in_the_pages_exists() -> None:
    for page in PAGES:
        if page.name == "contributing.md":  # it adds one: see `test_contributing`
            continue
        for block in blocks(page):
            for shown in block.commands() if block.language == "console" else ():
                words = shown.line.split()
                if words[0] != "aftbed":
                    continue
                known = " ".join(words[1:2]) in COMMANDS or " ".join(words[1:3]) in COMMANDS
                assert known or words[1:] == ["--help"], f"{page.name}:{block.number}: {shown.line}"


def test_the_triggers_of_the_table_are_those_that_are_emitted() -> None:
    rows = {names(row[0])[0]: row[1] for row in table(DOCS / "faults.md", "event") if len(row) == 3}
    assert set(rows) <= set(BY_LABEL)
    emitted = {event.label: who for event, who in EMITTERS.items()}
    assert set(emitted) <= set(rows), "an event that can be aimed at is not documented"
    for event, (part, of_backup) in emitted.items():
        beside = part in ("client", "proxy", "recovery")
        expected = part if beside else f"the {'backup' if of_backup else 'leader'}'s {part}"
        assert rows[event] == expected, event


def test_the_request_path_is_in_its_order() -> None:
    rows = [names(row[0])[0] for row in table(DOCS / "faults.md", "event")]
    assert rows[: len(REQUEST_PATH)] == [event.label for event in REQUEST_PATH]


def test_the_targets_of_the_table_exist() -> None:
    nodes = {n for placement in PLACEMENTS for n in build("pbr", placement).nodes}
    known = {*targets.ROLES, *targets.OTHERS, *nodes}
    found = {name for row in table(DOCS / "faults.md", "target") for name in names(row[0])}
    assert found <= known
    assert {*targets.ROLES, *targets.OTHERS} - found <= {"supervisor"}


def test_the_scenarios_of_the_table_are_those_that_are_shipped() -> None:
    rows = {names(row[0])[0]: row for row in table(DOCS / "scenarios.md", "scenario")}
    assert set(rows) == set(scenario_names())
    for name, (_, speed, _, expected) in rows.items():
        scenario = load_scenario(name)
        assert speed == f"{scenario.plant.speed_ms * 3.6:.0f} km/h"
        gap_m = scenario.expect.stop_gap_m_min
        words = scenario.expect.outcome.replace("_", " ")
        assert expected.startswith(words) and (f"at least {gap_m} m" in expected) == (gap_m > 0), name


def test_the_brake_policies_of_the_table_are_all_there_are() -> None:
    assert [names(row[0])[0] for row in table(DOCS / "scenarios.md", "policy")] == list(BRAKE_POLICIES)


def test_the_frames_of_the_table_are_those_of_the_dbc() -> None:
    codec = load_dbc()
    for row in table(DOCS / "scenarios.md", "frame"):
        for name, can_id in zip(names(row[0]), row[1].split(", "), strict=True):
            assert codec.can_id(name) == int(can_id, 16)
            assert codec.cycle_us(name) == int(row[2].removesuffix(" ms")) * 1000


def test_the_reasons_to_leave_out_a_frame_of_a_log_are_all_there_are() -> None:
    rows = {name for row in table(DOCS / "replay.md", "reason") for name in names(row[0])}
    kinds = {kind.value for kind in FrameKind if kind is not FrameKind.DATA}
    assert {str(Refusal.TORN), str(Refusal.TIME), EXTENDED, FD} | kinds <= rows


def test_the_exit_codes_are_those_of_the_command_line() -> None:
    wanted = {str(code) for code in (*EXIT_CODES.values(), EXIT_USAGE, EXIT_INTERRUPTED, EXIT_READER_GONE)}
    for page in (README, DOCS / "commands.md"):
        assert {row[0] for row in table(page, "code")} == wanted, page.name


def test_the_mechanisms_and_placements_are_named() -> None:
    text = sections(DOCS / "commands.md")["aftbed run"]
    for name in (*EXPRESSIONS, *PLACEMENTS):
        assert f"`{name}`" in text


def test_the_readme_names_every_promise_and_begins_with_the_two_commands() -> None:
    assert [row[0] for row in table(README, "promise")] == [f"G{n}" for n in range(1, 9)]
    first = next(block for block in blocks(README) if block.language == "console")
    assert [c.line for c in first.commands()] == ["make demo", "make test"]


def test_every_page_is_linked_from_the_readme() -> None:
    linked = {(README.parent / link.partition("#")[0]).resolve() for link in links(README)}
    assert {page for page in PAGES if page != README} <= linked


PAGE: Final = """\
# A b

[x](gone.md#y)

| event | n |
|---|---|
| `no.such` | 1 |

```console
$ a
b
```
"""


def test_the_tools_of_these_tests_see_what_is_there(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(PAGE)
    assert links(page) == ["gone.md#y"] and anchors(page) == {"a-b"}
    assert table(page, "event") == [("`no.such`", "1")]
    assert "$ a" not in prose(page)
    (block,) = blocks(page)
    assert [(c.line, c.shown) for c in block.commands()] == [("a", ("b",))]

"""What is made of the document of `aftbed bench paper`: tables, markdown, the page."""

import re
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest
from browser import in_browser, measured, needs_browser
from papers import made_up

from aftbed.bench.paper import Paper, html_page, markdown, notes, size, tables, text


def row(name: str, first: str) -> tuple[str, ...]:
    """The row of the table `name` that begins with `first`."""
    table = next(table for table in tables(made_up()) if table.name == name)
    return next(row for row in table.rows if row[0].startswith(first))


def test_theirs_and_ours_stand_side_by_side() -> None:
    assert row("times", "cycle of pbr") == ("cycle of pbr", "4 to 5", "0.2", "0.4", "2.67", "3")
    assert row("times", "the bare ring") == ("the bare ring of 12 hops", "-", "0.076", "0.09", "1", "3")
    assert row("processes", "pbr, process") == ("pbr, process", "17", "17")


def test_what_a_time_is_on_the_road() -> None:
    assert row("road", "cycle of pbr")[1:3] == ("5.6 cm to 6.9 cm", "3.6 km/h to 4.0 km/h")
    assert row("road", "start") == ("start", "-", "-", "5.67 m", "36.0 km/h", "5.67 m", "36.0 km/h")


def test_a_time_in_which_requests_are_served_costs_no_way() -> None:
    assert row("road", "whole") == ("whole", "4.17 m", "30.9 km/h", "served meanwhile", "-", "-", "-")


def test_a_size_that_is_not_carried_says_so_and_why() -> None:
    assert row("state", "10 MB") == ("10 MB", "pbr", "-", "-", "-", "-", "-", "not carried")
    assert "State of 10 MB under pbr: too large." in notes(made_up())


def test_every_row_has_as_many_cells_as_the_head() -> None:
    for table in tables(made_up()):
        assert table.rows and {len(row) for row in table.rows} == {len(table.head)}, table.name


def test_markdown_is_of_whole_tables() -> None:
    lines = list(markdown(made_up()))
    rows = [line for line in lines if line.startswith("|")]
    heads = [number for number, line in enumerate(lines) if line.startswith("| --- |")]
    assert len(heads) == len(tables(made_up())) and len(rows) > 2 * len(heads)
    for at in heads:
        assert lines[at - 2] == "" and lines[at].count("|") == lines[at - 1].count("|") == lines[
            at + 1
        ].count("|")


def test_the_terminal_gets_all_tables_and_notes() -> None:
    said = "\n".join(text(made_up(note="noted")))
    for words in ("cycle of pbr", "served meanwhile", "not carried", "start: noted.", "something is missing"):
        assert words in said


def test_a_document_can_be_read_back() -> None:
    paper = made_up()
    assert msgspec.json.decode(msgspec.json.encode(paper), type=Paper) == paper


@pytest.mark.parametrize(
    ("count_bytes", "said"), [(100, "100 B"), (1000, "1 kB"), (60_000, "60 kB"), (1e7, "10 MB")]
)
def test_sizes_are_said_for_people(count_bytes: float, said: str) -> None:
    assert size(count_bytes) == said


# -- the page


def test_the_page_has_every_table_and_plot_and_no_script() -> None:
    page = html_page(made_up())
    assert page.count("<table>") == len(tables(made_up())) and page.count('class="plot') == 5
    assert "<script" not in page and "http" not in re.sub(r'xmlns="[^"]*"', "", page)


def test_the_page_escapes_what_it_is_given() -> None:
    page = html_page(made_up(note="<script>alert(1)</script>", refused="<b>"))
    assert "<script>" not in page and "&lt;script&gt;" in page and "<b>" not in page


def test_a_sweep_without_points_is_no_plot() -> None:
    bare = msgspec.structs.replace(made_up(), state=(), load=())
    page = html_page(bare)
    assert page.count('class="plot') == page.count('<figure class="bars">') == 1, "bars, and a legend of bars"
    assert page.count('class="plot broad"') == 1, "as wide as the page"


@needs_browser
@pytest.mark.process
def test_the_page_in_a_browser_has_all_in_its_place(tmp_path: Path) -> None:
    dom, console = in_browser(tmp_path, measured(html_page(made_up())))
    assert console == [] and "<title>measured 0 0 0 1 0</title>" in dom and dom.count('class="plot') == 5


def test_the_benches_leave_the_libraries_of_pages_alone() -> None:
    """They fork the processes whose memory they measure."""
    code = "import sys, aftbed.bench.paper as p, aftbed.bench.campaign; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert not {"matplotlib", "jinja2", "scipy", "numpy", "rich"} & set(done.stdout.split())

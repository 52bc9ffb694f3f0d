"""What is made of the document of `aftbed bench paper`: tables, markdown, the page."""

import re

import msgspec
import pytest
from papers import made_up

from aftbed.bench import curves
from aftbed.bench.curves import Range
from aftbed.bench.paperdocument import Paper
from aftbed.bench.paperpage import html_page
from aftbed.bench.papertext import markdown, notes, size, tables, text


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
    assert page.count("<table>") == len(tables(made_up())) and page.count('class="plot"') == 5
    assert "<script" not in page and "http" not in re.sub(r'xmlns="[^"]*"', "", page)


def test_the_page_escapes_what_it_is_given() -> None:
    page = html_page(made_up(note="<script>alert(1)</script>", refused="<b>"))
    assert "<script>" not in page and "&lt;script&gt;" in page and "<b>" not in page


def test_a_sweep_without_points_is_no_plot() -> None:
    bare = msgspec.structs.replace(made_up(), state=(), load=())
    assert html_page(bare).count('class="plot"') == 1


def numbers(drawing: str, name: str) -> list[float]:
    return [float(found) for found in re.findall(rf' {name}="([-0-9.]+)"', drawing)]


def test_every_point_lies_in_the_drawing() -> None:
    drawing = curves.curves("t", {"a": [(1, 5.0), (10_000, 0.5)], "b": [(20, 700.0)]}, "x", "y")
    assert drawing.count("<circle") == 3
    assert all(0 <= x <= 560 for x in numbers(drawing, "cx"))
    assert all(0 <= y <= 250 for y in numbers(drawing, "cy"))
    left, right, _ = numbers(drawing, "cx")
    low, high, highest = numbers(drawing, "cy")
    assert left < right and low < high and highest < low  # up is less in SVG


def test_a_range_has_a_bar_for_each_side_that_is_known() -> None:
    rows = [Range("both", (4, 5), (0.1, 0.2)), Range("ours alone", None, (400, 400))]
    drawing = curves.ranges("t", rows)
    assert drawing.count('class="range"') == 3
    assert "both: the paper: 4 to 5 ms" in drawing and "ours alone: here, p50 to p99: 400 ms" in drawing

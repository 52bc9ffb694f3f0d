"""Plots: their words and tooltips, where their points lie, and that equal data give equal bytes."""

import html
import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from random import Random
from typing import Final
from xml.etree import ElementTree

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from aftbed.report import plots
from aftbed.report.plots import (
    BAD,
    COLOURS,
    HEIGHT,
    LINES,
    POINTS_MAX,
    RANGES_PX,
    WIDTH,
    FttiCurve,
    Limit,
    RoadCurve,
    RoadPoint,
    TimeBand,
    TimeRange,
    curves,
    ecdf,
    ftti_plot,
    line_style,
    ranges,
    road_plot,
)

SVG: Final = "{http://www.w3.org/2000/svg}"
TIMES = st.lists(st.floats(0, 1e6), min_size=1, max_size=60)
few_examples = settings(max_examples=settings.default.max_examples // 4)  # a drawing takes 20 ms


def elements(drawing: str, tag: str) -> list[ElementTree.Element]:
    return [e for e in ElementTree.fromstring(drawing).iter() if e.tag.removeprefix(SVG) == tag]


def texts(drawing: str) -> list[str]:
    return [element.text or "" for element in elements(drawing, "text")]


def titles(drawing: str) -> list[str]:
    return [element.text or "" for element in elements(drawing, "title")]


def lines_of(drawing: str, css: str = "line") -> list[list[tuple[float, float]]]:
    """The points of each line with a tooltip of that class, without its dots."""
    found = []
    for group in elements(drawing, "g"):
        if group.get("class") == css:
            path, *_ = [e for e in group.iter() if e.tag.removeprefix(SVG) == "path"]
            numbers = [float(word) for word in path.get("d", "").split() if word not in "MLz"]
            found.append(list(zip(numbers[::2], numbers[1::2], strict=True)))
    return found


def dots(drawing: str) -> list[tuple[float, float]]:
    return [(float(use.get("x", "")), float(use.get("y", ""))) for use in elements(drawing, "use")]


# -- distributions


def test_a_line_per_mechanism_with_its_figures_in_its_tooltip() -> None:
    values = {"pbr": [1.0, 2.0, 3.0, 4.0], "lfr": [2.0], "none": []}
    drawing = ecdf("Recovery", values, {"pbr": 0, "lfr": 1, "none": 2}, [])
    assert titles(drawing) == [
        "pbr: 4 runs, p50 2 ms, p99 4 ms, max 4 ms",
        "lfr: 1 runs, p50 2 ms, p99 2 ms, max 2 ms",
    ]
    assert len(lines_of(drawing)) == 2


def test_a_reader_that_does_not_see_it_gets_its_title() -> None:
    root = ElementTree.fromstring(ecdf("Recovery", {"a": [1.0]}, {"a": 0}, []))
    assert root.get("role") == "img"
    assert root.get("aria-label") == "Recovery: share of runs over time in ms"


def test_limits_are_named_even_where_no_value_comes_near() -> None:
    limits = [Limit("budget 90 ms", 90.0), Limit("gate", 2.0), Limit("gate: p50 at least 0 ms", 0.0)]
    drawing = ecdf("Recovery", {"pbr": [1.0, 1.5]}, {"pbr": 0}, limits)
    assert {limit.name for limit in limits} <= set(texts(drawing))
    (gate,) = [e for e in elements(drawing, "text") if e.text == "gate"]
    (budget,) = [e for e in elements(drawing, "text") if e.text == "budget 90 ms"]
    assert float(gate.get("x", "")) < float(budget.get("x", "")) < WIDTH
    root = ElementTree.fromstring(drawing)
    assert float(root.get("height", "")) == HEIGHT + 14 * len(limits)  # no name covers a line


@pytest.mark.parametrize(
    ("values", "logarithmic"),
    [([0.5, 60.0], True), ([50.0, 60.0], False), ([0.0, 60.0], False)],  # which has no place for nothing
)
def test_the_axis_is_logarithmic_where_the_values_differ_much(values: list[float], logarithmic: bool) -> None:
    said = texts(ecdf("x", {"a": values}, {"a": 0}, []))
    assert ("ms, logarithmic" in said, "ms" in said) == (logarithmic, not logarithmic)


@given(TIMES)
@few_examples
def test_any_values_have_their_place_in_the_drawing(values: list[float]) -> None:
    drawing = ecdf("x", {"a": values}, {"a": 9}, [Limit("l", 1.0)])
    (line,) = lines_of(drawing)
    xs, ys = zip(*line, strict=True)
    assert list(xs) == sorted(xs) and list(ys) == sorted(ys, reverse=True)
    assert xs[0] >= 46 and xs[-1] <= WIDTH - 14
    assert len(texts(drawing)) <= 5 + 20


def test_ten_thousand_values_are_thinned_to_their_ends() -> None:
    chance = Random(1)
    values = [chance.lognormvariate(0, 1) for _ in range(10_000)]
    (line,) = lines_of(ecdf("x", {"a": values}, {"a": 0}, []))
    assert len(line) <= 2 * POINTS_MAX + 4
    (alone,) = lines_of(ecdf("x", {"a": [min(values), max(values)]}, {"a": 0}, []))
    assert (line[0], line[-1]) == (alone[0], alone[-1])


def test_lines_differ_by_their_dashes_too() -> None:
    """Seven of them by colour and by dashes, more by both together."""
    styles = [line_style(number) for number in range(len(LINES) ** 2)]
    assert len({style.partition("; ")[2] for style in styles[: len(LINES)]}) == len(LINES)
    assert len(set(styles)) == len(styles)


def test_equal_data_give_equal_bytes_in_any_process() -> None:
    here = ecdf("x", {"a": [1.0, 2.0, 90.0], "b": [3.0]}, {"a": 0, "b": 1}, [Limit("l", 5.0)])
    code = """
from aftbed.report.plots import Limit, ecdf
print(ecdf("x", {"a": [1.0, 2.0, 90.0], "b": [3.0]}, {"a": 0, "b": 1}, [Limit("l", 5.0)]))
"""
    command = [sys.executable, "-c", code]
    there = subprocess.run(command, capture_output=True, check=True, text=True, timeout=60).stdout
    assert there == f"{here}\n" != "\n"


def test_ids_of_two_drawings_differ() -> None:
    one, other = (ecdf(title, {"a": [1.0]}, {"a": 0}, []) for title in ("one", "other"))
    ids = [{e.get("id") for e in elements(drawing, "path")} - {None} for drawing in (one, other)]
    assert ids[0] and not ids[0] & ids[1]


def test_matplotlib_is_loaded_with_the_first_plot_only() -> None:
    code = "import sys, aftbed.report.html; assert 'matplotlib' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_a_users_matplotlibrc_changes_nothing(tmp_path: object) -> None:
    import matplotlib as mpl  # noqa: PLC0415

    plain = ecdf("x", {"a": [1.0, 2.0]}, {"a": 0}, [])
    with mpl.rc_context({"lines.linewidth": 9.0, "axes.grid": False, "svg.fonttype": "path"}):
        assert ecdf("x", {"a": [1.0, 2.0]}, {"a": 0}, []) == plain


# -- sweeps and ranges


def test_every_point_of_a_sweep_lies_in_the_drawing_and_has_its_values() -> None:
    drawing = curves("t", {"a": [(1, 5.0), (10_000, 0.5)], "b": [(20, 700.0)]}, "x", "y")
    found = dots(drawing)
    assert len(found) == 3
    assert all(0 <= x <= WIDTH and 0 <= y <= HEIGHT for x, y in found)
    (left, low), (right, lower), (_, highest) = found
    assert left < right and highest < low < lower  # up is less in SVG
    assert titles(drawing) == ["a: 1 x, 5 y", "a: 10000 x, 0.5 y", "b: 20 x, 700 y"]


def test_a_range_has_a_bar_for_each_side_that_is_known() -> None:
    rows = [TimeRange("both", (4, 5), (0.1, 0.2)), TimeRange("ours alone", None, (400, 400))]
    drawing = ranges("t", rows)
    assert titles(drawing) == [
        "both: here, p50 to p99: 0.1 to 0.2 ms",
        "both: the paper: 4 to 5 ms",
        "ours alone: here, p50 to p99: 400 ms",
    ]
    ours, theirs, alone = lines_of(drawing, "range")
    assert ours[0][0] < ours[-1][0] < theirs[0][0] < theirs[-1][0] < alone[0][0]
    assert theirs[0][1] < ours[0][1] < alone[0][1]  # the paper's above ours
    root = ElementTree.fromstring(drawing)
    assert (root.get("width"), root.get("class")) == (f"{RANGES_PX:g}", "plot broad"), "as wide as a page"
    assert alone[-1][0] > 0.9 * RANGES_PX


# -- the table of the road

points = st.builds(
    RoadPoint, st.floats(0, 200), st.floats(0, 200), st.floats(0, 200), st.none() | st.floats(0, 200)
)
road_curves = st.builds(
    RoadCurve,
    st.sampled_from("ab"),
    st.text("<&>\"'$ pbr+", min_size=1),
    st.lists(points, min_size=1).map(tuple),
)


def paths(drawing: str, colour: str) -> list[list[tuple[float, float]]]:
    """The points of the paths that are stroked in that colour, those of the legend last."""
    found = []
    for path in elements(drawing, "path"):
        if f"stroke: {colour}" in path.get("style", ""):
            numbers = [float(word) for word in path.get("d", "").split() if word not in "MLz"]
            found.append(list(zip(numbers[::2], numbers[1::2], strict=True)))
    return found


def test_a_panel_for_each_mechanism_and_length_so_that_no_line_covers_another() -> None:
    rows = (RoadPoint(10, 0, 0, 0), RoadPoint(60, 20, 35, 25))
    names = ("pbr, crash", "outage 300ms")
    drawing = road_plot("r152", [RoadCurve(group, name, rows) for group in ("m1", "n1") for name in names])
    assert ElementTree.fromstring(drawing).tag == f"{SVG}svg", "a file of its own has its namespace"
    assert "var(--" not in drawing and drawing.endswith("</svg>\n")
    said = texts(drawing)
    assert [word for word in said if word in names] == [*names, *names]
    assert {"r152", "m1", "n1"} <= set(said)
    assert said.count("speed of the row, km/h") == 4 and said.count("speed at impact, km/h") == 2
    of_panel = ("10 km/h: impact 0.0 km/h, allowed none", "60 km/h: impact 20.0 km/h, allowed 35 km/h")
    assert titles(drawing) == [
        f"{name}: {words}" for _ in ("m1", "n1") for name in names for words in of_panel
    ]
    left = {x for x, _ in dots(drawing)[:2]}
    assert left.isdisjoint(x for x, _ in dots(drawing)[2:4]), "side by side"


def test_the_legend_has_what_is_drawn_and_no_more() -> None:
    plain, bounded = RoadPoint(10, 0, 5), RoadPoint(20, 9, 5, 10)
    words = ["speed at impact of a row", "allowed by the table"]
    assert sorted(texts(road_plot("t", [RoadCurve("g", "n", (plain,))]))[-2:]) == sorted(words)
    both = texts(road_plot("t", [RoadCurve("g", "n", (plain, bounded))]))
    assert sorted(both[-3:]) == sorted([*words, "at most, by v = sqrt(2 a (v0 t - d0))"])


def test_what_is_allowed_is_a_line_of_steps() -> None:
    rows = (RoadPoint(10, 0, 0), RoadPoint(20, 0, 0), RoadPoint(40, 0, 20), RoadPoint(60, 0, 35))
    drawing = road_plot("t", [RoadCurve("g", "n", rows)])
    steps, _ = paths(drawing, BAD)
    assert all((x == u) != (y == v) for (x, y), (u, v) in pairwise(steps) if (x, y) != (u, v))
    x10, x20, x40, x60 = (x for x, _ in dots(drawing)[:4])
    turns = sorted({x for x, _ in steps})[1:-1]
    assert turns == pytest.approx([(x10 + x20) / 2, (x20 + x40) / 2, (x40 + x60) / 2], abs=0.1)
    assert steps[0][0] < x10 and steps[-1][0] > x60, "the first and the last level lead to the ends"


@pytest.mark.parametrize("dark", [False, True])
def test_files_have_the_colours_of_the_pages(dark: bool) -> None:
    """Light ones as they are, dark ones by a rule for each."""
    css = (Path(plots.__file__).parent / "templates" / "report.css").read_text()
    part = css.partition("@media (prefers-color-scheme: dark)")[2 if dark else 0]
    wanted = dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6})", part.partition("* {")[0]))
    drawing = road_plot("t", [RoadCurve("g", "n", (RoadPoint(10, 0, 0),))])
    for light, variable in COLOURS.items():
        name = variable.removeprefix("var(--").removesuffix(")")
        if dark:
            assert f'[style*="fill: {light}"]{{fill:{wanted[name]} !important}}' in html.unescape(drawing)
        else:
            assert light == wanted[name], name


def test_the_higher_impact_lies_higher() -> None:
    rows = (RoadPoint(10, 0, 0), RoadPoint(60, 20, 0))
    low, high, *_ = dots(road_plot("t", [RoadCurve("g", "n", rows)]))
    assert low[1] > high[1] and low[0] < high[0]


# -- FTTI


def test_a_panel_for_each_fault_with_its_closed_form_and_the_bands_beside_it() -> None:
    faults = [
        FttiCurve("omission", [(20, 481), (50, 201)], [(20, 489), (50, 220)]),
        FttiCurve("hang", [(20, 481), (50, 201)], [(20, 489), (50, 220)]),
        FttiCurve("wrong-value", [(20, 300), (50, 90)]),
    ]
    bands = [TimeBand("pbr", 1.9, 12.5), TimeBand("lfr", 1.8, 1.8)]
    drawing = ftti_plot("FTTI over speed", faults, bands)
    said = texts(drawing)
    assert said.count("speed, km/h") == 3 and said.count("time, ms, logarithmic") == 1
    assert {"omission", "hang", "wrong-value"} <= set(said)
    assert sorted(said[-4:]) == ["FHTI of lfr", "FHTI of pbr", "FTTI", "closed form"]
    of_bands = ["FHTI of pbr: 1.9 to 12.5 ms", "FHTI of lfr: 1.8 ms"]
    least = ["omission: 201 ms at least", "hang: 201 ms at least", "wrong-value: 90 ms at least"]
    assert titles(drawing) == [title for one in least for title in (one, *of_bands)]
    ends = [max(x for x, _ in line) for line in lines_of(drawing)]
    bars = [{x for x, _ in bar} for bar in lines_of(drawing, "range")]
    assert all(len(bar) == 1 for bar in bars), "upright"
    assert all(end < min(pbr) < min(lfr) for end, pbr, lfr in zip(ends, bars[::2], bars[1::2], strict=True))


def test_without_bands_and_closed_form_there_is_one_line_and_one_name() -> None:
    drawing = ftti_plot("t", [FttiCurve("hang", [(20, 481), (50, 401)])], [])
    assert texts(drawing)[-1] == "FTTI" and "closed form" not in texts(drawing)
    assert "time, ms" in texts(drawing) and len(lines_of(drawing)) == 1


# -- any numbers


@given(st.lists(road_curves, min_size=1, max_size=4))
@example([RoadCurve("a", "n", (RoadPoint(0.0, 0.0, 0.0), RoadPoint(5e-324, 0.0, 0.0)))])
@few_examples
def test_whatever_the_numbers_it_is_a_drawing_inside_of_its_frame(some: list[RoadCurve]) -> None:
    drawing = road_plot("any", some)
    root = ElementTree.fromstring(drawing)
    width, height = float(root.get("width", "")), float(root.get("height", ""))
    assert all(0 <= x <= width and 0 <= y <= height for x, y in dots(drawing))
    assert {curve.name for curve in some if curve.name.strip()} <= set(texts(drawing))

"""What is drawn: distributions with their limits, and the space-time diagram of a run."""

from random import Random
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.adapt.schedule import scheduled
from aftbed.core.script import RECIPES
from aftbed.ftm.compose import build
from aftbed.inject.model import parse
from aftbed.report.happenings import KEPT_MAX
from aftbed.report.plots import POINTS_MAX, Limit, axis_of, ecdf
from aftbed.report.spacetime import space_time
from aftbed.runtime.sim.trace import Trace, traced
from aftbed.runtime.sim.world import Setup

TIMES = st.lists(st.floats(0, 1e6), min_size=1, max_size=60)


def drawing(svg: str) -> ElementTree.Element:
    return ElementTree.fromstring(svg)


def texts(svg: str) -> list[str]:
    return [element.text or "" for element in drawing(svg).iter("text")]


def titles(svg: str) -> list[str]:
    return [element.text or "" for element in drawing(svg).iter("title")]


def of_class(svg: str, css: str) -> list[ElementTree.Element]:
    return [e for e in drawing(svg).iter() if css in e.get("class", "").split()]


# -- distributions --------------------------------------------------------------------------------


def test_a_line_per_mechanism_with_its_figures_in_its_tooltip() -> None:
    values = {"pbr": [1.0, 2.0, 3.0, 4.0], "lfr": [2.0], "none": []}
    svg = ecdf("Recovery", values, {"pbr": 0, "lfr": 1, "none": 2}, [])
    assert len(of_class(svg, "curve")) == 2
    assert titles(svg) == [
        "pbr: 4 runs, p50 2 ms, p99 4 ms, max 4 ms",
        "lfr: 1 runs, p50 2 ms, p99 2 ms, max 2 ms",
    ]


def test_limits_are_drawn_even_where_no_value_comes_near() -> None:
    svg = ecdf("Recovery", {"pbr": [1.0, 1.5]}, {"pbr": 0}, [Limit("budget 90 ms", 90.0), Limit("gate", 2.0)])
    lines = [float(line.get("x1", "")) for line in of_class(svg, "limit")]
    width = float(drawing(svg).get("width", ""))
    assert len(lines) == 2 and 0 < lines[1] < lines[0] < width
    assert {"budget 90 ms", "gate"} <= set(texts(svg))


def test_the_axis_is_logarithmic_where_the_values_differ_much() -> None:
    assert axis_of([0.5, 60.0]).logarithmic
    assert not axis_of([50.0, 60.0]).logarithmic
    assert not axis_of([0.0, 60.0]).logarithmic  # which has no place for nothing


@given(TIMES)
def test_every_value_has_its_place_and_the_ticks_lie_between(values: list[float]) -> None:
    axis = axis_of(values)
    ordered = [axis.x(value) for value in sorted(values)]
    assert ordered == sorted(ordered)
    low, high = axis.x(axis.low), axis.x(axis.high)
    assert all(low <= x <= high for x in ordered)
    assert all(low - 1 <= axis.x(tick) <= high + 1 for tick in axis.ticks())
    assert len(axis.ticks()) <= 20


@given(TIMES)
def test_any_values_can_be_drawn(values: list[float]) -> None:
    assert len(of_class(ecdf("x", {"a": values}, {"a": 9}, [Limit("l", 1.0)]), "curve")) == 1


def test_ten_thousand_values_are_thinned_to_their_ends() -> None:
    chance = Random(1)
    values = [chance.lognormvariate(0, 1) for _ in range(10_000)]
    (curve,) = of_class(ecdf("x", {"a": values}, {"a": 0}, []), "curve")
    points = curve.get("d", "")
    assert points.count("H") <= POINTS_MAX + 1
    assert points.endswith("V14.0")  # all of them


# -- space-time -----------------------------------------------------------------------------------


def trace_of(ftm: str = "pbr", placement: str = "process", fault: str = "", adapt: str = "") -> Trace:
    graph = build(ftm, placement)
    faults = (parse(fault),) if fault else ()
    changes = scheduled((adapt,) if adapt else (), graph, RECIPES[0])
    return traced(Setup(ftm, placement, 3, 40, 0.0, faults, changes))


def test_nodes_are_rows_in_the_order_of_a_request() -> None:
    drawn = space_time(trace_of(fault="crash primary at server.exit nth 8"))
    rows = [text for text in texts(drawn.names) if text]
    assert rows[:7] == ["client", "proxy", "a/protocol", "a/before", "a/proceed", "a/server", "a/after"]
    assert rows[-2:] == ["recovery", "supervisor"]
    assert rows.index("a/watchdog") < rows.index("b/protocol")


def test_the_fault_and_the_steps_of_the_failover_are_marked() -> None:
    drawn = space_time(trace_of(fault="crash primary at server.exit nth 8"))
    said = texts(drawn.body)
    for words in (
        "crash primary at server.exit nth 8",
        "watchdog.suspect",
        "replica.promoted",
        "backup.ready",
    ):
        assert words in said
    assert any(title.endswith("a/server was hit") for title in titles(drawn.body))
    assert of_class(drawn.body, "hit")


def test_the_steps_of_an_adaptation_are_marked() -> None:
    drawn = space_time(trace_of(adapt="compose pbr+tr at request 20"))
    assert {"adapt.plan", "adapt.commit"} <= set(texts(drawn.body))
    assert any("adapt.step.enter 1" in title for title in titles(drawn.body))
    assert "fault" not in {c for e in drawing(drawn.body).iter() for c in e.get("class", "").split()}


def test_an_arrow_per_message_that_is_kept_and_the_rest_is_counted() -> None:
    trace = trace_of(fault="crash primary at server.exit nth 8")
    drawn = space_time(trace)
    shown, left_out = (
        drawn.text.count(" -> "),
        sum(int(text.split()[0]) for text in texts(drawn.body) if text.endswith(" more")),
    )
    assert len(of_class(drawn.body, "message")) == shown > 20
    lines = len(drawn.text.splitlines())
    assert lines <= KEPT_MAX and lines + left_out <= len(trace.happened) and left_out > 0


@pytest.mark.parametrize("placement", ["process", "replica", "single"])
@pytest.mark.parametrize("ftm", ["none", "pbr", "lfr+tr"])
def test_any_run_can_be_drawn(ftm: str, placement: str) -> None:
    drawn = space_time(trace_of(ftm, placement))
    assert drawing(drawn.body) is not None and len(texts(drawn.names)) >= 2
    if ftm == "none" or placement != "single":
        assert of_class(drawn.body, "message") or placement == "single"


def test_nothing_lies_outside_of_the_picture() -> None:
    body = drawing(space_time(trace_of(fault="hang primary for 90ms at server.exit nth 8")).body)
    width, height = float(body.get("width", "")), float(body.get("height", ""))
    for element in body.iter("line"):
        assert all(0 <= float(element.get(name, "")) <= width for name in ("x1", "x2"))
        assert all(0 <= float(element.get(name, "")) <= height for name in ("y1", "y2"))
    for element in body.iter("text"):
        assert 0 < float(element.get("y", "")) <= height

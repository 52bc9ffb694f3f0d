"""The drawing of a table: one file that stands alone, a picture for each group, a line for each name."""

from typing import Final
from xml.etree import ElementTree

from hypothesis import example, given
from hypothesis import strategies as st

from aftbed.report.roadplot import Curve, Point, road_plot

SVG: Final = "{http://www.w3.org/2000/svg}"
points = st.builds(
    Point, st.floats(0, 200), st.floats(0, 200), st.floats(0, 200), st.none() | st.floats(0, 200)
)
curves = st.builds(
    Curve, st.sampled_from("ab"), st.text("<&>\"' pbr+", min_size=1), st.lists(points, min_size=1).map(tuple)
)


def drawn(text: str) -> list[ElementTree.Element]:
    """Its elements."""
    return list(ElementTree.fromstring(text).iter())


def test_a_line_for_each_mechanism_and_length_in_a_picture_for_each_group() -> None:
    rows = (Point(10, 0, 0, 0), Point(60, 20, 35, 25))
    names = ("pbr, crash", "outage 300ms")
    text = road_plot("r152", [Curve(group, name, rows) for group in ("m1", "n1") for name in names])
    found = drawn(text)
    said = [element.text for element in found if element.tag == f"{SVG}text"]
    assert {"m1", "n1", *names, "allowed by the table"} <= set(said)
    titles = [element.text for element in found if element.tag == f"{SVG}title"]
    assert titles == [f"{name}: up to 20.0 km/h" for _ in ("m1", "n1") for name in names]
    assert sum(element.get("class") == "allowed" for element in found) == 2 + 1, "and one in the legend"


def test_the_higher_impact_lies_higher() -> None:
    text = road_plot("t", [Curve("g", "n", (Point(10, 0, 0), Point(60, 20, 0)))])
    low, high = [e for e in drawn(text) if e.tag == f"{SVG}circle"]
    assert float(low.get("cy", "")) > float(high.get("cy", ""))
    assert float(low.get("cx", "")) < float(high.get("cx", ""))


@given(st.lists(curves, min_size=1, max_size=4))
@example([Curve("a", "n", (Point(0.0, 0.0, 0.0), Point(5e-324, 0.0, 0.0)))])
def test_whatever_the_numbers_it_is_a_drawing_inside_of_its_frame(some: list[Curve]) -> None:
    root = ElementTree.fromstring(road_plot("any", some))
    width, height = float(root.get("width", "")), float(root.get("height", ""))
    for circle in root.iter(f"{SVG}circle"):
        assert 0 <= float(circle.get("cx", "")) <= width
        assert 0 <= float(circle.get("cy", "")) <= height

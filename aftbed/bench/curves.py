"""Two plots of the paper's figures beside ours: ranges on one axis of times, and curves of a sweep.

They stand on the axis of the campaign's plots, which is logarithmic where the values differ by much, and
take their looks from the same style sheet.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Final

import msgspec

from aftbed.report import svg
from aftbed.report.plots import BOTTOM, HEIGHT, LEFT, RIGHT, STYLES, TOP, WIDTH, Axis, axis_of, milliseconds

ROW_PX: Final = 46.0
MARK_PX: Final = 3.0

Points = Sequence[tuple[float, float]]
Say = Callable[[float], str]


class Range(msgspec.Struct, frozen=True):
    """A row: theirs, which may be unknown, above ours; ms."""

    name: str
    theirs: tuple[float, float] | None
    ours: tuple[float, float]


def ranges(title: str, rows: Sequence[Range]) -> str:
    """A pair of bars for each row; `title` is for those who do not see it."""
    assert rows, "nothing to draw"
    ends = [end for row in rows for end in (*row.ours, *(row.theirs or ()))]
    axis = axis_of(ends)
    bottom = TOP + ROW_PX * len(rows)
    parts = _upright(axis, bottom, "ms", milliseconds)
    for number, row in enumerate(rows):
        top = TOP + ROW_PX * number
        parts.append(svg.label(LEFT + 4, top + 13, row.name, "name"))
        if row.theirs is not None:
            parts.append(_bar(axis, row.theirs, top + 22, f"{row.name}: the paper", 1))
        parts.append(_bar(axis, row.ours, top + 34, f"{row.name}: here, p50 to p99", 0))
    return svg.drawing(WIDTH, bottom + BOTTOM, title, *parts, css="plot")


def _bar(axis: Axis, ends: tuple[float, float], y: float, what: str, style: int) -> str:
    low, high = (axis.x(end) for end in ends)
    low, high = (low, high) if high - low >= 2 * MARK_PX else (low - MARK_PX, high + MARK_PX)
    said = " to ".join(dict.fromkeys(milliseconds(end) for end in ends))
    return svg.group("range", svg.line(low, y, high, y, f"l{style}"), title=f"{what}: {said} ms")


def curves(
    title: str,
    lines: Mapping[str, Points],
    x_name: str,
    y_name: str,
    say_x: Say = milliseconds,
    say_y: Say = milliseconds,
) -> str:
    """A line for each of `lines` that has points (x, y); each point tells its values."""
    drawn = {name: points for name, points in lines.items() if points}
    assert drawn, "nothing to draw"
    across = axis_of(x for points in drawn.values() for x, _ in points)
    up = axis_of(y for points in drawn.values() for _, y in points)
    parts = [*_upright(across, HEIGHT - BOTTOM, x_name, say_x), *_level(up, y_name, say_y)]
    for style, (name, points) in enumerate(drawn.items()):
        at = [(across.x(x), _y(up, y)) for x, y in points]
        pieces = "L".join(f"{x:.1f} {y:.1f}" for x, y in at)
        marks = [
            svg.group(
                "point",
                svg.element("circle", {"cx": cx, "cy": cy, "r": MARK_PX, "class": f"end l{style % STYLES}"}),
                title=f"{name}: {say_x(x)} {x_name}, {say_y(y)} {y_name}",
            )
            for (cx, cy), (x, y) in zip(at, points, strict=True)
        ]
        parts.append(svg.group("line", svg.path(f"M{pieces}", f"curve l{style % STYLES}"), *marks))
    return svg.drawing(WIDTH, HEIGHT, title, *parts, css="plot")


def _y(axis: Axis, value: float) -> float:
    """The height of `value`: the axis is made to lie, so it is turned up."""
    share = (axis.x(value) - LEFT) / (WIDTH - LEFT - RIGHT)
    return HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * share


def _upright(axis: Axis, bottom: float, name: str, say: Say) -> list[str]:
    parts = []
    for value in axis.ticks():
        x = axis.x(value)
        parts.append(svg.line(x, TOP, x, bottom + 4, "grid"))
        parts.append(svg.label(x, bottom + 17, say(value), "tick", "middle"))
    return [*parts, svg.label((LEFT + WIDTH - RIGHT) / 2, bottom + 34, _of(axis, name), "tick", "middle")]


def _level(axis: Axis, name: str, say: Say) -> list[str]:
    parts = []
    for value in _spread(axis.ticks()):
        y = _y(axis, value)
        parts.append(svg.line(LEFT, y, WIDTH - RIGHT, y, "grid"))
        parts.append(svg.label(LEFT - 6, y + 4, say(value), "tick", "end"))
    return [*parts, svg.label(4, TOP - 4, _of(axis, name), "tick")]


def _spread(values: Iterable[float]) -> list[float]:
    """Every one of few, every second of many: the height is less than the width."""
    found = list(values)
    return found[:: 2 if len(found) > 6 else 1]


def _of(axis: Axis, name: str) -> str:
    return f"{name}, logarithmic" if axis.logarithmic else name

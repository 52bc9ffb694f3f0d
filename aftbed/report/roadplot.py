"""A table of the road, drawn: the speed that is left at impact over the speed of the row.

One line for each mechanism and each length of an outage, told apart by dashes as well as by colour; what the
table allows is a line of its own, and what an outage can lead to at most (the closed form) a thin one. One
picture for each group of the table, below each other. The file stands alone: it brings its own style.

Limits: a group of one row is drawn as points.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Final

import msgspec

from aftbed.report import svg

WIDTH, HEIGHT = 620.0, 300.0
LEFT, RIGHT, TOP, BOTTOM = 52.0, 16.0, 34.0, 44.0
LEGEND_PX: Final = 18.0
LEAST_KMH: Final = 10.0  # of the upright axis
SPAN_KMH_MIN: Final = 1.0  # of the level one: rows that lie closer get some room beside them
TICKS: Final = 6
COLOURS: Final = ("#0072b2", "#d55e00", "#008f68", "#a8568b", "#8a6d00", "#2f8fc4", "#3d3d3d")
DASHES: Final = ("", "7 3", "2 2", "8 3 2 3", "12 3", "4 4", "1 3")
STYLE: Final = """
svg { background: #ffffff; }
text { font: 11px system-ui, sans-serif; fill: #1b1f24; } .tick { fill: #59626d; } .name { font-weight: 600; }
.grid { stroke: #d6dae0; } .allowed { stroke: #b3261e; stroke-dasharray: 2 3; fill: none; stroke-width: 1.5; }
.curve { fill: none; stroke-width: 2; } .closed { fill: none; stroke-width: .8; opacity: .8; }
"""


class Point(msgspec.Struct, frozen=True):
    """A row. `closed_kmh` where there is a closed form."""

    speed_kmh: float
    impact_kmh: float
    limit_kmh: float
    closed_kmh: float | None = None


class Curve(msgspec.Struct, frozen=True):
    """The rows of one group under one line, by speed."""

    group: str
    name: str
    points: tuple[Point, ...]


def road_plot(title: str, curves: Sequence[Curve]) -> str:
    """The whole file. There is at least one curve, and none is empty."""
    assert curves and all(curve.points for curve in curves)
    names = list(dict.fromkeys(curve.name for curve in curves))
    styles = {name: at % len(COLOURS) for at, name in enumerate(names)}
    groups = dict.fromkeys(curve.group for curve in curves)
    pictures = [[curve for curve in curves if curve.group == group] for group in groups]
    closed = any(point.closed_kmh is not None for curve in curves for point in curve.points)
    legend = _legend(styles, closed=closed)
    above = 26.0 + LEGEND_PX * len(legend)
    parts = [_style(styles), svg.label(LEFT, 16, title, "name")]
    parts += [_moved(LEFT, 22 + LEGEND_PX * at, one) for at, one in enumerate(legend)]
    parts += [_moved(0, above + HEIGHT * at, _picture(of, styles)) for at, of in enumerate(pictures)]
    drawn = svg.drawing(WIDTH, above + HEIGHT * len(pictures), title, *parts)
    return drawn.replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1) + "\n"


def _style(styles: dict[str, int]) -> str:
    lines = [
        f".l{n} {{ stroke: {COLOURS[n]}; stroke-dasharray: {DASHES[n] or 'none'}; }}" for n in styles.values()
    ]
    dots = [f".d{n} {{ fill: {COLOURS[n]}; }}" for n in styles.values()]
    return svg.element("style", {}, svg.text_of(STYLE + "\n".join((*lines, *dots)) + "\n"))


def _moved(x: float, y: float, *parts: str) -> str:
    return svg.element("g", {"transform": f"translate({x:g} {y:g})"}, *parts)


def _legend(styles: dict[str, int], *, closed: bool) -> list[str]:
    """A line of it for each kind of line."""
    kinds = [(f"curve l{style}", name) for name, style in styles.items()]
    kinds += [("closed l0", "thin: at most, by v = sqrt(2 a (v0 t - d0))")] if closed else []
    kinds += [("allowed", "allowed by the table")]
    return [svg.path("M0 8H28", css) + svg.label(36, 12, name) for css, name in kinds]


def _picture(curves: list[Curve], styles: dict[str, int]) -> str:
    points = [point for curve in curves for point in curve.points]
    speeds = [point.speed_kmh for point in points]
    highs = (max(p.impact_kmh, p.limit_kmh, p.closed_kmh or 0.0) for p in points)
    frame = _Frame(min(speeds), max(speeds), max(LEAST_KMH, *highs) * 1.08)
    parts = [svg.label(LEFT, TOP - 12, curves[0].group, "name"), *frame.grid()]
    allowed = [(point.speed_kmh, point.limit_kmh) for point in curves[0].points]
    parts.append(svg.path(frame.path(allowed), "allowed"))
    for curve in curves:
        style = styles[curve.name]
        bounds = [(p.speed_kmh, p.closed_kmh) for p in curve.points if p.closed_kmh is not None]
        parts += [svg.path(frame.path(bounds), f"closed l{style}")] if bounds else []
        parts.append(_curve(frame, curve, style))
    return "".join(parts)


def _curve(frame: "_Frame", curve: Curve, style: int) -> str:
    found = [(point.speed_kmh, point.impact_kmh) for point in curve.points]
    dots = [
        svg.element("circle", {"cx": frame.x(speed), "cy": frame.y(impact), "r": 2.6, "class": f"d{style}"})
        for speed, impact in found
    ]
    worst = max(impact for _, impact in found)
    return svg.group(
        "line",
        svg.path(frame.path(found), f"curve l{style}"),
        *dots,
        title=f"{curve.name}: up to {worst:.1f} km/h",
    )


class _Frame:
    """From km/h to pixels."""

    def __init__(self, low_kmh: float, high_kmh: float, top_kmh: float) -> None:
        spare = 5.0 if high_kmh - low_kmh < SPAN_KMH_MIN else 0.0
        self._low, self._high, self._top = low_kmh - spare, high_kmh + spare, top_kmh

    def x(self, speed_kmh: float) -> float:
        return LEFT + (WIDTH - LEFT - RIGHT) * (speed_kmh - self._low) / (self._high - self._low)

    def y(self, impact_kmh: float) -> float:
        return HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * impact_kmh / self._top

    def path(self, points: Iterable[tuple[float, float]]) -> str:
        return "M" + "L".join(f"{self.x(x):.1f} {self.y(y):.1f}" for x, y in points)

    def grid(self) -> list[str]:
        right, bottom = WIDTH - RIGHT, HEIGHT - BOTTOM
        parts = []
        for value in _ticks(0.0, self._top):
            parts.append(svg.line(LEFT, self.y(value), right, self.y(value), "grid"))
            parts.append(svg.label(LEFT - 6, self.y(value) + 4, f"{value:g}", "tick", "end"))
        for value in _ticks(self._low, self._high):
            parts.append(svg.line(self.x(value), TOP, self.x(value), bottom + 4, "grid"))
            parts.append(svg.label(self.x(value), bottom + 17, f"{value:g}", "tick", "middle"))
        return [
            *parts,
            svg.label(
                (LEFT + right) / 2, HEIGHT - 8, "km/h of the row; upright: km/h at impact", "tick", "middle"
            ),
        ]


def _ticks(low: float, high: float) -> list[float]:
    """Round values from `low` to `high`."""
    power = 10.0 ** math.floor(math.log10((high - low) / TICKS))
    step = next(power * digit for digit in (1, 2, 5, 10) if power * digit * TICKS >= high - low)
    return [step * n for n in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]

"""Plots as SVG, drawn by matplotlib: distributions of times, sweeps, ranges, and the table of the road.

`ecdf`, `curves` and `ranges` are pieces of a page: without a namespace, in the colours of the page's style
sheet (so that a dark screen and paper get theirs), with a tooltip per line. `road_plot` and `ftti_plot` are
files of their own, in light colours; a style sheet in them has the dark ones, for browsers.
The same data give the same bytes: there is no date, and ids are made from the title, which is therefore
unique in a page. matplotlib is imported with the first plot, because that takes up to a second.

An empirical distribution function (`ecdf`) shows which share of the runs took at most so long. It shows every
value and needs no bins; a quantile can be read off it, and two modes (a crash is detected at once, a hang
only at its deadline) are two steps. What the campaign allows is an upright line.

Limits: at most `POINTS_MAX` points of a distribution are drawn, evenly spaced in share, the ends included.
"""

import io
import logging
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import TYPE_CHECKING, Final, Literal
from xml.etree import ElementTree

import msgspec

from aftbed.campaign.statistics import quantile

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

POINTS_MAX: Final = 400
LOG_FROM: Final = 20.0  # an axis whose values differ by a larger factor is logarithmic
LEAST_MS: Final = 0.001  # times are kept to the microsecond
LINES: Final = (  # colour and dashes, because colour alone does not distinguish lines for all readers
    ("#0072b2", ""),
    ("#d55e00", "7 3"),
    ("#008f68", "2 2"),
    ("#a8568b", "8 3 2 3"),
    ("#8a6d00", "12 3"),
    ("#2f8fc4", "4 4"),
    ("#3d3d3d", "1 3"),
)
INK, MUTED, RULE, BAD, GROUND = "#1b1f24", "#59626d", "#d6dae0", "#b3261e", "#ffffff"
COLOURS: Final = {  # of report.css
    **{colour: f"var(--l{number})" for number, (colour, _) in enumerate(LINES)},
    INK: "var(--ink)",
    MUTED: "var(--muted)",
    RULE: "var(--rule)",
    BAD: "var(--bad)",
    GROUND: "var(--ground)",
}
DARK: Final = dict(  # of the same style sheet, in the order of COLOURS
    zip(
        COLOURS,
        (
            *("#56a8e0", "#ff9140", "#3fc9a0", "#e09ac6", "#e0c04a", "#9ad4f5", "#d0d0d0"),
            *("#e4e7eb", "#9ba5b1", "#363d46", "#ff8a80", "#15181c"),
        ),
        strict=True,
    )
)
FONT: Final = 'system-ui, "Segoe UI", Roboto, "DejaVu Sans", Arial, sans-serif'
WIDTH, HEIGHT = 560.0, 250.0
LEFT, RIGHT, TOP, BOTTOM = 46.0, 14.0, 18.0, 40.0
LIMIT_PX: Final = 14.0  # from the name of a limit to that of the next
CHARACTER_PX: Final = 6.3  # mean width of a character at 11 px
RANGE_PX: Final = 46.0  # of a row of `ranges`
RANGE_PX_MIN: Final = 6.0  # width of a bar; a narrower one gets caps
# Of files: the width of one or two panels, the height of a panel, of a group's name, of a line of the legend
ROAD_PX, PANEL_PX, GROUP_PX, LEGEND_PX = 620.0, 240.0, 26.0, 18.0
PANEL_LEFT, PANEL_RIGHT, PANEL_TOP, PANEL_BOTTOM = 56.0, 14.0, 24.0, 48.0
COLUMNS_MAX: Final = 3
BAND_STRIP: Final = 0.06  # width of a band, in widths of its axis
RANGES_PX: Final = 1140.0  # the width of a page
ROAD_TOP_KMH, ROAD_SPAN_KMH = 10.0, 1.0  # least height of the upright axis; least width of the level one
DOTS_PER_INCH: Final = 72  # so that a point of matplotlib is a pixel of the SVG
SVG: Final = "http://www.w3.org/2000/svg"
HREF: Final = "{http://www.w3.org/1999/xlink}href"
DOTTED: Final = (0.0, (2.0, 3.0))
MANY_DECADES: Final = 500.0  # from this factor on, an axis has one tick a decade
_RC: Final = {
    "svg.fonttype": "none",
    "font.size": 11.0,
    "figure.dpi": DOTS_PER_INCH,
    "axes.edgecolor": RULE,
    "axes.labelcolor": MUTED,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": RULE,
    "grid.linewidth": 1.0,
    "lines.linewidth": 2.0,
    "lines.scale_dashes": False,
    "text.color": INK,
    "text.parse_math": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.bottom": False,
    "ytick.left": False,
}
_TIP: Final = re.compile(r"tip-(\d+)")
_DIGITS: Final = re.compile(r"(\.\d\d)\d+")
_FONT: Final = re.compile(r"'DejaVu Sans'[^;]*")
_COLOUR: Final = re.compile(r"#[0-9a-f]{6}\b")

Points = Sequence[tuple[float, float]]
Format = Callable[[float], str]


class Limit(msgspec.Struct, frozen=True):
    """An upright line at `ms`."""

    name: str
    ms: float


class TimeRange(msgspec.Struct, frozen=True):
    """A row of `ranges`, ms; `theirs` may be unknown."""

    name: str
    theirs: tuple[float, float] | None
    ours: tuple[float, float]


class RoadPoint(msgspec.Struct, frozen=True):
    """A row of a table of the road. `closed_kmh` where there is a closed form."""

    speed_kmh: float
    impact_kmh: float
    limit_kmh: float
    closed_kmh: float | None = None


class RoadCurve(msgspec.Struct, frozen=True):
    """The rows of one group under one mechanism or outage, by speed."""

    group: str
    name: str
    points: tuple[RoadPoint, ...]


def milliseconds(value: float) -> str:
    """For people: three digits, no more."""
    return f"{value:.3g}" if value < 1000 else f"{value:.0f}"


def line_style(number: int) -> str:
    """Colour and dashes of a page's line with that number, as CSS: for its legend."""
    return f"stroke: var(--l{number % len(LINES)}); stroke-dasharray: {_dashes(number) or 'none'}"


def _dashes(number: int) -> str:
    """Of the line with that number: behind the last colour, the first one comes with other dashes."""
    return LINES[(number + number // len(LINES)) % len(LINES)][1]


# -- plots of a page --------------------------------------------------------------------------------


def ecdf(
    title: str, lines: Mapping[str, Sequence[float]], styles: Mapping[str, int], limits: Sequence[Limit]
) -> str:
    """A line for each of `lines` that has values, ms; `styles` has a number for each name."""
    drawn = {name: sorted(values) for name, values in lines.items() if values}
    assert drawn, "nothing to draw"
    above = LIMIT_PX * len(limits)  # the names of limits stand above the frame, where no line passes
    with _drawing(f"{title}: share of runs over time in ms", WIDTH, HEIGHT + above) as drawing:
        axes = drawing.axes(LEFT, TOP + above, WIDTH - RIGHT, HEIGHT + above - BOTTOM)
        ends = [end for values in drawn.values() for end in (values[0], values[-1])]
        _scale(axes, "x", "ms", (*ends, *(limit.ms for limit in limits if limit.ms > 0)))
        axes.set_ylim(0, 1)
        axes.set_yticks([0, 0.25, 0.5, 0.75, 1], ["0 %", "25 %", "50 %", "75 %", "100 %"])
        for place, limit in enumerate(limits):
            _limit(drawing, axes, limit, 4 + LIMIT_PX * place)
        for name, values in drawn.items():
            words = ", ".join(f"p{q} {milliseconds(quantile(values, q / 100))} ms" for q in (50, 99))
            tip = f"{name}: {len(values)} runs, {words}, max {milliseconds(values[-1])} ms"
            line = drawing.line(axes, _steps(values), styles[name])
            line.set_drawstyle("steps-post")
            drawing.tip(line, tip, "line")
            drawing.dot(axes, values[-1], 1, styles[name])
        return drawing.svg()


def _steps(values: list[float]) -> Points:
    """Of the sorted `values`, thinned: from (least, 0) to (greatest, 1)."""
    count = len(values)
    ranks = [*range(0, count - 1, max(1, math.ceil(count / POINTS_MAX))), count - 1]
    return [(values[0], 0.0), *((values[rank], (rank + 1) / count) for rank in ranks)]


def _limit(drawing: "_Drawing", axes: "Axes", limit: Limit, above_px: float) -> None:
    at_ms = max(limit.ms, axes.get_xlim()[0])
    frame_px = drawing.height - TOP - BOTTOM  # the line ends at its name, above the frame
    axes.axvline(at_ms, ymax=1 + (above_px + 8) / frame_px, color=BAD, linewidth=1.5, linestyle=DOTTED)
    x_px = axes.transData.transform((at_ms, 0))[0]
    fits = x_px + 5 + CHARACTER_PX * len(limit.name) < drawing.width - RIGHT
    axes.annotate(
        limit.name,
        (at_ms, 1),
        xycoords=("data", "axes fraction"),
        xytext=(5 if fits else -5, above_px),
        textcoords="offset points",
        ha="left" if fits else "right",
        color=BAD,
    )


def curves(
    title: str,
    lines: Mapping[str, Sequence[tuple[float, float]]],
    x_name: str,
    y_name: str,
    format_x: Format = milliseconds,
    format_y: Format = milliseconds,
) -> str:
    """A line for each of `lines` that has points (x, y); each point has its values in a tooltip."""
    drawn = {name: points for name, points in lines.items() if points}
    assert drawn, "nothing to draw"
    with _drawing(title, WIDTH, HEIGHT) as drawing:
        axes = drawing.axes(LEFT, TOP, WIDTH - RIGHT, HEIGHT - BOTTOM)
        _scale(axes, "x", x_name, [x for points in drawn.values() for x, _ in points], format_x)
        _scale(axes, "y", y_name, [y for points in drawn.values() for _, y in points], format_y)
        for style, (name, points) in enumerate(drawn.items()):
            drawing.line(axes, points, style)
            for x, y in points:
                dot = drawing.dot(axes, x, y, style)
                drawing.tip(dot, f"{name}: {format_x(x)} {x_name}, {format_y(y)} {y_name}", "point")
        return drawing.svg()


def over_time(
    title: str, lines: Mapping[str, Points], y_name: str, marks: Sequence[tuple[float, str]] = ()
) -> str:
    """A line for each of `lines` that has points (s, y), and an upright line at each of `marks` (s, name)."""
    drawn = {name: points for name, points in lines.items() if points}
    assert drawn, "nothing to draw"
    with _drawing(title, WIDTH, HEIGHT) as drawing:
        axes = drawing.axes(LEFT, TOP, WIDTH - RIGHT, HEIGHT - BOTTOM)
        ends = [x for points in drawn.values() for x in (points[0][0], points[-1][0])]
        axes.set_xlim(min(ends), max(*ends, min(ends) + LEAST_MS))
        axes.set_xlabel("s")
        top = max(y for points in drawn.values() for _, y in points)
        axes.set_ylim(
            min(0.0, *(y for points in drawn.values() for _, y in points)), max(1.08 * top, LEAST_MS)
        )
        axes.set_title(y_name, loc="left", fontsize=11, color=MUTED)
        for style, (name, points) in enumerate(drawn.items()):
            line = drawing.line(axes, points, style)
            drawing.tip(line, f"{name}: {points[0][1]:.3g} to {points[-1][1]:.3g} {y_name}", "line")
        for x, name in marks:
            drawing.tip(
                axes.axvline(x, color=BAD, linewidth=1.5, linestyle=DOTTED), f"{x:.3f} s: {name}", "line"
            )
        return drawing.svg()


def ranges(title: str, rows: Sequence[TimeRange]) -> str:
    """A bar for each range of each row, the paper's above ours; as wide as a page."""
    assert rows, "nothing to draw"
    height = TOP + RANGE_PX * len(rows) + BOTTOM
    with _drawing(title, RANGES_PX, height) as drawing:
        axes = drawing.axes(RIGHT, TOP, RANGES_PX - RIGHT, height - BOTTOM)
        _scale(axes, "x", "ms", [end for row in rows for end in (*row.ours, *(row.theirs or ()))])
        axes.set_ylim(RANGE_PX * len(rows), 0)
        axes.set_yticks([])
        for number, row in enumerate(rows):
            top = RANGE_PX * number
            axes.text(0.01, top + 13, row.name, transform=axes.get_yaxis_transform())
            bars = [(row.ours, 34, 0, "here, p50 to p99")]
            bars += [(row.theirs, 22, 1, "the paper")] if row.theirs is not None else []
            for (low, high), down, style, side in bars:
                words = " to ".join(dict.fromkeys(map(milliseconds, (low, high))))
                bar = axes.plot((low, high), (top + down,) * 2, color=LINES[style][0], linewidth=8)[0]
                width_px = axes.transData.transform((high, 0))[0] - axes.transData.transform((low, 0))[0]
                bar.set(solid_capstyle="butt" if width_px >= RANGE_PX_MIN else "projecting")
                drawing.tip(bar, f"{row.name}: {side}: {words} ms", "range")
        return drawing.svg("plot broad")


# -- files of their own: the table of the road, FTTI over speed ---------------------------------------


def road_plot(title: str, curves: Sequence[RoadCurve]) -> str:
    """The speed that is left at impact over the speed of the row.

    A panel for each curve, since many have the same values; those of a group stand side by side and share
    their axes. A dot is a row. What the table allows is a line of steps, and the closed form of an outage (an
    upper bound) a thin line. There is at least one curve, and none is empty.
    """
    assert curves and all(curve.points for curve in curves)
    groups = {curve.group: [one for one in curves if one.group == curve.group] for curve in curves}
    columns = _columns([curve.name for curve in curves], max(map(len, groups.values())))
    panel_rows = sum(math.ceil(len(of) / columns) for of in groups.values())
    bounded = any(point.closed_kmh is not None for curve in curves for point in curve.points)
    legend_px = 30.0 + LEGEND_PX * (3 if bounded else 2)
    height = legend_px + GROUP_PX * len(groups) + PANEL_PX * panel_rows
    with _drawing(title, _width(columns), height) as drawing:
        legend: dict[str, Artist] = {}
        top = legend_px
        for group, of_group in groups.items():
            drawing.heading(group, top + GROUP_PX - 6)
            top += GROUP_PX
            points = [point for curve in of_group for point in curve.points]
            for number, curve in enumerate(of_group):
                axes = drawing.panel(top + PANEL_PX * (number // columns), number % columns, columns)
                axes.set_title(curve.name, loc="left", fontsize=11)
                axes.set_xlim(*_spread([point.speed_kmh for point in points]))
                highest = max(max(p.impact_kmh, p.limit_kmh, p.closed_kmh or 0.0) for p in points)
                axes.set_ylim(0, max(ROAD_TOP_KMH, highest) * 1.08)
                axes.set_xlabel("speed of the row, km/h")
                if number % columns == 0:
                    axes.set_ylabel("speed at impact, km/h")
                legend |= _road_panel(drawing, axes, curve)
            top += PANEL_PX * math.ceil(len(of_group) / columns)
        drawing.legend(title, legend)
        return drawing.svg(standalone=True)


def _road_panel(drawing: "_Drawing", axes: "Axes", curve: RoadCurve) -> "dict[str, Artist]":
    """Draw one curve. Returns an example of each kind of line, by name."""
    found: dict[str, Artist] = {}
    allowed = _limit_steps([(point.speed_kmh, point.limit_kmh) for point in curve.points], axes.get_xlim())
    (line,) = axes.plot(*zip(*allowed, strict=True), color=BAD, linewidth=1.5, linestyle=DOTTED)
    bound = [(point.speed_kmh, point.closed_kmh) for point in curve.points if point.closed_kmh is not None]
    if bound:
        (thin,) = axes.plot(*zip(*bound, strict=True), color=MUTED, linewidth=0.8)
        found["at most, by v = sqrt(2 a (v0 t - d0))"] = thin
    for point in curve.points:
        dot = drawing.dot(axes, point.speed_kmh, point.impact_kmh, 0)
        allows = f"allowed {point.limit_kmh:g} km/h" if point.limit_kmh else "allowed none"
        words = f"{curve.name}: {point.speed_kmh:g} km/h: impact {point.impact_kmh:.1f} km/h, {allows}"
        drawing.tip(dot, words, "point")
        found["speed at impact of a row"] = dot
    return found | {"allowed by the table": line}


def _limit_steps(points: Points, ends: tuple[float, float]) -> Points:
    """A level line for each of `points` (by x), from half-way to its neighbours; outside to `ends`."""
    edges = [(left[0] + right[0]) / 2 for left, right in pairwise(points)]
    levels = zip([ends[0], *edges], [*edges, ends[1]], points, strict=True)
    return [(x, y) for left, right, (_, y) in levels for x in (left, right)]


def _spread(values: Sequence[float]) -> tuple[float, float]:
    """The ends of an axis of rows: a little more than their values."""
    low, high = min(values), max(values)
    spare = 5.0 if high - low < ROAD_SPAN_KMH else 0.05 * (high - low)
    return low - spare, high + spare


class TimeBand(msgspec.Struct, frozen=True):
    """What a mechanism takes to handle a fault, ms: from its p50 to its bound, or to its p99."""

    name: str
    low_ms: float
    high_ms: float


class FttiCurve(msgspec.Struct, frozen=True):
    """The FTTI of one fault and its closed form, both points (km/h, ms). The form may have none."""

    fault: str
    points: Points
    closed: Points = ()


def ftti_plot(title: str, curves: Sequence[FttiCurve], bands: Sequence[TimeBand]) -> str:
    """A panel for each curve, with the bands beside its points.

    There is a curve, and none is empty. Where the end of a band reaches a point, the hazard comes before the
    handling.
    """
    assert curves and all(curve.points for curve in curves), "nothing to draw"
    columns = _columns([curve.fault for curve in curves], len(curves))
    closed = any(curve.closed for curve in curves)
    legend_px = 30.0 + LEGEND_PX * (1 + closed + len(bands))
    height = legend_px + PANEL_PX * math.ceil(len(curves) / columns)
    with _drawing(title, _width(columns), height) as drawing:
        legend: dict[str, Artist] = {}
        every = [point for curve in curves for point in (*curve.points, *curve.closed)]
        ends = [end for band in bands for end in (band.low_ms, band.high_ms) if end > 0.0]
        for number, curve in enumerate(curves):
            axes = drawing.panel(legend_px + PANEL_PX * (number // columns), number % columns, columns)
            logarithmic = _scale(axes, "y", "", [*(ms for _, ms in every), *ends])
            axes.set_title(curve.fault, loc="left", fontsize=11, color=INK)
            low, high = _spread([speed for speed, _ in every])
            strip = BAND_STRIP * (high - low) * len(bands)  # the bands have a place of their own
            axes.set(xlim=(low, high + strip), xlabel="speed, km/h")
            if number % columns == 0:
                axes.set_ylabel("time, ms, logarithmic" if logarithmic else "time, ms")
            legend |= _ftti_panel(drawing, axes, curve)
            for place, band in enumerate(bands):
                at = high + strip * (place + 0.5) / len(bands)
                legend[f"FHTI of {band.name}"] = _band(drawing, axes, band, at, 1 + place)
        drawing.legend(title, legend)
        return drawing.svg(standalone=True)


def _ftti_panel(drawing: "_Drawing", axes: "Axes", curve: FttiCurve) -> "dict[str, Artist]":
    """Draw one curve. Returns an example of each kind of line, by name."""
    line = drawing.line(axes, curve.points, 0)
    line.set(marker="o", markersize=6)
    drawing.tip(line, f"{curve.fault}: {milliseconds(min(ms for _, ms in curve.points))} ms at least", "line")
    if not curve.closed:
        return {"FTTI": line}
    (rings,) = axes.plot(*zip(*curve.closed, strict=True), "o", markersize=11, color=MUTED)
    rings.set(markerfacecolor="none", markeredgewidth=1)
    return {"FTTI": line, "closed form": rings}


def _band(drawing: "_Drawing", axes: "Axes", band: TimeBand, at: float, number: int) -> "Line2D":
    """A bar at `at`, and a dotted line over the whole width where it ends."""
    floor = axes.get_ylim()[0]
    low, high = max(band.low_ms, floor), max(band.high_ms, floor)
    colour = LINES[number % len(LINES)][0]
    axes.axhline(high, color=colour, linewidth=1, linestyle=DOTTED)
    (bar,) = axes.plot((at, at), (low, high), color=colour, linewidth=8)
    bar.set_solid_capstyle("butt")
    words = " to ".join(dict.fromkeys(map(milliseconds, (band.low_ms, band.high_ms))))
    drawing.tip(bar, f"FHTI of {band.name}: {words} ms", "range")
    return bar


def _columns(names: Sequence[str], panels: int) -> int:
    """How many panels stand side by side: as many as there are, and as their names leave room for."""
    longest_px = CHARACTER_PX * max(map(len, names)) + PANEL_LEFT
    return max(1, min(panels, COLUMNS_MAX, int(_width(COLUMNS_MAX) / longest_px)))


def _width(columns: int) -> float:
    return ROAD_PX if columns == 1 else ROAD_PX * columns / 2


# -- matplotlib -----------------------------------------------------------------------------------


def _scale(
    axes: "Axes", which: Literal["x", "y"], name: str, values: Iterable[float], form: Format = milliseconds
) -> bool:
    """Round ticks, on an axis that is logarithmic if the values differ by more than LOG_FROM: returned."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator  # noqa: PLC0415

    ordered = sorted(values)
    low, high = ordered[0], ordered[-1]
    axis = axes.xaxis if which == "x" else axes.yaxis
    limit = axes.set_xlim if which == "x" else axes.set_ylim
    logarithmic = low >= LEAST_MS and high / low > LOG_FROM
    if logarithmic:
        (axes.set_xscale if which == "x" else axes.set_yscale)("log")
        limit(low / 1.15, high * 1.15)
        axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high / low < MANY_DECADES else (1,)))
        axis.set_minor_locator(NullLocator())
    else:
        limit(0, max(high * 1.08, LEAST_MS))
        axis.set_major_locator(MaxNLocator(7, steps=[1, 2, 5, 10]))
    axis.set_major_formatter(FuncFormatter(lambda value, _: form(value)))
    words = f"{name}, logarithmic" if logarithmic else name
    if which == "x":
        axes.set_xlabel(words)
    else:
        axes.set_title(words, loc="left", fontsize=11, color=MUTED)
    return logarithmic


@contextmanager
def _drawing(title: str, width: float, height: float) -> "Iterator[_Drawing]":
    """A drawing in our style, whatever the user's matplotlibrc has."""
    import matplotlib.style  # noqa: PLC0415 - takes a second

    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # it reports the building of its font cache
    with matplotlib.style.context(["default", {**_RC, "svg.hashsalt": title}]):
        yield _Drawing(title, width, height)


class _Drawing:
    """A figure of `width` by `height` pixels."""

    def __init__(self, title: str, width: float, height: float) -> None:
        from matplotlib.figure import Figure  # noqa: PLC0415

        self.title, self.width, self.height = title, width, height
        self._figure = Figure(figsize=(width / DOTS_PER_INCH, height / DOTS_PER_INCH))
        self._tips: list[tuple[str, str]] = []

    def axes(self, left: float, top: float, right: float, bottom: float) -> "Axes":
        """Axes whose frame has these edges, in pixels from the upper left corner."""
        width, height = (right - left) / self.width, (bottom - top) / self.height
        return self._figure.add_axes((left / self.width, 1 - bottom / self.height, width, height))

    def panel(self, top: float, column: int, columns: int) -> "Axes":
        """Axes in one of `columns` columns, with room for a name above and for labels."""
        left, each = self.width * column / columns, self.width / columns
        return self.axes(
            left + PANEL_LEFT, top + PANEL_TOP, left + each - PANEL_RIGHT, top + PANEL_PX - PANEL_BOTTOM
        )

    def heading(self, words: str, baseline: float) -> None:
        self._figure.text(PANEL_LEFT / self.width, 1 - baseline / self.height, words, weight="bold")

    def line(self, axes: "Axes", points: Points, number: int) -> "Line2D":
        """In the style with that number."""
        colour, dashes = LINES[number % len(LINES)][0], _dashes(number)
        (line,) = axes.plot(*zip(*points, strict=True), color=colour)
        if dashes:
            line.set_linestyle((0, tuple(map(float, dashes.split()))))
        return line

    def dot(self, axes: "Axes", x: float, y: float, number: int) -> "Line2D":
        """A ring in the colour with that number."""
        (dot,) = axes.plot(x, y, "o", markersize=6, color=LINES[number % len(LINES)][0])
        dot.set(markerfacecolor=GROUND, markeredgewidth=2)
        return dot

    def tip(self, artist: "Artist", words: str, css: str) -> None:
        """Give `artist` a tooltip and a class."""
        artist.set_gid(f"tip-{len(self._tips)}")
        self._tips.append((words, css))

    def legend(self, title: str, lines: "Mapping[str, Artist]") -> None:
        """Title and legend in the upper left corner."""
        place = (52 / self.width, 1 - 6 / self.height)
        self._figure.suptitle(title, x=place[0], y=place[1], ha="left", va="top", size=11, weight="bold")
        box = (48 / self.width, 1 - 22 / self.height)
        handles, names = list(lines.values()), list(lines)
        self._figure.legend(handles, names, loc="upper left", bbox_to_anchor=box, frameon=False)

    def svg(self, css: str = "plot", *, standalone: bool = False) -> str:
        """For a page without namespace and with its colours, or as a file."""
        for artist in self._figure.findobj():
            artist.set_clip_on(False)  # all lies within the axes; a clip path would be one more id
        file = io.StringIO()
        self._figure.savefig(file, format="svg", transparent=not standalone, metadata={"Date": None})
        root = ElementTree.fromstring(file.getvalue())
        for parent in list(root.iter()):
            for child in list(parent):
                if child.tag in (f"{{{SVG}}}metadata", f"{{{SVG}}}style"):
                    parent.remove(child)
        used = {href[1:] for element in root.iter() if (href := element.get(HREF))}
        for element in list(root.iter()):
            self._tidy(element, used, COLOURS if not standalone else {})
        about = {"width": f"{self.width:g}", "height": f"{self.height:g}", "stroke-linejoin": "round"}
        root.attrib |= about | {"class": css, "role": "img", "aria-label": self.title}
        root.attrib |= {"xmlns": SVG} if standalone else {}
        del root.attrib["version"]
        if standalone:
            root.insert(0, _dark_style())
        return ElementTree.tostring(root, encoding="unicode") + ("\n" if standalone else "")

    def _tidy(self, element: ElementTree.Element, used: set[str], colours: Mapping[str, str]) -> None:
        """Leave the namespaces, unused ids and needless digits; put the tooltip in."""
        element.tag = element.tag.partition("}")[2]
        if (href := element.attrib.pop(HREF, None)) is not None:
            element.set("href", href)
        name = element.attrib.pop("id", "")
        if name in used:
            element.set("id", name)
        if tip := _TIP.fullmatch(name):
            words, css = self._tips[int(tip[1])]
            element.set("class", css)
            title = ElementTree.Element("title")
            title.text = words
            element.insert(0, title)
        for key in ("d", "x", "y", "transform"):
            if (value := element.get(key)) is not None:
                element.set(key, _DIGITS.sub(r"\1", value))
        if style := element.get("style"):
            style = _FONT.sub(FONT, style)
            element.set("style", _COLOUR.sub(lambda found: colours.get(found[0], found[0]), style))


def _dark_style() -> ElementTree.Element:
    """For a browser on a dark screen; other programs leave it and show the light colours."""
    rules = (
        f'[style*="{what}: {light}"]{{{what}:{dark} !important}}'
        for light, dark in DARK.items()
        for what in ("fill", "stroke")
    )
    style = ElementTree.Element("style")
    style.text = f"@media (prefers-color-scheme: dark){{{''.join(rules)}}}"
    return style

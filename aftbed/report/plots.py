"""Plots as SVG, drawn by matplotlib: distributions of times, sweeps, ranges, and the table of the road.

`ecdf`, `curves` and `ranges` are pieces of a page: without a namespace, in the colours of the page's style
sheet (so that a dark screen and paper get theirs), with a tooltip per line. `road_plot` is a file of its own.
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
FONT: Final = 'system-ui, "Segoe UI", Roboto, "DejaVu Sans", Arial, sans-serif'
WIDTH, HEIGHT = 560.0, 250.0
LEFT, RIGHT, TOP, BOTTOM = 46.0, 14.0, 18.0, 40.0
LIMIT_PX: Final = 14.0  # from the name of a limit to that of the next
CHARACTER_PX: Final = 6.3  # mean width of a character at 11 px
RANGE_PX: Final = 46.0  # of a row of `ranges`
RANGE_PX_MIN: Final = 6.0  # width of a bar; a narrower one gets caps
GROUP_PX, ROAD_PX = 300.0, 620.0  # height of a picture of `road_plot`, and its width
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
    """A bar for each range of each row, the paper's above ours."""
    assert rows, "nothing to draw"
    height = TOP + RANGE_PX * len(rows) + BOTTOM
    with _drawing(title, WIDTH, height) as drawing:
        axes = drawing.axes(LEFT, TOP, WIDTH - RIGHT, height - BOTTOM)
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
        return drawing.svg()


# -- the table of the road ----------------------------------------------------------------------------


def road_plot(title: str, curves: Sequence[RoadCurve]) -> str:
    """The speed that is left at impact over the speed of the row, as a file of its own.

    One picture for each group, below each other, with a line for each mechanism and length of an outage. What
    the table allows is a dotted line, and the closed form of an outage (an upper bound) a thin one. There is
    at least one curve, and none is empty; a group of one row is drawn as points.
    """
    assert curves and all(curve.points for curve in curves)
    styles = {name: number for number, name in enumerate(dict.fromkeys(curve.name for curve in curves))}
    groups = list(dict.fromkeys(curve.group for curve in curves))
    legend_px = 40.0 + 18.0 * (len(styles) + 2)
    with _drawing(title, ROAD_PX, legend_px + GROUP_PX * len(groups)) as drawing:
        legend: dict[str, Line2D] = {}
        for number, group in enumerate(groups):
            top = legend_px + GROUP_PX * number
            axes = drawing.axes(52, top + 34, ROAD_PX - 16, top + GROUP_PX - 44)
            axes.set_title(group, loc="left", fontsize=11, fontweight="bold")
            of_group = [curve for curve in curves if curve.group == group]
            legend |= _road_picture(drawing, axes, of_group, styles)
        drawing.legend(title, legend)
        return drawing.svg(standalone=True)


def _road_picture(
    drawing: "_Drawing", axes: "Axes", curves: Sequence[RoadCurve], styles: Mapping[str, int]
) -> "dict[str, Line2D]":
    """One group. Returns an example of each kind of line, by name."""
    points = [point for curve in curves for point in curve.points]
    speeds = [point.speed_kmh for point in points]
    spare = 5.0 if max(speeds) - min(speeds) < ROAD_SPAN_KMH else 0.0
    highest = max(max(p.impact_kmh, p.limit_kmh, p.closed_kmh or 0.0) for p in points)
    axes.set(xlim=(min(speeds) - spare, max(speeds) + spare), ylim=(0, max(ROAD_TOP_KMH, highest) * 1.08))
    axes.set_xlabel("km/h of the row; upright: km/h at impact")
    allowed = [(point.speed_kmh, point.limit_kmh) for point in curves[0].points]
    found: dict[str, Line2D] = {}
    for curve in curves:
        bound = [(p.speed_kmh, p.closed_kmh) for p in curve.points if p.closed_kmh is not None]
        if bound:
            line = drawing.line(axes, bound, styles[curve.name])
            line.set(linewidth=0.8, linestyle="solid")
            found.setdefault("thin: at most, by v = sqrt(2 a (v0 t - d0))", line)
        line = drawing.line(axes, [(p.speed_kmh, p.impact_kmh) for p in curve.points], styles[curve.name])
        line.set(marker="o", markersize=5)
        worst = max(point.impact_kmh for point in curve.points)
        drawing.tip(line, f"{curve.name}: up to {worst:.1f} km/h", "line")
        found[curve.name] = line
    (line,) = axes.plot(*zip(*allowed, strict=True), color=BAD, linewidth=1.5, linestyle=DOTTED)
    return found | {"allowed by the table": line}


# -- FTTI over speed --------------------------------------------------------------------------------


class TimeBand(msgspec.Struct, frozen=True):
    """What a mechanism takes to handle a fault, ms: from its p50 to its bound, or to its p99."""

    name: str
    low_ms: float
    high_ms: float


def ftti_plot(title: str, lines: Mapping[str, Points], bands: Sequence[TimeBand]) -> str:
    """A line for each of `lines`, points (km/h, ms), and the bands below them, as a file of its own.

    There is a line, and none is empty. Where a band reaches a line, the hazard comes before the handling.
    """
    assert lines and all(lines.values()), "nothing to draw"
    legend_px = 40.0 + 18.0 * (len(lines) + len(bands))
    with _drawing(title, ROAD_PX, legend_px + GROUP_PX) as drawing:
        axes = drawing.axes(52, legend_px + 34, ROAD_PX - 16, legend_px + GROUP_PX - 44)
        speeds = [speed for points in lines.values() for speed, _ in points]
        ends = [end for band in bands for end in (band.low_ms, band.high_ms) if end > 0.0]
        _scale(axes, "y", "ms", [*(ms for points in lines.values() for _, ms in points), *ends])
        spare = 5.0 if max(speeds) - min(speeds) < ROAD_SPAN_KMH else 1.0
        axes.set_xlim(min(speeds) - spare, max(speeds) + spare)
        axes.set_xlabel("km/h")
        legend: dict[str, Artist] = {}
        for number, (name, points) in enumerate(lines.items()):
            line = drawing.line(axes, points, number)
            line.set(marker="o", markersize=5)
            drawing.tip(line, f"{name}: {milliseconds(min(ms for _, ms in points))} ms at least", "line")
            legend[name] = line
        for number, band in enumerate(bands, len(lines)):
            low, high = max(band.low_ms, axes.get_ylim()[0]), max(band.high_ms, axes.get_ylim()[0])
            colour = LINES[number % len(LINES)][0]
            legend[f"FHTI of {band.name}"] = axes.axhspan(low, high, color=colour, alpha=0.3)
        drawing.legend(title, legend)
        return drawing.svg(standalone=True)


# -- matplotlib -----------------------------------------------------------------------------------


def _scale(
    axes: "Axes", which: Literal["x", "y"], name: str, values: Iterable[float], form: Format = milliseconds
) -> None:
    """Round ticks, on an axis that is logarithmic if the values differ by more than LOG_FROM."""
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

    def svg(self, *, standalone: bool = False) -> str:
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
        root.attrib |= about | {"class": "plot", "role": "img", "aria-label": self.title}
        root.attrib |= {"xmlns": SVG} if standalone else {}
        del root.attrib["version"]
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

"""Distributions of times, drawn as empirical distribution functions: which share of the runs took at most x.

An ECDF shows every value, needs no bins, and a quantile can be read off it; two modes (a crash is seen at
once, a hang only at its deadline) are two steps. A line per mechanism, told apart by its dashes as well as by
its colour. Where the values differ by more than `LOG_FROM`, their axis is logarithmic. What the campaign
allows (its recovery budget, the gates on these times) is an upright line.

Limits: at most `POINTS_MAX` points of a line are drawn, at even distances in share, the ends included.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import msgspec

from aftbed.campaign.statistics import quantile
from aftbed.report import svg

POINTS_MAX: Final = 400
LOG_FROM: Final = 20.0
LEAST_MS: Final = 0.001  # times are kept to the microsecond
STYLES: Final = 7  # of lines: the next one looks like the first
TICKS_MAX: Final = 8
WIDTH, HEIGHT = 560.0, 250.0
LEFT, RIGHT, TOP, BOTTOM = 46.0, 14.0, 14.0, 40.0
LIMIT_PX: Final = 14.0  # from the name of a limit to that of the next
SHARES: Final = (0.0, 0.25, 0.5, 0.75, 1.0)


class Limit(msgspec.Struct, frozen=True):
    """An upright line at `ms`."""

    name: str
    ms: float


class Axis(msgspec.Struct, frozen=True):
    """From values to pixels."""

    low: float
    high: float
    logarithmic: bool

    def x(self, value: float) -> float:
        """Where `value` lies."""
        low, high, at = self.low, self.high, max(value, self.low)
        if self.logarithmic:
            low, high, at = math.log10(low), math.log10(high), math.log10(at)
        return LEFT + (WIDTH - LEFT - RIGHT) * (at - low) / (high - low)

    def ticks(self) -> list[float]:
        """Round values: of a decade all, or 1, 2 and 5, or 1 alone, as many as there is room for."""
        if not self.logarithmic:
            step = _round_step((self.high - self.low) / TICKS_MAX)
            return [step * n for n in range(int(self.high / step + 1e-9) + 1)]
        first, last = math.floor(math.log10(self.low)), math.ceil(math.log10(self.high))
        for digits in ((1, 2, 3, 4, 5, 6, 7, 8, 9), (1, 2, 5), (1, 3), (1,)):
            found = [digit * 10.0**power for power in range(first, last + 1) for digit in digits]
            found = [value for value in found if self.low * 0.999 <= value <= self.high * 1.001]
            if len(found) <= TICKS_MAX:
                return found
        return found[:: math.ceil(len(found) / TICKS_MAX)]


def axis_of(values: Iterable[float]) -> Axis:
    """One on which all of `values` have their place."""
    found = sorted(values)
    low, high = found[0], found[-1]
    if low >= LEAST_MS and high / low > LOG_FROM:
        return Axis(low / 1.15, high * 1.15, logarithmic=True)
    return Axis(0.0, max(high * 1.08, LEAST_MS), logarithmic=False)


def ecdf(
    title: str, lines: Mapping[str, Sequence[float]], styles: Mapping[str, int], limits: Sequence[Limit]
) -> str:
    """A line for each of `lines` that has values, ms; `styles` has a number for each name."""
    drawn = {name: sorted(values) for name, values in lines.items() if values}
    assert drawn, "nothing to draw"
    ends = [end for values in drawn.values() for end in (values[0], values[-1])]
    axis = axis_of((*ends, *(limit.ms for limit in limits if limit.ms > 0)))
    parts = [*_frame(axis), *_limits(axis, limits)]
    parts += [_curve(axis, name, values, styles[name]) for name, values in drawn.items()]
    down = LIMIT_PX * len(limits)  # the names of limits stand above the frame, where no line passes
    page = svg.element("g", {"transform": f"translate(0 {down:g})"}, *parts)
    return svg.drawing(WIDTH, HEIGHT + down, f"{title}: share of runs over time in ms", page, css="plot")


def swatch(style: int) -> str:
    """A short piece of a line, for a legend."""
    return svg.drawing(30, 10, "", svg.path("M1 5H29", f"curve l{style % STYLES}"), css="swatch")


def milliseconds(value: float) -> str:
    """For people: three digits, no more."""
    return f"{value:.3g}" if value < 1000 else f"{value:.0f}"


def _y(share: float) -> float:
    return HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * share


def _frame(axis: Axis) -> list[str]:
    right, bottom = WIDTH - RIGHT, HEIGHT - BOTTOM
    parts = []
    for share in SHARES:
        parts.append(svg.line(LEFT, _y(share), right, _y(share), "grid"))
        parts.append(svg.label(LEFT - 6, _y(share) + 4, f"{share:.0%}".replace("%", " %"), "tick", "end"))
    for value in axis.ticks():
        x = axis.x(value)
        parts.append(svg.line(x, TOP, x, bottom + 4, "grid"))
        parts.append(svg.label(x, bottom + 17, milliseconds(value), "tick", "middle"))
    name = "ms, logarithmic" if axis.logarithmic else "ms"
    return [*parts, svg.label((LEFT + right) / 2, HEIGHT - 6, name, "tick", "middle")]


def _limits(axis: Axis, limits: Sequence[Limit]) -> list[str]:
    parts = []
    for place, limit in enumerate(limits):
        x = axis.x(limit.ms)
        fits = x + 5 + svg.width_of(limit.name) < WIDTH - RIGHT
        at = (x + 5, "start") if fits else (x - 5, "end")
        y = TOP - 5 - LIMIT_PX * place
        parts.append(svg.line(x, y - 8, x, HEIGHT - BOTTOM, "limit"))
        parts.append(svg.label(at[0], y, limit.name, "limit-name", at[1]))
    return parts


def _curve(axis: Axis, name: str, values: list[float], style: int) -> str:
    count = len(values)
    step = max(1, math.ceil(count / POINTS_MAX))
    ranks = [*range(0, count - 1, step), count - 1]
    pieces = [f"M{axis.x(values[0]):.1f} {_y(0):.1f}"]
    for rank in ranks:
        pieces.append(f"H{axis.x(values[rank]):.1f}V{_y((rank + 1) / count):.1f}")
    said = ", ".join(f"{word} {milliseconds(quantile(values, q))} ms" for word, q in _QUANTILES.items())
    title = f"{name}: {count} runs, {said}, max {milliseconds(values[-1])} ms"
    end: svg.Attributes = {"cx": axis.x(values[-1]), "cy": _y(1), "r": 3, "class": f"end l{style % STYLES}"}
    curve = svg.path("".join(pieces), f"curve l{style % STYLES}")
    return svg.group("line", curve, svg.element("circle", end), title=title)


_QUANTILES: Final = {"p50": 0.5, "p99": 0.99}


def _round_step(least: float) -> float:
    power = 10.0 ** math.floor(math.log10(least))
    return next(power * digit for digit in (1, 2, 5, 10) if power * digit >= least)

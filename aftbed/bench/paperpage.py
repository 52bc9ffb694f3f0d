"""The document of `aftbed bench paper` as a page: one file, which needs neither network nor script.

The style sheet and the drawing are those of a campaign's report.
"""

from pathlib import Path
from typing import Final

import jinja2
import msgspec
from markupsafe import Markup

from aftbed.bench import curves
from aftbed.bench.curves import Points, Range
from aftbed.bench.paperdocument import Paper
from aftbed.bench.papertext import here, notes, size, tables
from aftbed.report import plots
from aftbed.report.html import TEMPLATES as STYLES

TEMPLATES: Final = Path(__file__).resolve().parent / "templates"


class Plot(msgspec.Struct, frozen=True):
    """A drawing under the table called `table`, and what its lines are."""

    table: str
    title: str
    drawing: Markup
    lines: tuple[tuple[str, Markup], ...]


def html_page(paper: Paper) -> str:
    """The whole page."""
    engine = jinja2.Environment(
        loader=jinja2.FileSystemLoader([TEMPLATES, STYLES]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    drawn = _plots(paper)
    return engine.get_template("paper.html.j2").render(
        paper=paper,
        tables=tables(paper),
        here=here(paper),
        notes=notes(paper),
        plots={table.name: [p for p in drawn if p.table == table.name] for table in tables(paper)},
    )


def _plots(paper: Paper) -> list[Plot]:
    rows = [
        Range(
            figure.what,
            (figure.paper.low, figure.paper.high) if figure.paper else None,
            (figure.ours_ms.p50, figure.ours_ms.p99),
        )
        for figure in paper.figures
    ]
    title = "The paper, and here from p50 to p99"
    legend = (("here", Markup(plots.swatch(0))), ("the paper", Markup(plots.swatch(1))))
    return [
        Plot("times", title, Markup(curves.ranges(title, rows)), legend),
        *_state_plots(paper),
        *_load_plots(paper),
    ]


def _state_plots(paper: Paper) -> list[Plot]:
    cycle: dict[str, Points] = {}
    blackout: dict[str, Points] = {}
    for ftm in dict.fromkeys(row.ftm for row in paper.state):
        rows = [row for row in paper.state if row.ftm == ftm]
        cycle[ftm] = [(row.state_bytes, row.cycle_us.p50) for row in rows if row.cycle_us]
        blackout[ftm] = [(row.state_bytes, row.blackout_ms.p50) for row in rows if row.blackout_ms]
    return [
        *_plot("state", "Cycle, p50", cycle, "state", "us", bytes_on_x=True),
        *_plot("state", "Blackout of an update, p50", blackout, "state", "ms", bytes_on_x=True),
    ]


def _load_plots(paper: Paper) -> list[Plot]:
    latency: dict[str, Points] = {}
    cpu: dict[str, Points] = {}
    for placement in dict.fromkeys(row.placement for row in paper.load):
        rows = [row for row in paper.load if row.placement == placement]
        latency[f"{placement}, p50"] = [(row.rate_hz, row.latency_ms.p50) for row in rows]
        latency[f"{placement}, p99"] = [(row.rate_hz, row.latency_ms.p99) for row in rows]
        cpu[placement] = [(row.rate_hz, row.usage.cpu_percent) for row in rows]
    return [
        *_plot("load", "Latency", latency, "requests a second", "ms"),
        *_plot("load", "CPU, all processes of the graph", cpu, "requests a second", "% of one core"),
    ]


def _plot(
    table: str, title: str, lines: dict[str, Points], x_name: str, y_name: str, *, bytes_on_x: bool = False
) -> list[Plot]:
    """One plot; none where nothing was measured."""
    drawn = {name: points for name, points in lines.items() if points}
    if not drawn:
        return []
    say_x = size if bytes_on_x else plots.milliseconds
    drawing = curves.curves(title, drawn, x_name, y_name, say_x)
    legend = tuple((name, Markup(plots.swatch(style))) for style, name in enumerate(drawn))
    return [Plot(table, title, Markup(drawing), legend)]

"""The HTML report: one file, which needs neither network nor script nor anything beside it.

The page is made by a Jinja2 template that escapes whatever it is given; what is drawn is SVG in the page
itself. Tooltips are `title` elements and links are anchors, so all of it works in a browser that runs no
script, in a mail, and on paper. Its size depends on the strata and not on the experiments: of ten thousand
runs the worst are told, the rest is counted.
"""

import re
from collections.abc import Iterable, Iterator, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Final

import jinja2
import msgspec
from markupsafe import Markup

from aftbed.campaign.experiment import Result
from aftbed.campaign.ledger import Ledger
from aftbed.campaign.spec import Gate, Spec
from aftbed.campaign.statistics import Interval
from aftbed.campaign.summary import Summary, confidence_of
from aftbed.judge.outcome import OUTCOMES
from aftbed.report import plots
from aftbed.report.matrix import MEANINGS, Places, anchor_of, matrix, shares
from aftbed.report.plots import Limit, milliseconds
from aftbed.report.spacetime import space_time
from aftbed.report.worst import by_badness, rerun, slowness_ms

TEMPLATES: Final = Path(__file__).resolve().parent / "templates"
DRAWN_MAX: Final = 3  # runs that are simulated again
LISTED_MAX: Final = 20
PANELS_MAX: Final = 6  # of one kind of time
METRICS: Final = {
    "recovery_ms": ("Recovery", "from the fault to the first good reply of the new master"),
    "blackout_ms": ("Blackout of a failover", "while a request waited and nobody could answer it"),
    "adapt_blackout_ms": ("Blackout of an adaptation", "while an adaptation kept the client waiting"),
}
_UNREADABLE: Final = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")


class Panel(msgspec.Struct, frozen=True):
    """A plot: of the runs with one kind of fault; `lines` are named by the rows of the matrix."""

    fault: str
    lines: tuple[str, ...]
    count: int
    drawing: Markup


class Times(msgspec.Struct, frozen=True):
    """One kind of time, and the plots of it."""

    anchor: str
    title: str
    meaning: str
    panels: tuple[Panel, ...]
    left_out: int  # kinds of fault


class Line(msgspec.Struct, frozen=True):
    """An entry of the plots' legend."""

    name: str
    swatch: Markup


class Told(msgspec.Struct, frozen=True):
    """A run to look at. `names`, `body` and `text` of its diagram are empty where it is not drawn."""

    result: Result
    anchor: str
    stratum: str
    slowness_ms: float
    command: str
    names: Markup = Markup()
    body: Markup = Markup()
    text: str = ""
    note: str = ""


def html_report(summary: Summary, ledger: Ledger, *, drawn: int = DRAWN_MAX) -> str:
    """The whole page; `drawn` of the worst runs are simulated once more, to draw them."""
    spec, place = ledger.head.spec, Places(ledger.head.spec)
    rows = dict.fromkeys(place(stratum.name)[0] for stratum in summary.strata)
    styles = {row: number for number, row in enumerate(rows)}
    anchors = {stratum.name: anchor_of(number) for number, stratum in enumerate(summary.strata)}
    worst = by_badness(ledger.results)
    times = [_times(metric, ledger.results, spec, styles) for metric in METRICS]
    timed = {name for kind in times for panel in kind.panels for name in panel.lines}
    page = _engine().get_template("report.html.j2")
    said = page.render(
        summary=summary,
        spec=spec,
        head=ledger.head,
        matrix=matrix(spec, summary.strata),
        outcomes=[name for name in OUTCOMES if name in summary.outcomes],
        meanings=MEANINGS,
        times=times,
        lines=[Line(name, Markup(plots.swatch(styles[name]))) for name in rows if name in timed],
        worst=list(_told(worst[:LISTED_MAX], anchors, drawn)),
        worst_count=len(worst),
        strata=[(anchors[s.name], s, shares(s)) for s in summary.strata],
        failed_gates=sum(gate.word == "fail" for gate in summary.gates),
        unexpected=sum(s.unexpected for s in summary.strata),
        confidence=confidence_of(spec),
        environment=ledger.head.environment,
    )
    return _UNREADABLE.sub("�", said)


def _engine() -> jinja2.Environment:
    engine = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    engine.filters |= {"ms": milliseconds, "percent": percent, "interval": interval, "count": _count}
    return engine


# -- figures --------------------------------------------------------------------------------------


def percent(share: float) -> str:
    """`8.8 %`, `0 %`; what is not quite all, or not quite nothing, is never rounded to it."""
    if share in (0, 1):
        return f"{100 * share:.0f} %"
    if share < 0.0005 or share > 0.9995:
        return "< 0.1 %" if share < 0.5 else "> 99.9 %"
    return f"{100 * share:.1f} %"


def interval(found: Interval) -> str:
    """Of a share."""
    return f"{percent(found.low)} to {percent(found.high)}"


def _count(value: float) -> str:
    """`12 800`."""
    return f"{value:,.0f}".replace(",", " ")


# -- times ----------------------------------------------------------------------------------------


def _times(metric: str, results: Iterable[Result], spec: Spec, styles: dict[str, int]) -> Times:
    place = Places(spec)
    found: dict[str, dict[str, list[float]]] = {}
    names: dict[str, dict[str, None]] = {}
    for result in results:
        value: float | None = getattr(result, metric)
        if value is not None:
            row, fault = place(result.experiment.stratum)
            found.setdefault(fault, {}).setdefault(row, []).append(value)
            names.setdefault(fault, {})[result.experiment.stratum] = None
    title, meaning = METRICS[metric]
    panels = []
    for fault, lines in list(found.items())[:PANELS_MAX]:
        limits = list(_limits(metric, spec, names[fault]))
        drawing = plots.ecdf(f"{title}, {fault}", lines, styles, limits)
        panels.append(Panel(fault, tuple(lines), sum(map(len, lines.values())), Markup(drawing)))
    return Times(f"times-{metric}", title, meaning, tuple(panels), max(0, len(found) - PANELS_MAX))


def _limits(metric: str, spec: Spec, strata: Iterable[str]) -> Iterator[Limit]:
    """What the campaign allows of this time, in strata of these names."""
    names = list(strata)
    if metric == "recovery_ms" and spec.recovery_budget_ms is not None:
        yield Limit(f"budget {spec.recovery_budget_ms:g} ms", spec.recovery_budget_ms)
    for gate in spec.gates:
        of, _, which = gate.metric.rpartition("_")
        if of == metric and any(fnmatch(name, gate.strata) for name in names):
            yield Limit(
                f"gate: {which} {_asked(gate)} ms", gate.max if gate.max is not None else gate.min or 0.0
            )


def _asked(gate: Gate) -> str:
    return f"at most {gate.max:g}" if gate.max is not None else f"at least {gate.min:g}"


# -- the worst runs -------------------------------------------------------------------------------


def _told(worst: Sequence[Result], anchors: dict[str, str], drawn: int) -> Iterator[Told]:
    for number, result in enumerate(worst):
        experiment = result.experiment
        told = Told(
            result,
            f"run-{experiment.id}",
            anchors.get(experiment.stratum, ""),
            slowness_ms(result),
            experiment.command(),
        )
        yield _drawn(told) if number < drawn else told


def _drawn(told: Told) -> Told:
    result = told.result
    again = rerun(result.experiment)
    if again.trace is None:
        return msgspec.structs.replace(told, note=f"Not drawn: it cannot be simulated: {again.why_not}")
    picture = space_time(again.trace)
    same = again.outcome == result.outcome
    note = "As simulated." if same else f"As simulated, where it came out otherwise: {again.outcome}."
    return msgspec.structs.replace(
        told, names=Markup(picture.names), body=Markup(picture.body), text=picture.text, note=note
    )

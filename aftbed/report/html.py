"""The HTML report: one file, which needs neither network nor script nor anything beside it.

The page is made by a Jinja2 template that escapes what it is given; drawings are SVG in the page itself.
Tooltips are `title` elements and links are anchors, so all of it works in a browser that runs no script, in a
mail, and on paper. Its size depends on the number of strata and not on that of experiments: of ten thousand
runs the worst are listed and the others are counted.
"""

import functools
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Final

import jinja2
import msgspec
from markupsafe import Markup, escape

from aftbed.campaign.experiment import Result
from aftbed.campaign.ledger import Ledger
from aftbed.campaign.plan import JOINED, strata_of
from aftbed.campaign.spec import Gate, Spec
from aftbed.campaign.statistics import Interval
from aftbed.campaign.summary import StratumSummary, Summary, confidence_of
from aftbed.judge.outcome import OUTCOMES, UNKNOWN
from aftbed.report import plots
from aftbed.report.plots import Limit, milliseconds
from aftbed.report.sequence import SpaceTime, space_time
from aftbed.report.terminal import p99_bound, remedy
from aftbed.report.terminal import places as places_text
from aftbed.report.worst import by_badness, rerun, slowness_ms

TEMPLATES: Final = Path(__file__).resolve().parent / "templates"
DRAWN_MAX: Final = 3  # runs that are simulated again
LISTED_MAX: Final = 20
COLUMNS_MAX: Final = 4  # of a matrix of outcomes on a usual screen: with more it is turned
FAULT, MECHANISM = "fault", "mechanism"  # what the rows of a matrix are
PANELS_MAX: Final = 6  # plots of one kind of time
METRICS: Final = {
    "recovery_ms": ("Recovery", "from the fault to the first good reply of the new master"),
    "blackout_ms": ("Blackout of a failover", "while a request waited and no replica could answer it"),
    "adapt_blackout_ms": ("Blackout of an adaptation", "while an adaptation kept the client waiting"),
    "fhti_ms": ("FHTI", "from the fault to the next good reply, or to the detected stop"),
}
MEANINGS: Final = {
    "masked": "the client could not notice the fault",
    "latent": "right replies, but the state of a replica is wrong at the end",
    "tolerated": "the mechanism had to act: a failover, a third execution",
    "degraded": "late replies, a recovery over its budget, or no redundancy at the end",
    "detected_stop": "a replica ended itself rather than answer",
    "omission": "requests without a reply, then replies again",
    "duplicate_effect": "a request took effect twice, or was answered twice",
    "unavailable": "no replica was left",
    "hang": "a replica was left, but no reply came any more",
    "sdc": "a wrong reply reached the client",
    "inconclusive": "the record is not whole: nothing is known of the mechanism",
    "harness_error": "trouble of the testbed: nothing is known of the mechanism",
}
assert tuple(MEANINGS) == OUTCOMES
_CODE: Final = re.compile("`([^`]+)`")
_UNREADABLE: Final = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")


def html_report(summary: Summary, ledger: Ledger, *, drawn: int = DRAWN_MAX) -> str:
    """The whole page; `drawn` of the worst runs are simulated once more, to draw them."""
    spec = ledger.head.spec
    known = Places(spec)
    places = {stratum.name: known.of(stratum.name) for stratum in summary.strata}
    anchors = {stratum.name: f"stratum-{number}" for number, stratum in enumerate(summary.strata)}
    worst = by_badness(ledger.results)
    timed = [result for result in ledger.results if _is_timed(result)]
    rows = dict.fromkeys(known.of(result.experiment.stratum)[0] for result in timed)
    pooled = len(rows) > len(plots.LINES)
    named = _by_mechanism if pooled else known.row_of
    styles = {name: number for number, name in enumerate(dict.fromkeys(map(named, timed)))}
    times = [_time_plots(metric, timed, spec, named, styles) for metric in METRICS]
    page = engine(TEMPLATES).get_template("report.html.j2")
    return page_text(
        page,
        summary=summary,
        weaknesses=[(one, places_text(one.seen), with_code(remedy(one))) for one in summary.weaknesses],
        spec=spec,
        head=ledger.head,
        matrices=_matrices(summary.strata, places),
        shares={stratum.name: shares(stratum) for stratum in summary.strata},
        anchors=anchors,
        outcomes=[name for name in OUTCOMES if name in summary.outcomes],
        meanings=MEANINGS,
        unknown=UNKNOWN,
        times=times,
        lines=list(styles.items()),
        pooled=pooled,
        worst=list(_worst_runs(worst[:LISTED_MAX], drawn)),
        worst_count=len(worst),
        failed_gates=sum(gate.word == "fail" for gate in summary.gates),
        unexpected=sum(stratum.unexpected for stratum in summary.strata),
        confidence=confidence_of(spec),
        handled=[(stratum.name, stratum.handling) for stratum in summary.strata if stratum.handling],
        p99_bound=p99_bound,
        environment=ledger.head.environment,
    )


@functools.cache  # it keeps the templates that it has compiled
def engine(*folders: Path) -> jinja2.Environment:
    """For pages whose templates are in `folders`: it escapes all values, and refuses unknown names."""
    found = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folders),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    found.filters |= {"ms": milliseconds, "percent": percent, "interval": interval, "count": _count}
    found.filters |= {"px": _px, "line_style": plots.line_style}
    return found


def space_time_svg(diagram: SpaceTime) -> str:
    """The diagram as a file of its own, as the pages have it."""
    return page_text(engine(TEMPLATES).get_template("spacetime.svg.j2"), d=diagram)


def page_text(page: jinja2.Template, **values: object) -> str:
    """The page without characters that no HTML may contain."""
    return _UNREADABLE.sub("�", page.render(**values))


# -- figures --------------------------------------------------------------------------------------


def percent(share: float) -> str:
    """`8.8 %`, `0 %`; a share that is almost all, or almost nothing, is never rounded to it."""
    if share in (0, 1):
        return f"{100 * share:.0f} %"
    if share < 0.0005 or share > 0.9995:
        return "< 0.1 %" if share < 0.5 else "> 99.9 %"
    return f"{100 * share:.1f} %"


def interval(found: Interval) -> str:
    """Of a share."""
    return f"{percent(found.low)} to {percent(found.high)}"


def with_code(text: str) -> Markup:
    """What stands between backquotes is code."""
    return Markup(_CODE.sub(r"<code>\1</code>", str(escape(text))))


def _count(value: float) -> str:
    """`12 800`."""
    return f"{value:,.0f}".replace(",", " ")


def _px(value: float) -> str:
    return f"{value:.1f}".removesuffix(".0")


# -- the matrix of outcomes -------------------------------------------------------------------------


class OutcomeShare(msgspec.Struct, frozen=True):
    """A piece of a stratum's bar."""

    outcome: str
    count: int
    percent: float


class Places:
    """Row (mechanism, placement and adaptation) and column (fault) of a stratum, by its name."""

    def __init__(self, spec: Spec) -> None:
        self._faults = {found.name: found.fault.name for found in strata_of(spec)}

    def of(self, stratum: str) -> tuple[str, str]:
        fault = self._faults.get(stratum, stratum.rpartition(JOINED)[2])
        return stratum.removesuffix(f"{JOINED}{fault}"), fault

    def row_of(self, result: Result) -> str:
        return self.of(result.experiment.stratum)[0]


def shares(stratum: StratumSummary) -> list[OutcomeShare]:
    """Its outcomes, the best first."""
    counts = stratum.outcomes.items()
    return [OutcomeShare(name, count, 100 * count / stratum.experiments) for name, count in counts]


class Matrix(msgspec.Struct, frozen=True):
    """Strata by row and column; in `corner`, what the rows are."""

    corner: str
    columns: list[str]
    rows: dict[str, dict[str, StratumSummary]]

    def turned(self) -> "Matrix":
        """Its columns as rows: a page can be as long as it wants, and no wider than its screen."""
        rows = {
            column: {name: cells[column] for name, cells in self.rows.items() if column in cells}
            for column in self.columns
        }
        return Matrix(FAULT, list(self.rows), rows)


def _matrices(strata: Iterable[StratumSummary], places: dict[str, tuple[str, str]]) -> list[Matrix]:
    """One for all rows that share columns: rows with other faults are another table, not empty cells.

    Faults are columns, so that what a mechanism makes of each stands side by side; rows, where they are many.
    """
    rows: dict[str, dict[str, StratumSummary]] = {}
    for stratum in strata:
        row, fault = places[stratum.name]
        rows.setdefault(row, {})[fault] = stratum
    found: list[Matrix] = []
    for name, cells in rows.items():
        shared = [matrix for matrix in found if cells.keys() & set(matrix.columns)]
        joined = Matrix(MECHANISM, [], {})
        for matrix in (*shared, Matrix(MECHANISM, list(cells), {name: cells})):
            joined.columns.extend(fault for fault in matrix.columns if fault not in joined.columns)
            joined.rows.update(matrix.rows)
        at = found.index(shared[0]) if shared else len(found)
        found = [matrix for matrix in found if matrix not in shared]
        found.insert(at, joined)
    wide = [len(matrix.columns) > max(COLUMNS_MAX, len(matrix.rows)) for matrix in found]
    return [matrix.turned() if turn else matrix for matrix, turn in zip(found, wide, strict=True)]


# -- times ----------------------------------------------------------------------------------------


class TimePanel(msgspec.Struct, frozen=True):
    """A plot of the runs with one kind of fault; without one where all took no time."""

    fault: str
    count: int
    drawing: Markup


class TimePlots(msgspec.Struct, frozen=True):
    """One kind of time, and its plots."""

    anchor: str
    title: str
    meaning: str
    panels: tuple[TimePanel, ...]
    left_out: int  # kinds of fault


def _is_timed(result: Result) -> bool:
    return any(getattr(result, metric) is not None for metric in METRICS)


def _by_mechanism(result: Result) -> str:
    """The name of its line, where there are too many rows for a line each."""
    return result.experiment.ftm


def _time_plots(
    metric: str,
    results: Iterable[Result],
    spec: Spec,
    named: Callable[[Result], str],
    styles: dict[str, int],
) -> TimePlots:
    found: dict[str, dict[str, list[float]]] = {}
    strata: dict[str, dict[str, None]] = {}
    places = Places(spec)
    for result in results:
        value: float | None = getattr(result, metric)
        name = result.experiment.stratum
        if value is not None:
            _, fault = places.of(name)
            found.setdefault(fault, {}).setdefault(named(result), []).append(value)
            strata.setdefault(fault, {})[name] = None
    title, meaning = METRICS[metric]
    panels = []
    for fault, lines in list(found.items())[:PANELS_MAX]:
        limits = list(_limits(metric, spec, strata[fault]))
        none = not any(map(any, lines.values()))
        drawing = "" if none else plots.ecdf(f"{title}, {fault}", lines, styles, limits)
        panels.append(TimePanel(fault, sum(map(len, lines.values())), Markup(drawing)))
    return TimePlots(f"times-{metric}", title, meaning, tuple(panels), max(0, len(found) - PANELS_MAX))


def _limits(metric: str, spec: Spec, strata: Iterable[str]) -> Iterator[Limit]:
    """What the campaign allows of this time, in strata of these names."""
    names = list(strata)
    if metric == "recovery_ms" and spec.recovery_budget_ms is not None:
        yield Limit(f"budget {spec.recovery_budget_ms:g} ms", spec.recovery_budget_ms)
    if metric == "fhti_ms" and spec.ftti:
        yield Limit(f"FTTI {spec.ftti}", spec.ftti_ms)
    for gate in spec.gates:
        of, _, which = gate.metric.rpartition("_")
        if of == metric and any(fnmatch(name, gate.strata) for name in names):
            limit_ms = gate.max if gate.max is not None else gate.min or 0.0
            yield Limit(f"gate: {which} {_allowed(gate)} ms", limit_ms)


def _allowed(gate: Gate) -> str:
    return f"at most {gate.max:g}" if gate.max is not None else f"at least {gate.min:g}"


# -- the worst runs -------------------------------------------------------------------------------


class WorstRun(msgspec.Struct, frozen=True):
    """A run to look at; `note`: of the first few, what is drawn, or why nothing is."""

    result: Result
    slowness_ms: float
    diagram: SpaceTime | None = None
    note: str = ""


def _worst_runs(worst: Sequence[Result], drawn: int) -> Iterator[WorstRun]:
    for number, result in enumerate(worst):
        if number >= drawn:
            yield WorstRun(result, slowness_ms(result))
            continue
        again = rerun(result.experiment)
        if again.trace is None:
            note = f"Not drawn: it cannot be simulated: {again.why_not}"
            if result.experiment.app:
                note = "Not drawn: a report executes no function of a user. The command above shows the run."
            yield WorstRun(result, slowness_ms(result), note=note)
            continue
        same = again.outcome == result.outcome
        note = "As simulated." if same else f"As simulated, where it came out otherwise: {again.outcome}."
        yield WorstRun(result, slowness_ms(result), space_time(again.trace), note)

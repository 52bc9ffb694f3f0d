"""A campaign at the terminal: its progress while it runs, and its summary at the end.

While it runs, a terminal shows one picture that is redrawn in place: the line of `progress`, and one for each
stratum. Anything else (a pipe, the log of a CI) gets the plain lines of `progress`.
"""

import sys
import time
from collections import Counter
from collections.abc import Sequence
from itertools import chain
from types import TracebackType
from typing import TYPE_CHECKING, Final, Self

from aftbed.campaign.experiment import Result
from aftbed.campaign.statistics import Interval
from aftbed.campaign.summary import (
    NOT_ALL,
    Coverage,
    GateResult,
    Handling,
    StratumSummary,
    Summary,
    TimeSummary,
)
from aftbed.campaign.weaknesses import SeenPlace, Weakness
from aftbed.core.errors import shown
from aftbed.judge.outcome import OUTCOMES
from aftbed.report.progress import REDRAW_S, ProgressLine, pace

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.live import Live

PLACES_MAX: Final = 6  # of a weakness, listed
ROWS_MAX: Final = 30  # strata in the picture
BAR: Final = 30  # characters
UNIT: Final = "experiments"
STYLES: Final = {  # of outcomes; all others are red
    "masked": "green",
    "latent": "yellow",
    "tolerated": "green",
    "degraded": "yellow",
    "detected_stop": "yellow",
    "inconclusive": "magenta",
    "harness_error": "magenta",
}


# -- at the end -----------------------------------------------------------------------------------


def summary_lines(summary: Summary) -> list[str]:
    """Strata and gates as tables, the verdict last."""
    lines = [_head(summary), *_really(summary)]
    lines += ["", *_aligned([_STRATUM, *map(_stratum, summary.strata)])] if summary.strata else []
    handled = [_handled(one.name, one.handling) for one in summary.strata if one.handling is not None]
    lines += ["", *_aligned([_HANDLED, *handled])] if handled else []
    vacuous = [gate for gate in summary.gates if gate.value == 1.0 and gate.limit == NOT_ALL]
    left_out = vacuous[PLACES_MAX:]
    gates = [gate for gate in summary.gates if gate not in left_out]
    lines += ["", *_aligned([_GATE, *map(_gate, gates)])] if gates else []
    lines += [f"fail  {len(left_out)} more strata could not have failed"] if left_out else []
    lines += ["", *chain.from_iterable(map(_weakness, summary.weaknesses))] if summary.weaknesses else []
    return [shown(line) for line in (*lines, f"gate: {summary.gate}")]


_STRATUM: Final = ("stratum", "runs", "outcomes", "unexpected", "recovery p50, p99")
_HANDLED: Final = (
    *("handling of faults", "FDTI p50, p99", "FRTI p50, p99", "FHTI p50, p99, max", "p99 at most"),
    *("max / bound", "coverage", "reactions"),
)
_GATE: Final = ("gate", "metric", "strata", "allowed", "measured", "judged by", "because")


def _head(summary: Summary) -> str:
    of = f" of {summary.planned}" if summary.planned != summary.experiments else ""
    counts = f"{summary.experiments}{of} experiments"
    return f"campaign {summary.campaign}, seed {summary.seed}: {counts} in {summary.seconds:.1f} s"


def _really(summary: Summary) -> list[str]:
    """Which experiments of a simulated campaign ran on real processes."""
    if not summary.really:
        return []
    named = list(dict.fromkeys(summary.really))
    more = f", and {len(named) - PLACES_MAX} more strata" if len(named) > PLACES_MAX else ""
    why = "since the function ends or blocks the simulator"
    return [f"{len(summary.really)} of them on real processes, {why}: {', '.join(named[:PLACES_MAX])}{more}"]


def _stratum(stratum: StratumSummary) -> tuple[str, ...]:
    runs = f"{stratum.experiments}"
    if stratum.activated < stratum.experiments:
        runs += f", {stratum.activated} struck"
    return stratum.name, runs, _outcomes(stratum.outcomes), _unexpected(stratum), _times(stratum.recovery_ms)


def _outcomes(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items())


def _unexpected(stratum: StratumSummary) -> str:
    if not stratum.expected:
        return "-"
    return f"{stratum.unexpected} ({_share(stratum.unexpected_interval)})"


def _share(interval: Interval) -> str:
    return f"{100 * interval.low:.1f} to {100 * interval.high:.1f} %"


def _times(times: TimeSummary | None) -> str:
    return "-" if times is None else f"{times.p50:.3g}, {times.p99:.3g} ms"


def _handled(name: str, found: Handling) -> tuple[str, ...]:
    times = found.fhti_ms
    longest = "" if times is None else f", {times.max:.3g}"
    covered = found.coverage
    return (
        name,
        _times(found.fdti_ms),
        _times(found.frti_ms),
        "-" if times is None else f"{times.p50:.3g}, {times.p99:.3g}{longest} ms",
        p99_bound(times),
        "-" if found.of_bound is None else f"{found.of_bound:.2f} of {found.bound_ms:.4g} ms",
        "-" if covered is None else f"{_share(covered.interval)}{_latent(covered)}",
        _outcomes({reaction: count for reaction, count in found.reactions.items() if count}),
    )


def p99_bound(times: TimeSummary | None) -> str:
    """What the p99 does not exceed, or of how few values nothing is known."""
    if times is None:
        return "-"
    return f"not known of {times.count}" if times.p99_bound is None else f"{times.p99_bound:.3g} ms"


def _latent(found: Coverage) -> str:
    return f", {found.latent} latent" if found.latent else ""


def _gate(gate: GateResult) -> tuple[str, ...]:
    return (
        gate.word,
        gate.metric,
        gate.strata,
        gate.limit,
        _figure(gate.value),
        _figure(gate.bound),
        gate.reason,
    )


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _weakness(found: Weakness) -> list[str]:
    return [
        f"{'limit' if found.expected else 'weakness'}: {found.fault}: {found.effect}",
        f"  seen under {places(found.seen)}",
        f"  {remedy(found)}",
    ]


def remedy(found: Weakness) -> str:
    """What would have held, in words."""
    held = f"held under {places(found.held)}" if found.held else ""
    return "; ".join(filter(None, (found.advice, held))) or "nothing that was tried held it"


def places(seen: Sequence[SeenPlace]) -> str:
    """`pbr 12 of 12 (73.5 to 100.0 %), ...`."""
    words = [f"{one.place} {one.count} of {one.experiments} ({_share(one.interval)})" for one in seen]
    more = len(words) - PLACES_MAX
    return ", ".join(words[:PLACES_MAX]) + (f", and {more} more" if more > 0 else "")


def _aligned(rows: list[tuple[str, ...]]) -> list[str]:
    """Columns as wide as their widest cell."""
    widths = [max(len(row[at]) for row in rows) for at in range(len(rows[0]))]
    return ["  ".join(f"{word:<{n}}" for word, n in zip(row, widths, strict=True)).rstrip() for row in rows]


# -- while it runs --------------------------------------------------------------------------------


class CampaignProgress:
    """A context manager; `add` takes each result. There are at most `total` experiments."""

    def __init__(self, campaign: str, total: int, *, plain: bool = True) -> None:
        self._campaign, self._total = campaign, total
        self._lines = ProgressLine(f"campaign {campaign}", total, UNIT, plain=plain)
        self._began_s = self._shown_s = time.monotonic()
        self._done = self._unexpected = 0
        self._outcomes = Counter[str]()
        self._strata: dict[str, Counter[str]] = {}
        self._live: Live | None = None

    def __enter__(self) -> Self:
        if sys.stderr.isatty():
            from rich.console import Console  # noqa: PLC0415 - for a terminal only
            from rich.live import Live  # noqa: PLC0415

            console = Console(stderr=True)
            live = Live(
                get_renderable=self._picture,
                console=console,
                auto_refresh=False,
                transient=True,
                redirect_stdout=False,
                redirect_stderr=False,
            )
            try:
                live.start(refresh=True)
            except BaseException:
                live.stop()
                raise
            self._live = live
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def add(self, result: Result) -> None:
        """Count one more result, and show it if it is time."""
        self._done += 1
        self._unexpected += result.unexpected
        self._outcomes[result.outcome] += 1
        self._strata.setdefault(result.experiment.stratum, Counter())[result.outcome] += 1
        if self._live is None:
            self._lines.show(self._done, note=self._counts())
        elif (now_s := time.monotonic()) >= self._shown_s + REDRAW_S:
            self._shown_s = now_s
            self._live.refresh()

    def _counts(self) -> str:
        counts = ", ".join(f"{name} {self._outcomes[name]}" for name in OUTCOMES if self._outcomes[name])
        return counts + (f"; {self._unexpected} unexpected" if self._unexpected else "")

    def _picture(self) -> "RenderableType":
        from rich.console import Group  # noqa: PLC0415
        from rich.table import Table  # noqa: PLC0415
        from rich.text import Text  # noqa: PLC0415

        full = BAR * self._done // max(1, self._total)
        head = Text.assemble((self._campaign, "bold"), "  ", ("━" * full, "green"), "━" * (BAR - full), "  ")
        head.append(pace(self._done, self._total, time.monotonic() - self._began_s, UNIT))
        head.append(f"  {self._unexpected} unexpected" if self._unexpected else "", "bold red")
        table = Table(box=None, pad_edge=False, show_header=False)
        for name, counts in list(self._strata.items())[:ROWS_MAX]:
            words = [(f"{o} {counts[o]}  ", STYLES.get(o, "red")) for o in OUTCOMES if counts[o]]
            table.add_row(Text(name), str(counts.total()), Text.assemble(*words))
        more = len(self._strata) - ROWS_MAX
        return Group(head, table, Text(f"and {more} more strata" if more > 0 else ""))

"""The summary of a campaign as Markdown: what goes into a merge request, or a safety case."""

from collections.abc import Iterable, Sequence

from aftbed.campaign.summary import Summary
from aftbed.core.errors import shown
from aftbed.report.terminal import places, remedy


def markdown_summary(summary: Summary, app: str) -> str:
    """The gate, and the weaknesses of `app` and of its mechanisms."""
    gates = [
        (
            gate.word,
            gate.metric,
            gate.strata,
            gate.limit,
            _figure(gate.value),
            _figure(gate.bound),
            gate.reason,
        )
        for gate in summary.gates
    ]
    weak = [
        ("limit" if one.expected else "**weakness**", one.fault, one.effect, places(one.seen), remedy(one))
        for one in summary.weaknesses
    ]
    lines = [
        f"# {summary.campaign}: {summary.gate}",
        "",
        f"`{_cell(app)}`: {summary.experiments} of {summary.planned} experiments, seed {summary.seed},"
        f" code {summary.code}.",
        "",
        "## Weaknesses",
        "",
        *(_table(("", "fault", "what came of it", "seen under", "what would have held"), weak) or ["None."]),
        "",
        "## Gates",
        "",
        *_table(("gate", "metric", "strata", "allowed", "measured", "judged by", "because"), gates),
    ]
    return "\n".join(shown(line) for line in lines) + "\n"


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> list[str]:
    if not rows:
        return []
    return [_row(head), "|" + "---|" * len(head), *map(_row, rows)]


def _row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(map(_cell, cells))} |"


def _cell(text: str) -> str:
    """No text of a stranger ends a cell, a line or a code, or begins an element."""
    for mark, other in (("|", "\\|"), ("\n", " "), ("<", "&lt;")):
        text = text.replace(mark, other)
    return text


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"

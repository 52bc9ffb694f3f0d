"""Tables in the pages that the code computes: bounds, resilience; `--rewrite` makes them anew."""

from collections.abc import Callable
from pathlib import Path
from typing import Final

import pytest
from pages import ROOT

from aftbed.adapt.resilience import Addition, resilience
from aftbed.ftm.compose import EXPRESSIONS, NONE
from aftbed.ftm.registry import MECHANISMS
from aftbed.inject.model import parse
from aftbed.judge.handling_bound import bound_ms

DOCS: Final = ROOT / "docs"
FAULTS: Final = {
    "crash of the leader": "crash primary",
    "hang of the leader": "hang primary",
    "hang of 20 ms": "hang primary for 20ms",
    "crash of the backup": "crash backup",
    "crash of Recovery": "crash recovery",
    "wrong value": "bitflip result",
    "skipped step": "omission prd2srv",
    "doubled step": "duplicate prd2srv",
}
SETS: Final = (("pbr",), ("pbr", "lfr"), ("pbr", "lfr", "tr"), tuple(MECHANISMS))

Rows = list[tuple[str, ...]]


def bounds() -> Rows:
    rows = [("mechanism", *FAULTS)]
    for ftm in EXPRESSIONS:
        if ftm != NONE:
            found = [bound_ms(ftm, "process", parse(words), simulated=True) for words in FAULTS.values()]
            rows.append((ftm, *("-" if ms is None else f"{ms:.2f}" for ms in found)))
    return rows


def resiliences() -> Rows:
    rows = [("set", "states", "changes", "stays", "adapts", "nothing", "answered", "of the breaking")]
    rows[0] += ("best of the shipped ones in addition", "best with an assumption less")
    for mechanisms in SETS:
        found = resilience(mechanisms)
        total = found.total
        shipped = [one for one in found.additions if one.addition is Addition.AS_SHIPPED]
        less = [one for one in found.additions if one.addition is not Addition.AS_SHIPPED]
        counts = (found.states, total.changes, total.stays, total.adapts, total.nothing)
        rows.append(
            (
                ", ".join(mechanisms),
                *map(str, counts),
                f"{total.answered:.1%}",
                f"{total.of_breaking:.1%}",
                *(f"{one[0].words}: {one[0].answered:.1%}" if one else "-" for one in (shipped, less)),
            )
        )
    return rows


def written(rows: Rows) -> str:
    rows = [rows[0], ("---",) * len(rows[0]), *rows[1:]]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


@pytest.mark.parametrize(
    ("name", "page", "rows"),
    [("bounds", DOCS / "intervals.md", bounds), ("resilience", DOCS / "ftar.md", resiliences)],
)
def test_the_page_has_what_the_code_computes(
    name: str, page: Path, rows: Callable[[], Rows], rewrite: bool
) -> None:
    begin, end = f"<!-- {name}: written by a test -->\n", f"<!-- end of {name} -->\n"
    head, _, rest = page.read_text().partition(begin)
    shown, _, tail = rest.partition(end)
    if rewrite:
        shown = written(rows())
        page.write_text(head + begin + shown + end + tail)
    assert shown == written(rows()), "pytest tests/docs/test_bounds.py --rewrite"

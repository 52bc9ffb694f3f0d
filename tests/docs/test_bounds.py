"""The table of the bounds in docs/intervals.md is what the code computes; `--rewrite` makes it anew."""

from typing import Final

from pages import ROOT

from aftbed.ftm.compose import EXPRESSIONS, NONE
from aftbed.inject.model import parse
from aftbed.judge.handling_bound import bound_ms

PAGE: Final = ROOT / "docs" / "intervals.md"
BEGIN, END = "<!-- bounds: written by a test -->\n", "<!-- end of bounds -->\n"
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


def table() -> str:
    rows = [("mechanism", *FAULTS), ("---",) * (1 + len(FAULTS))]
    for ftm in EXPRESSIONS:
        if ftm != NONE:
            found = [bound_ms(ftm, "process", parse(words), simulated=True) for words in FAULTS.values()]
            rows.append((ftm, *("-" if ms is None else f"{ms:.2f}" for ms in found)))
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def test_the_page_has_the_bounds_of_the_code(rewrite: bool) -> None:
    head, _, rest = PAGE.read_text().partition(BEGIN)
    shown, _, tail = rest.partition(END)
    if rewrite:
        PAGE.write_text(head + BEGIN + table() + END + tail)
        shown = table()
    assert shown == table(), "pytest tests/docs/test_bounds.py --rewrite"

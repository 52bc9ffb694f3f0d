"""What `aftbed sim --against` does: the experiments of real records, simulated, and both put side by side."""

from pathlib import Path

import msgspec
from rich.console import Console
from rich.table import Table

from aftbed.judge.verdict import EXIT_CODES
from aftbed.search.agreement import Agreement, Times, against


def run(records: tuple[Path, ...], seeds: int, *, as_json: bool) -> int:
    """Compare and show; the exit code: 1 where they do not agree."""
    found = against(records, seeds)
    if as_json:
        print(msgspec.json.encode({"agree": not _apart(found), "experiments": found}).decode())
    else:
        _tell(found)
    return EXIT_CODES["fail" if _apart(found) else "pass"]


def _apart(found: list[Agreement]) -> int:
    return sum(bool(one.why_not) for one in found)


def _tell(found: list[Agreement]) -> None:
    table = Table("", "classes", "recovery: low, median, high (ms)", box=None, pad_edge=False)
    for one in found:
        table.add_row(one.experiment, "", "")
        table.add_row("  real", _classes(one.real), _times(one.real_recovery))
        table.add_row("  simulated", _classes(one.simulated), _times(one.simulated_recovery))
        for reason in one.why_not:
            table.add_row(f"  [red]not alike[/red]: {reason}", "", "")
    Console().print(table)
    print(f"{len(found) - _apart(found)} of {len(found)} experiments agree")


def _classes(found: dict[str, int]) -> str:
    return ", ".join(f"{word} {count}" for word, count in found.items())


def _times(found: Times | None) -> str:
    if found is None:
        return "-"
    return f"{found.low_ms:.2f}  {found.median_ms:.2f}  {found.high_ms:.2f}  (of {found.count})"

"""What `aftbed campaign compare` does."""

from pathlib import Path

import msgspec

from aftbed.campaign import ledger
from aftbed.campaign.compare import Change, compare


def run(base: Path, new: Path, *, as_json: bool) -> int:
    """Show what differs; 1 if a stratum has become worse."""
    found = compare(ledger.read(base / ledger.NAME), ledger.read(new / ledger.NAME))
    if as_json:
        print(msgspec.json.encode(found).decode())
    else:
        print(f"base {found.base}, new {found.new}; {found.unpaired} experiments without their pair")
        width = max(len(change.stratum) for change in found.changes)
        print("\n".join(_line(change, width) for change in found.changes))
    return 1 if found.worse else 0


def _line(change: Change, width: int) -> str:
    shift = "p99 recovery: too few to tell"
    if change.shift_ms is not None:
        shift = f"p99 recovery {change.shift_ms.low:+.3f} to {change.shift_ms.high:+.3f} ms"
    differ = f"{change.only_base} failed only before, {change.only_new} only now (p {change.p:.3g})"
    word = "worse" if change.worse else "same or better"
    return f"  {change.stratum:<{width}}  {change.pairs:>5} pairs: {differ}; {shift}: {word}"

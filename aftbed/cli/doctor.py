"""`aftbed doctor`: what of the machine is missing, and what dead runs left behind."""

import json

import msgspec

from aftbed.core.errors import HarnessError
from aftbed.runtime.unix import leftovers
from aftbed.runtime.unix.inspection import Check, inspect
from aftbed.runtime.unix.leftovers import Left


class Diagnosis(msgspec.Struct, frozen=True):
    """What --json prints. `left` is what is there when the command ends; `ok` is its exit code."""

    checks: list[Check]
    left: list[Left]
    removed: list[Left]
    ok: bool


def doctor(*, clean: bool, as_json: bool) -> int:
    """Look, clean if asked to, print; 0 if nothing is missing and nothing left, else 1."""
    checks = inspect()
    removed: list[Left] = []
    left: list[Left] = []
    try:
        left = leftovers.find()
        if clean:
            removed, left = leftovers.clean(left)
    except HarnessError:  # no place for runs, which is among the checks
        assert any(c.status == "missing" for c in checks)
    ok = not left and all(c.status != "missing" for c in checks)
    diagnosis = Diagnosis(checks, left, removed, ok)
    if as_json:
        print(json.dumps(msgspec.to_builtins(diagnosis)))
    else:
        _show(diagnosis, clean=clean)
    return 0 if ok else 1


def _show(diagnosis: Diagnosis, *, clean: bool) -> None:
    for check in diagnosis.checks:
        print(f"{check.status:8} {check.name:20} {check.found} ({check.serves})")
        if check.remedy:
            print(f"{'':8} {'':20} to do: {check.remedy}")
    for left in diagnosis.removed:
        print(f"removed  {left}")
    for left in diagnosis.left:
        print(f"left     {left}")
    counts = [sum(c.status == status for c in diagnosis.checks) for status in ("missing", "warning")]
    rest = f"{len(diagnosis.left)} left by dead runs"
    if clean:
        rest = f"{len(diagnosis.removed)} removed, {rest}"
    elif diagnosis.left:
        rest += ": aftbed doctor --clean"
    print(f"{counts[0]} missing, {counts[1]} warnings, {rest}")

"""`aftbed doctor`: what the machine lacks, and what dead runs left behind."""

from typing import Annotated

import msgspec
import typer

from aftbed.cli.options import Json, print_json
from aftbed.core.errors import ConfigError
from aftbed.runtime.unix import cleanup
from aftbed.runtime.unix.cleanup import Left
from aftbed.runtime.unix.doctor import HostCheck, inspect


class Diagnosis(msgspec.Struct, frozen=True):
    """The document of --json. `left` is what remains when the command ends; `ok` decides the exit code."""

    checks: list[HostCheck]
    left: list[Left]
    removed: list[Left]
    ok: bool


def doctor(
    clean: Annotated[bool, typer.Option("--clean", help="Remove what dead runs left behind.")] = False,
    json: Json = False,
) -> None:
    """What this machine lacks, and what dead runs left behind.

    Exit code: 0 nothing is missing and nothing left, 1 something is.
    """
    checks, removed, left = inspect(), list[Left](), list[Left]()
    try:
        left = cleanup.find()
        if clean:
            removed, left = cleanup.clean(left)
    except ConfigError:  # runs have no directory here: one of the checks reports it
        assert any(c.status == "missing" for c in checks)
    ok = not left and all(c.status != "missing" for c in checks)
    diagnosis = Diagnosis(checks, left, removed, ok)
    if json:
        print_json(diagnosis)
    else:
        _show(diagnosis, clean=clean)
    raise typer.Exit(0 if ok else 1)


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

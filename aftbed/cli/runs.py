"""`aftbed list`: the runs that live, and the records of runs."""

from pathlib import Path
from typing import Annotated, Final

import msgspec
import typer

from aftbed.cli.options import Json, print_json
from aftbed.core.errors import shown
from aftbed.judge.listed import FOLDERS_MAX, ListedRun, ListedState, age_s, listed

HEADS: Final = ("RUN", "VERDICT", "MECHANISM", "SCENARIO", "AGE", "RECORD")


def list_(
    folders: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[DIR]...", help="Where records lie; the working directory if left out."),
    ] = None,
    json: Json = False,
) -> None:
    """The runs that live, and the records of runs: mechanism, scenario, age, verdict.

    A record is found up to three directories below DIR. Exit code: 0, 2 usage.
    """
    found = listed(folders or [Path()])
    if json:
        runs = [msgspec.structs.asdict(one) | {"age_s": age_s(one)} for one in found.runs]
        print_json({"runs": runs, "whole": found.whole})
        return
    rows = [HEADS, *map(_row, found.runs)] if found.runs else []
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  ".join(f"{word:<{width}}" for word, width in zip(row, widths, strict=True)).rstrip())
    live = sum(one.state is ListedState.LIVE for one in found.runs)
    print(f"{live} alive, {len(found.runs) - live} recorded")
    if not found.whole:
        print(f"not all was looked into: more than {FOLDERS_MAX} directories; name one that is smaller")


def _row(one: ListedRun) -> tuple[str, ...]:
    words = (one.run, _verdict(one), one.ftm, one.scenario, _age(one), _where(one))
    return tuple(map(shown, words))


def _verdict(one: ListedRun) -> str:
    match one.state:
        case ListedState.ENDED:
            return one.verdict or "not judged"
        case ListedState.UNFINISHED | ListedState.LIVE | ListedState.DAMAGED as state:
            return str(state.value)


def _age(one: ListedRun) -> str:
    seconds = age_s(one)
    if seconds is None:
        return "-"
    for unit, length in (("d", 86_400), ("h", 3_600), ("min", 60)):
        if seconds >= length:
            return f"{seconds / length:.0f} {unit}"
    return f"{seconds:.0f} s"


def _where(one: ListedRun) -> str:
    where = one.record or ""
    return f"{where}: {one.damage}" if one.damage else where

"""`aftbed app`: the protected function of a user.

`check` measures what it declares; `header` is for one that is a C library.
"""

import sys
from pathlib import Path
from typing import Annotated, Final

import typer

from aftbed import functions
from aftbed.adapt.suitability import mismatches
from aftbed.cli.init import new
from aftbed.cli.options import Json, Seed, check_range, check_seed, note_unusable, print_blocks, print_json
from aftbed.cli.parsing import PlainGroup
from aftbed.core.application import NONE, Characteristics
from aftbed.core.errors import shown
from aftbed.ftm.compose import expressions
from aftbed.functions.load import OWN_CODE
from aftbed.functions.request_file import located_requests, requests_from
from aftbed.functions.source import is_foreign, located, parse_source
from aftbed.judge.exercise import Answer, Surroundings, Task
from aftbed.judge.measured import (
    MeasuredFunction,
    ProcessHost,
    StateChange,
    UnmeasuredError,
    measure,
)
from aftbed.report.progress import ProgressLine
from aftbed.vehicle.aeb.function import sample_requests

function = typer.Typer(cls=PlainGroup)
function.command()(new)
EXIT_OVERSTATED: Final = 1
COUNT: Final = 200
COUNT_MAX: Final = 100_000
TASKS: Final = 4  # of a function with a state; each has a process of its own
HEADER: Final = Path(functions.__file__).with_name("aft.h")
OF_THE_BRAKE: Final = "the requests are those of the brake function; --requests gives others"


@function.command()
def check(
    source: Annotated[str, typer.Argument(help="A class, .so, .fmu, or a program.")],
    requests: Annotated[
        str | None,
        typer.Option(help="File, MODULE:FUNCTION or FILE.py:FUNCTION; those of the brake if left out."),
    ] = None,
    count: Annotated[int | None, typer.Option(help="How many; 200, or all of a file, if left out.")] = None,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Measure what a function declares: determinism, state access; and which mechanisms suit it then.

    Exit code: 0 it is what it declares, 1 it is not, 2 usage, 3 it cannot be measured.
    """
    check_seed(seed)
    place = located(source)
    payloads = _requests(place, requests, count, seed)
    try:
        with ProgressLine("app check", TASKS, "processes", plain=not json) as progress:
            found = measure(place, payloads, seed, _Counted(ProcessHost(place), progress))
    except UnmeasuredError as error:
        raise UnmeasuredError(f"{error} ({OF_THE_BRAKE})" if requests is None else str(error)) from None
    note_unusable()
    reasons = {name: "; ".join(mismatches(name, found.characteristics)) for name in expressions()}
    if json:
        print_json(_document(source, found, reasons))
        for one in found.differences:
            print(f"aftbed: note: {shown(one)}", file=sys.stderr)
    else:
        _show(source, found, reasons)
    if found.wrong:
        raise typer.Exit(EXIT_OVERSTATED)


@function.command()
def header(json: Json = False) -> None:
    """Print the path of aft.h, which a C library includes."""
    if json:
        print_json({"header": str(HEADER)})
    else:
        print(HEADER)


class _Counted:
    """A host of tasks that counts them."""

    def __init__(self, host: ProcessHost, progress: ProgressLine) -> None:
        self._host, self._progress, self._done = host, progress, 0

    def __call__(self, task: Task, surroundings: Surroundings, seconds: float) -> Answer:
        found = self._host(task, surroundings, seconds)
        self._done += 1
        self._progress.show(self._done)
        return found


def _requests(app: str, source: str | None, count: int | None, seed: int) -> list[bytes]:
    """Those of the brake are in the layout in which a car asks the function `app`. Raises ConfigError."""
    if count is not None:
        check_range("--count", count, 1, COUNT_MAX)
    if source is None:
        return sample_requests(seed, count or COUNT, fixed=is_foreign(app))
    found = requests_from(located_requests(source), count or COUNT, seed, OWN_CODE).requests
    if count is not None:
        check_range("--count", count, 1, len(found))
    return list(found[:count])


def _document(source: str, found: MeasuredFunction, reasons: dict[str, str]) -> dict[str, object]:
    declared = found.declared
    return {
        "app": source,
        "kind": parse_source(source).kind.value,
        "declared": {"deterministic": declared.deterministic, "state_access": str(declared.state_access)},
        "measured": {
            "deterministic": found.deterministic,
            "state_access": found.access_name,
            "difference_max": found.largest,
            "serialisable": found.serialisable,
        },
        "state_bytes": found.state_bytes,
        "changed_bytes": _spread(found.changed_bytes),
        "changed_pages": _spread(found.changed_pages),
        "execute_us": {"p50": found.execute_us[0], "p99": found.execute_us[1]},
        "suits": [{"ftm": name, "why_not": why_not} for name, why_not in reasons.items()],
    }


def _spread(found: StateChange) -> dict[str, int]:
    return {"p50": found.p50, "max": found.most}


def _show(source: str, found: MeasuredFunction, reasons: dict[str, str]) -> None:
    p50_us, p99_us = found.execute_us
    changed, pages = found.changed_bytes, found.changed_pages
    state = (
        f"{found.state_bytes} bytes; changed by a request: {changed.p50} bytes (p50), {changed.most} (max);"
        f" pages of 4 KiB: {pages.p50} (p50), {pages.most} (max)"
    )
    elsewhere = ", also in another process" if found.serialisable else ""
    unsuited: dict[str, list[str]] = {}  # by reason
    for name, why_not in reasons.items():
        if why_not:
            unsuited.setdefault(why_not, []).append(name)
    print_blocks(
        function=[f"{source} ({parse_source(source).kind.value}), {found.requests} requests"],
        declared=[_words(found.declared)],
        measured=[f"{_determinism(found.deterministic)}, {found.access_words}{elsewhere}"],
        false=list(found.wrong),
        because=[shown(one) for one in found.differences],
        remark=[shown(one) for one in (*found.remarks, *found.understated)],
        state=[state] if found.state_bytes else [],
        time=[f"{p50_us:.1f} us a request (p50), {p99_us:.1f} us (p99)"],
        suits=[", ".join(name for name, why_not in reasons.items() if not why_not)],
        unsuited=[f"{', '.join(names)}: {why_not}" for why_not, names in unsuited.items()],
    )
    print(f"{source} is {'not ' if found.wrong else ''}what it declares")


def _words(declared: Characteristics) -> str:
    access = declared.state_access
    return (
        f"{_determinism(declared.deterministic)},"
        f" {'no state access' if access == NONE else f'{access} state access'}"
    )


def _determinism(deterministic: bool) -> str:
    return "deterministic" if deterministic else "not deterministic"

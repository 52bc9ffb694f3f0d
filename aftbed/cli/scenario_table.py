"""`aftbed scenario table`: the drives of a published table, on the simulator, perhaps with a fault."""

import sys
import time
from collections.abc import Sequence
from contextlib import closing
from itertools import groupby
from pathlib import Path
from typing import Annotated, Final

import msgspec
import rich.table
import typer
from rich.console import Console

from aftbed.cli.interrupted import interrupted
from aftbed.cli.options import (
    Json,
    Seed,
    check_file,
    check_seed,
    jobs_of,
    print_json,
    separated,
    takes,
)
from aftbed.cli.sim import read_fault
from aftbed.core.errors import ConfigError
from aftbed.core.units import milliseconds, whole_milliseconds
from aftbed.ftm.compose import build
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Trigger
from aftbed.inject.model import Fault, parse
from aftbed.judge.verdict import EXIT_CODES
from aftbed.report.plots import RoadCurve, RoadPoint, road_plot
from aftbed.report.progress import ProgressLine
from aftbed.search.road_table import NONE, PRIMARY, DrivenRow, RoadLine, driven, drives, outage
from aftbed.search.worst_instant import STEP_CYCLES
from aftbed.vehicle.scenarios import tables
from aftbed.vehicle.scenarios.library import load_scenario

WORST: Final = "worst-instant"
PLOT_SUFFIX: Final = ".svg"
WIDTH: Final = 150  # characters, if standard output is no terminal
CYCLE_S: Final = 0.02
HEADS: Final = ("row", "km/h", "allowed", "impact", "gap", "warned")
FAULT_HEADS: Final = ("struck at", "worst of", "lost")
OUTAGE_HEADS: Final = ("at most",)


class TableArguments(msgspec.Struct, frozen=True):
    """The options of `aftbed scenario table`."""

    name: Annotated[str, typer.Argument(help="r152, ncap or negative.")]
    group: Annotated[str | None, typer.Option(help="One group of its rows; all if left out.")] = None
    ftm: Annotated[
        tuple[str, ...], typer.Option(help="Mechanisms, separated by commas; none if left out.")
    ] = ()
    fault: Annotated[
        str | None,
        typer.Option(
            help='worst-instant (a crash of the primary), "FAULT WORDS at worst-instant",'
            ' or "FAULT WORDS at EVENT nth N".'
        ),
    ] = None
    outage: Annotated[
        tuple[str, ...],
        typer.Option(
            help="How long the function does not answer (300ms), at the worst instant, with no FTM."
            " May be given several times."
        ),
    ] = ()
    seed: Seed = 0
    jobs: Annotated[int | None, typer.Option(help="Processes that simulate; one per CPU if left out.")] = None
    plot: Annotated[Path | None, typer.Option(help="Draw the speeds at impact to this SVG file.")] = None
    json: Json = False


class TableDrive(msgspec.Struct, frozen=True):
    """What is to be driven: each case under each line."""

    cases: tuple[tables.Case, ...]
    lines: tuple[RoadLine, ...]
    seed: int
    jobs: int


def table_drive(given: TableArguments) -> TableDrive:
    """Check the options. Raises ConfigError naming the argument, before anything is driven."""
    rows = tables.cases(given.name, given.group)
    check_seed(given.seed)
    check_file("--plot", given.plot, PLOT_SUFFIX)
    named = tuple(dict.fromkeys(separated(given.ftm)))
    if not named and (given.fault is not None or not given.outage):
        named = (NONE,)
    mechanisms = (_mechanism_line(ftm, given.fault) for ftm in named)
    outages = (_outage_line(text, rows) for text in dict.fromkeys(given.outage))
    return TableDrive(rows, (*mechanisms, *outages), given.seed, jobs_of(given.jobs))


def _mechanism_line(ftm: str, text: str | None) -> RoadLine:
    """Under `ftm`, with the fault of `--fault`: at its own time, or at the worst instant."""
    graph = build(ftm, "process")
    if text is None:
        return RoadLine(ftm, ftm)
    match text.split():
        case [word] if word == WORST:
            fault = Fault(Crash(), PRIMARY, Trigger())
        case [*words, "at", last] if last == WORST:
            fault = parse(" ".join(words))
            if not fault.action.has_worst_instant or fault.trigger != Trigger():
                raise ConfigError(
                    f"--fault {text!r}: a crash, a hang or a slow without any other time is searched"
                )
            fault.check(graph)
        case [*_, last] if last == WORST:
            raise ConfigError(f"--fault {text!r}: {WORST}, or FAULT WORDS at {WORST} is allowed")
        case _:
            return RoadLine(f"{ftm}, {text}", ftm, read_fault(text, graph))
    return RoadLine(f"{ftm}, {fault} at the worst instant", ftm, fault, searched=True)


def _outage_line(text: str, rows: tuple[tables.Case, ...]) -> RoadLine:
    """Raises ConfigError if the outage is longer than one of the drives."""
    if milliseconds("--outage", text) < 1.0:
        raise ConfigError(f"--outage {text}: 1ms is the shortest that is allowed")
    length_ms = whole_milliseconds("--outage", text)
    for case in rows:
        lasts_ms = load_scenario(case.name).duration_ms
        if length_ms >= lasts_ms:
            raise ConfigError(
                f"--outage {text}: {case.name} lasts {lasts_ms / 1000:g} s; a shorter one is allowed"
            )
    return outage(length_ms)


# -- the drives --------------------------------------------------------------------------------------


@takes(TableArguments)
def table(given: TableArguments) -> int:
    """Drive a whole table on the simulator, without a fault or with one at its worst.

    Exit code: 0 all rows pass, 1 a row fails, 2 usage, 3 a fault never struck, 130 interrupted.
    """
    found = table_drive(given)
    began_s = time.monotonic()
    done: dict[tuple[str, str], DrivenRow] = {}
    try:
        _drive(found, done, plain=not given.json)
    except KeyboardInterrupt:
        of = len(found.lines) * len(found.cases)
        return interrupted(f"{len(done)} of {of} rows were driven; nothing is kept")
    rows = [done[line.name, case.name] for line in found.lines for case in found.cases]
    seconds = round(time.monotonic() - began_s, 2)
    if given.plot is not None:
        _plot(given.plot, given.name, found, rows)
    passed, struck = sum(row.passed for row in rows), sum(row.struck for row in rows)
    if given.json:
        about = {"table": given.name, "group": given.group, "seed": given.seed, "seconds": seconds}
        print_json({**about, "pass": passed == len(rows), "rows": rows})
    else:
        where = f", {given.group}" if given.group else ""
        print(f"{given.name}{where}: {tables.title(given.name)}; seed {given.seed}")
        _show_lines(found.lines, rows)
        tail = f"; the fault never struck in {len(rows) - struck}" if struck < len(rows) else ""
        print(f"\n{passed} of {len(rows)} rows pass{tail} in {seconds:.1f} s")
    if any(row.struck and not row.passed for row in rows):
        return EXIT_CODES["fail"]
    return EXIT_CODES["pass" if struck == len(rows) else "inconclusive"]


def _drive(found: TableDrive, rows: dict[tuple[str, str], DrivenRow], *, plain: bool) -> None:
    """Fill in `rows`, by line and case."""
    todo = drives(found.cases, found.lines, found.seed)
    with (
        closing(driven(todo, found.jobs)) as coming,
        ProgressLine("scenario table", len(todo), "drives", plain=plain) as progress,
    ):
        for done, these in enumerate(coming, 1):
            rows.update({(row.line, row.case): row for row in these})
            failed = sum(not row.passed for row in rows.values())
            progress.show(done, note=f"{failed} rows fail" if failed else "")


def _plot(path: Path, table: str, found: TableDrive, rows: Sequence[DrivenRow]) -> None:
    """A picture for each group."""
    groups = {case.name: case.group for case in found.cases}
    curves = []
    for (line, group), of in groupby(rows, key=lambda row: (row.line, groups[row.case])):
        points = (
            RoadPoint(row.speed_kmh, row.impact_kmh, row.limit_kmh, row.closed_form_kmh)
            for row in sorted(of, key=lambda row: row.speed_kmh)
        )
        curves.append(RoadCurve(group, line, tuple(points)))
    try:
        path.write_text(road_plot(f"{table}: speed left at impact", curves), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"--plot {path}: {error.strerror}") from None


# -- what is printed ---------------------------------------------------------------------------------


def _show_lines(lines: Sequence[RoadLine], rows: Sequence[DrivenRow]) -> None:
    """For each line a table, why rows fail, how instants were searched, and what repeats the worst row."""
    by_line = {name: list(of) for name, of in groupby(rows, key=lambda row: row.line)}
    for line in lines:
        found = by_line[line.name]
        print(f"\n{line.name}" + (f" (under {line.ftm})" if line.outage_ms is not None else ""))
        _print_rows(line, found)
        for text in _failures(line, found):
            print(f"  {text}")
        if line.searched:
            runs = sum(row.instants or 0 for row in found)
            step = f"every {STEP_CYCLES * CYCLE_S:g} s and at each change of stage, then down to 1 ms"
            print(f"  worst of {runs} instants: {step}")
        struck = [row for row in found if row.struck]
        if line.fault is not None and struck:
            worst = max(struck, key=lambda row: (not row.passed, row.loss_kmh or 0.0, row.loss_m or 0.0))
            for at, command in enumerate(worst.repeat):
                print(f"  {'      ' if at else 'repeat'}  {command}")


def _print_rows(line: RoadLine, rows: Sequence[DrivenRow]) -> None:
    heads = (*HEADS, *(FAULT_HEADS if line.fault else ()), *(OUTAGE_HEADS if line.outage_ms else ()), "")
    grid = rich.table.Table(box=None, pad_edge=False, padding=(0, 3, 0, 0), header_style="")
    for at, head in enumerate(heads):
        grid.add_column(head, no_wrap=True, justify="left" if at in (0, len(heads) - 1) else "right")
    for row in rows:
        grid.add_row(*_cells(line, row), style="" if row.passed else "red")
    console = Console(width=None if sys.stdout.isatty() else WIDTH, highlight=False)
    with console.capture() as captured:
        console.print(grid)
    print("\n".join(line.rstrip() for line in captured.get().splitlines()))


def _cells(line: RoadLine, row: DrivenRow) -> list[str]:
    def figure(value: float | None, form: str, unit: str) -> str:
        return "-" if value is None else f"{value:{form}}{unit}"

    cells = [
        row.case,
        f"{row.speed_kmh:g}",
        f"{row.limit_kmh:g}" if row.limit_kmh else "none",
        figure(row.impact_kmh or None, ".1f", " km/h"),
        figure(row.min_gap_m, ".2f", " m"),
        figure(row.warning_s, ".2f", " s"),
    ]
    if line.fault is not None:
        lost = figure(row.loss_kmh, ".1f", " km/h") if row.loss_kmh else figure(row.loss_m, ".3f", " m")
        cells += [figure(row.at_s, ".3f", " s"), figure(row.instants, "", ""), lost]
    if line.outage_ms is not None:
        cells.append(figure(row.closed_form_kmh, ".1f", " km/h"))
    verdict = "pass" if row.passed else "fail" if row.struck else "no fault"
    return [*cells, verdict + (f", {row.colour}" if row.colour else "")]


def _failures(line: RoadLine, rows: Sequence[DrivenRow]) -> list[str]:
    """Each row that fails, with why; of an outage, also that it must."""
    failed = [row for row in rows if not row.passed]
    found = [f"{row.case}: {'; '.join(row.because)}" for row in failed]
    must = [f"{row.case}: {row.must_fail}" for row in failed if row.must_fail]
    if must:
        found += [f"{len(must)} of these must fail, since nothing stands in for the function:", *must]
    if line.outage_ms is not None and not failed:
        found.append(f"no row fails: {line.outage_ms} ms are less than what the function keeps in hand")
    return found

"""`aftbed scenario ftti`: how long a fault may last at its worst instant, beside what mechanisms take."""

import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Annotated, Final

import msgspec
import rich.table
import typer
from rich.console import Console

from aftbed.cli.interrupted import interrupted
from aftbed.cli.options import Json, Seed, check_file, check_seed, jobs_of, print_json, separated, takes
from aftbed.core.errors import ConfigError, unknown
from aftbed.judge.verdict import EXIT_CODES
from aftbed.report.plots import FttiCurve, TimeBand, ftti_plot
from aftbed.report.progress import ProgressLine
from aftbed.search.ftti import (
    FTTI_MAX_MS,
    Fhti,
    FttiRow,
    FttiSearch,
    FunctionFault,
    expanded,
    margins,
    read_fhti,
    searched,
)
from aftbed.vehicle.ecus import BRAKE_POLICIES

DEFAULT: Final = ("ccrs-20", "ccrs-42", "ccrs-50")
PLOT_SUFFIX: Final = ".svg"
WIDTH: Final = 150  # characters, if standard output is no terminal
HEADS: Final = ("scenario", "km/h", "fault", "FTTI", "closed form", "from")


class FttiArguments(msgspec.Struct, frozen=True):
    """The options of `aftbed scenario ftti`."""

    names: Annotated[
        tuple[str, ...],
        typer.Argument(help=f"Scenarios, rows (r152:m1-60) or groups (ncap:ccrs); {', '.join(DEFAULT)}."),
    ] = ()
    fault: Annotated[
        tuple[str, ...],
        typer.Option(help=f"{', '.join(FunctionFault)}; several are separated by commas. omission."),
    ] = ()
    brake_policy: Annotated[
        str, typer.Option(metavar="<latch|release|hold>", help="What the brakes do without a request.")
    ] = "latch"
    fhti: Annotated[
        Path | None,
        typer.Option(
            help='Directory of a campaign, or FHTI in ms: {"pbr": {"p50": 1.9, "p99": 3.6, "bound": 12.5}}.'
        ),
    ] = None
    seed: Seed = 0
    jobs: Annotated[int | None, typer.Option(help="Processes that simulate; one per CPU if left out.")] = None
    plot: Annotated[Path | None, typer.Option(help="Draw FTTI over speed to this SVG file.")] = None
    json: Json = False


@takes(FttiArguments)
def ftti(given: FttiArguments) -> int:
    """Measure how long a fault of the function may last before the row is broken, at the worst instant.

    Exit code: 0 measured, 1 a mechanism of --fhti does not handle a fault in time, 2 usage, 130 interrupted.
    """
    todo, figures = _searches(given), _fhti(given.fhti)
    rows: list[FttiRow] = []
    try:
        with (
            closing(searched(todo, jobs_of(given.jobs))) as coming,
            ProgressLine("scenario ftti", len(todo), "searches", plain=not given.json) as progress,
        ):
            for row in coming:
                rows.append(margins(row, figures))
                progress.show(len(rows))
    except KeyboardInterrupt:
        return interrupted(f"{len(rows)} of {len(todo)} searches were done; nothing is kept")
    if given.plot is not None:
        _plot(given.plot, given.brake_policy, rows, figures)
    if given.json:
        print_json({"rows": rows})
    else:
        _print(rows, figures)
    late = any(of.margin is not None and of.margin <= 0.0 for row in rows for of in row.mechanisms.values())
    return EXIT_CODES["fail" if late else "pass"]


def _searches(given: FttiArguments) -> list[FttiSearch]:
    """Check the options. Raises ConfigError before anything is driven."""
    check_seed(given.seed)
    jobs_of(given.jobs)
    check_file("--plot", given.plot, PLOT_SUFFIX)
    faults = separated(given.fault) or (FunctionFault.OMISSION,)
    known = [fault.value for fault in FunctionFault]
    for name in faults:
        if name not in known:
            raise unknown("fault", name, known)
    policy = next((policy for policy in BRAKE_POLICIES if policy == given.brake_policy), None)
    if policy is None:
        raise unknown("brake policy", given.brake_policy, BRAKE_POLICIES)
    names = dict.fromkeys(name for text in given.names or DEFAULT for name in expanded(text))
    return [
        FttiSearch(name, FunctionFault(fault), policy, given.seed)
        for fault in dict.fromkeys(faults)
        for name in names
    ]


def _fhti(path: Path | None) -> dict[str, Fhti]:
    """By mechanism: what a campaign has measured, or what a file says. Raises ConfigError."""
    if path is None:
        return {}
    if not path.is_dir():
        return read_fhti(path)
    from aftbed.campaign import ledger  # noqa: PLC0415
    from aftbed.campaign.summary import fhti_figures  # noqa: PLC0415 - scipy

    found = fhti_figures(ledger.read(path / ledger.NAME).results)
    if not found:
        raise ConfigError(f"--fhti {path}: no fault was handled in this campaign; another one is needed")
    return {name: Fhti(round(of.p50, 3), round(of.p99, 3), of.bound) for name, of in found.items()}


def _plot(path: Path, policy: str, rows: Sequence[FttiRow], figures: dict[str, Fhti]) -> None:
    curves = []
    for fault in dict.fromkeys(row.fault for row in rows if row.ftti_ms is not None):
        of = sorted((row for row in rows if row.fault == fault), key=lambda row: row.speed_kmh)
        points = [(row.speed_kmh, row.ftti_ms) for row in of if row.ftti_ms is not None]
        closed = [(row.speed_kmh, row.closed_form_ms) for row in of if row.closed_form_ms is not None]
        curves.append(FttiCurve(fault, points, closed))
    if not curves:
        raise ConfigError(
            f"--plot {path}: no FTTI up to {FTTI_MAX_MS // 1000} s, so there is nothing to draw"
        )
    bands = [TimeBand(name, of.p50, of.p99 if of.bound is None else of.bound) for name, of in figures.items()]
    try:
        path.write_text(ftti_plot(f"FTTI over speed, brakes: {policy}", curves, bands), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"--plot {path}: {error.strerror}") from None


def _print(rows: Sequence[FttiRow], figures: dict[str, Fhti]) -> None:
    heads = (*HEADS, *(("least margin",) if figures else ()), "broken by")
    grid = rich.table.Table(box=None, pad_edge=False, padding=(0, 3, 0, 0), header_style="")
    for at, head in enumerate(heads):
        grid.add_column(head, no_wrap=True, justify="left" if at in (0, 2, len(heads) - 1) else "right")
    for row in rows:
        grid.add_row(*_cells(row))
    console = Console(width=None if sys.stdout.isatty() else WIDTH, highlight=False)
    with console.capture() as captured:
        console.print(grid)
    print("\n".join(line.rstrip() for line in captured.get().splitlines()))


def _cells(row: FttiRow) -> list[str]:
    def figure(value: float | None, form: str, unit: str) -> str:
        return "-" if value is None else f"{value:{form}}{unit}"

    known = [(of.margin, name) for name, of in row.mechanisms.items() if of.margin is not None]
    least = [f"{min(known)[0]:.1%} {min(known)[1]}" if known else "-"] if row.mechanisms else []
    return [
        row.scenario,
        f"{row.speed_kmh:g}",
        row.fault,
        figure(row.ftti_ms, ".0f", " ms"),
        figure(row.closed_form_ms, ".0f", " ms"),
        figure(row.worst_instant_s, ".2f", " s"),
        *least,
        row.broken_by or f"no FTTI up to {FTTI_MAX_MS // 1000} s",
    ]

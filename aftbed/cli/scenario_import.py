"""`aftbed scenario import`: scenario files from OpenSCENARIO files, with a report of what was ignored."""

from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from aftbed.cli.interrupted import told_if_interrupted
from aftbed.cli.options import Json, print_json
from aftbed.core.errors import ConfigError, shown
from aftbed.core.units import milliseconds
from aftbed.interop.openscenario.document import CAUSES, Cause
from aftbed.interop.openscenario.folder import FileReport, import_folder
from aftbed.interop.openscenario.importer import ImportedFile, ImportOptions, import_scenario, write
from aftbed.report.progress import ProgressLine

NOTHING_IMPORTED = 2


def import_(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE.xosc|DIR", help="A scenario, a distribution, or a folder of such files."
        ),
    ],
    variations: Annotated[
        Path | None, typer.Option(metavar="DIST.xosc", help="A ParameterValueDistribution for FILE.")
    ] = None,
    pick: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="Only the variations with this value; may be repeated."),
    ] = None,
    ego: Annotated[
        str | None, typer.Option(help="The vehicle of the function; default: the one called Ego.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Directory of the scenario files. Of a DIR nothing is written without it."),
    ] = None,
    expect: Annotated[
        str,
        typer.Option(metavar="<stop|no_collision|no_braking>", help="The outcome that each drive must have."),
    ] = "no_collision",
    duration: Annotated[
        str | None, typer.Option(help="Length of a drive, as 40s; default: its StopTrigger, or 30s.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of a stochastic distribution that has no randomSeed.")] = 0,
    force: Annotated[bool, typer.Option("--force", help="Overwrite files that differ.")] = False,
    json: Json = False,
) -> None:
    """Make scenario files of OpenSCENARIO 1.0 to 1.3 files; all of a file or nothing.

    Exit code: 0 imported, 2 refused; for a DIR 2 if no file of it can be imported.
    """
    seconds = milliseconds("--duration", duration) / 1000 if duration is not None else None
    options = ImportOptions(ego, expect, seconds, tuple(_picked(one) for one in pick or ()), seed)
    if file.is_dir():
        if variations is not None or pick:
            option = "--pick" if pick else "--variations"
            raise ConfigError(f"{option}: is for one file; {file} is a folder")
        _import_folder(file, options, out, force=force, json=json)
        return
    imported = import_scenario(file, variations, options)
    paths = write(imported, out or Path(), force=force)
    if json:
        _print_document(imported, paths)
    else:
        _print_report(imported, paths)


def _picked(words: str) -> tuple[str, str]:
    name, equals, value = words.partition("=")
    if not name or not equals:
        raise ConfigError(f"--pick: found {words!r}, allowed is NAME=VALUE")
    return name.removeprefix("$"), value


# -- one file


def _print_document(imported: ImportedFile, paths: list[Path]) -> None:
    print_json(
        {
            "file": imported.path,
            "scenario_file": imported.scenario,
            "version": imported.version,
            "description": imported.description,
            "sets": imported.sets,
            "scenarios": [
                {"name": one.name, "path": str(path), "parameters": one.parameters}
                for one, path in zip(imported.variations, paths, strict=True)
            ],
            "left_out": imported.left_out,
            "taken": imported.taken,
            "ignored": imported.ignored,
        }
    )


def _print_report(imported: ImportedFile, paths: list[Path]) -> None:
    description = " ".join(imported.description.split())
    print(shown(f"{imported.path}: OpenSCENARIO {imported.version}: {description}"))
    if imported.scenario != imported.path:
        print(shown(f"varies {imported.scenario}"))
    print("taken")
    for taken in imported.taken:
        print(_row(imported, taken.path, taken.line, taken.element, taken.meaning))
    print("ignored")
    for ignored in imported.ignored:
        print(_row(imported, ignored.path, ignored.line, ignored.element, ignored.reason))
    if imported.left_out:
        print(f"left out: {len(imported.left_out)} of {imported.sets} sets of values")
        for (line, reason), count in Counter((one.line, one.reason) for one in imported.left_out).items():
            print(shown(f"  {count:>4} times  line {line}: {reason}"))
    if imported.sets > len(paths) + len(imported.left_out):
        print(f"{imported.sets} sets of values, {len(paths)} of them different")
    print("\n  ".join(("written", *map(str, paths))))


def _row(imported: ImportedFile, path: str, line: int, element: str, words: str) -> str:
    elsewhere = f" ({path})" if path != imported.scenario else ""
    return shown(f"  line {line:<5} {element:26} {words}{elsewhere}")


# -- a folder


def _import_folder(
    folder: Path, options: ImportOptions, out: Path | None, *, force: bool, json: bool
) -> None:
    reports: list[FileReport] = []
    kept = "nothing is kept" if out is None else f"their scenarios are in {out}"
    with (
        told_if_interrupted(lambda: f"{len(reports)} files were done; {kept}"),
        ProgressLine("scenario import", unit="files", plain=not json) as progress,
    ):
        for report in import_folder(folder, options, out, force=force, show=progress.show):
            reports.append(report)
            if not json:
                progress.print(shown(_line(report)))
    accepted = sum(report.accepted for report in reports)
    causes = Counter(report.cause for report in reports if report.cause is not None)
    if json:
        print_json(
            {
                "files": reports,
                "accepted": accepted,
                "refused": len(reports) - accepted,
                "causes": {cause.value: causes[cause] for cause in Cause if causes[cause]},
            }
        )
    else:
        scenarios = sum(len(report.scenarios) for report in reports)
        print(f"{len(reports)} files: {accepted} accepted, {scenarios} scenarios; {causes.total()} refused")
        for cause in (one for one in Cause if causes[one]):
            print(f"  {causes[cause]:>4}  {CAUSES[cause]}")
        if out is None and scenarios:
            print("nothing is written: --out DIR says where to")
    if not accepted:
        raise typer.Exit(NOTHING_IMPORTED)


def _line(report: FileReport) -> str:
    if report.accepted:
        count = len(report.scenarios)
        words = "1 scenario" if count == 1 else f"{count} scenarios"
        left = f", {len(report.left_out)} sets of values left out" if report.left_out else ""
        return f"accepted  {report.file}: {words}{left}"
    place = f"{report.file}: line {report.line}" if report.line else report.file
    return f"refused   {place}: {report.reason}"

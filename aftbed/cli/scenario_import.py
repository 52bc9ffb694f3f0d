"""`aftbed scenario import`: scenario files from an OpenSCENARIO file, with a report of what was ignored."""

from pathlib import Path
from typing import Annotated

import typer

from aftbed.cli.options import Json, print_json
from aftbed.core.errors import shown
from aftbed.interop.openscenario.importer import ImportOptions, import_scenario, write


def import_(
    file: Annotated[Path, typer.Argument(metavar="FILE.xosc", help="One car behind another, straight on.")],
    variations: Annotated[
        Path | None, typer.Option(metavar="DIST.xosc", help="A ParameterValueDistribution for FILE.")
    ] = None,
    ego: Annotated[
        str | None, typer.Option(help="The vehicle of the function; default: the one called Ego.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Directory of the scenario files.")] = Path(),
    expect: Annotated[
        str, typer.Option(help="The expected outcome of each drive: stop, no_collision or no_braking.")
    ] = "no_collision",
    duration: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", help="Length of a drive; default: its StopTrigger, or 30."),
    ] = None,
    replace_controller: Annotated[
        bool,
        typer.Option(
            "--replace-controller", help="Leave out the controller of the ego: the function controls it."
        ),
    ] = False,
    seed: Annotated[int, typer.Option(help="Seed of a stochastic distribution that has no randomSeed.")] = 0,
    force: Annotated[bool, typer.Option("--force", help="Overwrite files that differ.")] = False,
    json: Json = False,
) -> None:
    """Make scenario files of an OpenSCENARIO 1.0 to 1.3 file; all or nothing."""
    options = ImportOptions(ego, expect, duration, replace_controller, seed)
    imported = import_scenario(file, variations, options)
    paths = write(imported, out, force=force)
    if json:
        document = {
            "file": imported.path,
            "version": imported.version,
            "description": imported.description,
            "sets": imported.sets,
            "scenarios": [
                {"name": one.name, "path": str(path), "parameters": one.parameters}
                for one, path in zip(imported.variations, paths, strict=True)
            ],
            "taken": imported.taken,
            "ignored": imported.ignored,
        }
        print_json(document)
        return
    description = " ".join(imported.description.split())
    print(shown(f"{imported.path}: OpenSCENARIO {imported.version}: {description}"))
    print("taken")
    for taken in imported.taken:
        print(shown(f"  line {taken.line:<5} {taken.element:26} {taken.meaning}"))
    print("ignored")
    for ignored in imported.ignored:
        elsewhere = f" ({ignored.path})" if ignored.path != imported.path else ""
        print(shown(f"  line {ignored.line:<5} {ignored.element:26} {ignored.reason}{elsewhere}"))
    if imported.sets > len(paths):
        print(f"{imported.sets} sets of values, {len(paths)} of them different")
    print("\n  ".join(("written", *map(str, paths))))

"""`aftbed scenario import`: an OpenSCENARIO file becomes scenario files, and nothing gets lost unseen."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from aftbed.vehicle.openscenario import Imported


def import_(
    file: Annotated[Path, typer.Argument(metavar="FILE.xosc", help="One car behind another, straight on.")],
    variations: Annotated[
        Path | None, typer.Option(metavar="DIST.xosc", help="A ParameterValueDistribution for FILE.")
    ] = None,
    ego: Annotated[
        str | None, typer.Option(help="The vehicle that is ours; default: the one called Ego.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Where the scenario files go.")] = Path(),
    expect: Annotated[
        str, typer.Option(help="What each drive has to come to: stop, no_collision or no_braking.")
    ] = "no_collision",
    duration: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", help="How long a drive is; default: its StopTrigger, or 30."),
    ] = None,
    replace_controller: Annotated[
        bool, typer.Option("--replace-controller", help="Leave out what controls the ego: the function does.")
    ] = False,
    seed: Annotated[int, typer.Option(help="Of a stochastic distribution that has no randomSeed.")] = 0,
    force: Annotated[bool, typer.Option("--force", help="Write over files that say something else.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")] = False,
) -> None:
    """Make scenario files of an OpenSCENARIO 1.0 to 1.3 file; all or nothing."""
    from aftbed.vehicle.openscenario import Wanted, import_scenario, write  # noqa: PLC0415

    wanted = Wanted(ego, expect, duration, replace_controller, seed)
    imported = import_scenario(file, variations, wanted)
    paths = write(imported, out, force=force)
    if json:
        _print_json(imported, paths)
    else:
        _print_text(imported, paths)


def _print_json(imported: "Imported", paths: list[Path]) -> None:
    import msgspec  # noqa: PLC0415

    document = {
        "file": imported.path,
        "version": imported.version,
        "description": imported.description,
        "sets": imported.sets,
        "scenarios": [
            {"name": one.name, "path": str(path), "parameters": one.parameters}
            for one, path in zip(imported.variations, paths, strict=True)
        ],
        "taken": msgspec.to_builtins(imported.taken),
        "ignored": msgspec.to_builtins(imported.ignored),
    }
    print(msgspec.json.encode(document).decode())


def _print_text(imported: "Imported", paths: list[Path]) -> None:
    print(f"{imported.path}: OpenSCENARIO {imported.version}: {' '.join(imported.description.split())}")
    print("taken")
    for taken in imported.taken:
        print(f"  line {taken.line:<5} {taken.element:26} {taken.meaning}")
    print("ignored")
    for ignored in imported.ignored:
        elsewhere = f" ({ignored.path})" if ignored.path != imported.path else ""
        print(f"  line {ignored.line:<5} {ignored.element:26} {ignored.reason}{elsewhere}")
    if imported.sets > len(paths):
        print(f"{imported.sets} sets of values, {len(paths)} of them different")
    print("written")
    for path in paths:
        print(f"  {path}")

"""`aftbed sim`: runs in virtual time, each made of its seed and nothing else."""

from pathlib import Path
from typing import Annotated

import typer


def sim(
    seed: Annotated[int | None, typer.Option(help="Of all chance in one run; 0 if left out.")] = None,
    seeds: Annotated[str | None, typer.Option(help="A..B: a run for each, both ends included.")] = None,
    ftm: Annotated[str | None, typer.Option(help="none, pbr, lfr, tr, pbr+tr, ...; pbr if left out.")] = None,
    placement: Annotated[str | None, typer.Option(help="process (default), replica or single.")] = None,
    count: Annotated[int | None, typer.Option(help="Requests of a run; 100 if left out.")] = None,
    rate: Annotated[
        float | None, typer.Option(help="Requests per second; else each follows the reply before.")
    ] = None,
    scenario: Annotated[
        str | None, typer.Option(help="A car makes the requests: a scenario, or a YAML file.")
    ] = None,
    faults: Annotated[
        list[str] | None, typer.Option("--faults", help='E.g. "crash primary at server.exit nth 3".')
    ] = None,
    adaptations: Annotated[
        list[str] | None, typer.Option("--adapt", help='E.g. "to lfr+tr at request 20".')
    ] = None,
    recipe: Annotated[str | None, typer.Option(help="Of every --adapt: drained (default) or paper.")] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Have --adapt begin even where it would be refused.")
    ] = False,
    swarm: Annotated[bool, typer.Option("--swarm", help="Draw everything from the seed.")] = False,
    minutes: Annotated[
        float | None, typer.Option(help="Go on with the seeds from --seed on, for so long.")
    ] = None,
    jobs: Annotated[int | None, typer.Option(help="Processes, for many runs; else one per CPU.")] = None,
    diagram: Annotated[
        str | None, typer.Option(help="Write the last messages to this file, as a Mermaid diagram.")
    ] = None,
    against: Annotated[
        list[Path] | None,
        typer.Option(help="The record of a real run: simulate the same, under --seeds, and compare."),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")] = False,
) -> None:
    """Simulate: the bricks, scripts and faults of real runs, in virtual time; one seed repeats it all.

    Exit code: 0 pass, 1 a promise was broken, 2 usage, 3 a fault did not fire, 130 interrupted.
    """
    from aftbed.cli.simasked import Asked  # noqa: PLC0415
    from aftbed.cli.simulating import run  # noqa: PLC0415

    asked = Asked(
        seed=seed,
        seeds=seeds,
        ftm=ftm,
        placement=placement,
        count=count,
        rate=rate,
        scenario=scenario,
        faults=tuple(faults or ()),
        adaptations=tuple(adaptations or ()),
        recipe=recipe,
        force=force,
        swarm=swarm,
        minutes=minutes,
        jobs=jobs,
        diagram=diagram,
        against=tuple(against or ()),
    )
    raise typer.Exit(run(asked, as_json=json))

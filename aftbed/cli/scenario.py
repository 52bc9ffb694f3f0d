"""`aftbed scenario`: the drives that there are, and the published tables that they are rows of."""

from pathlib import Path
from typing import Annotated

import typer

from aftbed.cli.scenarioimport import import_

scenario = typer.Typer(
    help="Drives and published tables: what must stop, and what still does under faults.",
    no_args_is_help=True,
    rich_markup_mode=None,
)

Name = Annotated[str, typer.Argument(help="A scenario, a row of a table (r152:m1-60), or a YAML file.")]
Ftm = Annotated[str, typer.Option(help="none, pbr, lfr, tr, pbr+tr, ...: aftbed ftm list.")]
Seed = Annotated[int, typer.Option(help="Of all chance.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")]


@scenario.command("list")
def list_(json: Json = False) -> None:
    """The scenarios that are shipped, and the tables with their groups."""
    from aftbed.cli import scenarioview  # noqa: PLC0415

    scenarioview.show_list(as_json=json)


@scenario.command()
def show(name: Name, json: Json = False) -> None:
    """How a drive begins, and what it must come to."""
    from aftbed.cli import scenarioview  # noqa: PLC0415

    scenarioview.show_scenario(name, as_json=json)


@scenario.command()
def run(
    name: Name,
    ftm: Ftm = "pbr",
    placement: Annotated[str, typer.Option(help="process (one per brick) or replica.")] = "process",
    pace: Annotated[str, typer.Option(help="real, a factor (4), or max (lockstep).")] = "real",
    seed: Seed = 0,
    faults: Annotated[
        list[str] | None, typer.Option("--inject", help='E.g. "crash primary at server.enter nth 100".')
    ] = None,
    json: Json = False,
) -> None:
    """Drive it on real processes: `aftbed run --scenario NAME`, which has more options.

    Exit code: 0 pass, 1 a promise was broken, 2 usage, 3 inconclusive, 130 interrupted and cleaned.
    """
    from aftbed.cli.app import run as run_  # noqa: PLC0415 - this is a part of it

    run_(ftm=ftm, scenario=name, placement=placement, pace=pace, seed=seed, faults=faults, json=json)


@scenario.command()
def table(
    name: Annotated[str, typer.Argument(help="r152, ncap or negative.")],
    group: Annotated[str | None, typer.Option(help="One group of its rows; all if left out.")] = None,
    ftm: Annotated[
        list[str] | None, typer.Option(help="Mechanisms, separated by commas; none if left out.")
    ] = None,
    fault: Annotated[
        str | None,
        typer.Option(
            help='worst-instant (a crash of the primary), "FAULT WORDS at worst-instant",'
            ' or "FAULT WORDS at EVENT nth N".'
        ),
    ] = None,
    outage: Annotated[
        list[str] | None,
        typer.Option(
            help="The function does not answer for so long (300ms), at the worst"
            " instant, and nothing stands in for it. May be given several times."
        ),
    ] = None,
    seed: Seed = 0,
    jobs: Annotated[
        int | None, typer.Option(help="Processes that simulate; one per CPU if left out.")
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="Draw the speeds at impact to this SVG file.")] = None,
    json: Json = False,
) -> None:
    """Drive a whole table on the simulator, without a fault or with one at its worst.

    Exit code: 0 all rows pass, 1 a row fails, 2 usage, 3 a fault never struck, 130 interrupted.
    """
    from aftbed.cli import scenariotable  # noqa: PLC0415
    from aftbed.cli.scenarioasked import Asked  # noqa: PLC0415

    asked = Asked(
        table=name,
        group=group,
        ftms=tuple(one for text in ftm or () for one in text.split(",")),
        fault=fault,
        outages=tuple(outage or ()),
        seed=seed,
        jobs=jobs,
        plot=plot,
    )
    raise typer.Exit(scenariotable.run(asked, as_json=json))


scenario.command("import")(import_)

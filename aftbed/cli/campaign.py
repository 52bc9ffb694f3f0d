"""`aftbed campaign`: many experiments from one file, judged with statistics, ended by a gate."""

from pathlib import Path
from typing import Annotated

import typer

campaign = typer.Typer(
    help="Many experiments from one file, judged with statistics, ended by a gate.",
    no_args_is_help=True,
    rich_markup_mode=None,
)

Name = Annotated[
    str, typer.Argument(help="Name of a shipped campaign (aftbed campaign list), or a YAML file.")
]
Folder = Annotated[Path, typer.Argument(help="The directory of a campaign (its --out).")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")]
Seed = Annotated[int | None, typer.Option(help="In the place of the file's.")]
Experiments = Annotated[
    int | None, typer.Option("--experiments", help="In each stratum, in the place of the file's.")
]
Runtime = Annotated[str | None, typer.Option(help="unix or sim, in the place of the file's.")]


@campaign.command("list")
def list_() -> None:
    """The campaigns that come with aftbed."""
    from aftbed.cli import campaigning  # noqa: PLC0415

    campaigning.show_shipped()


@campaign.command()
def schema() -> None:
    """The JSON schema of a campaign file, for editors."""
    from aftbed.cli import campaigning  # noqa: PLC0415

    campaigning.show_schema()


@campaign.command()
def plan(
    name: Name,
    seed: Seed = None,
    experiments: Experiments = None,
    runtime: Runtime = None,
    out: Annotated[
        Path | None, typer.Option(help="Write every experiment to this file, a line each.")
    ] = None,
    json: Json = False,
) -> None:
    """What would be run: the strata, how many experiments, about how long. Nothing is run."""
    from aftbed.cli import campaigning  # noqa: PLC0415

    campaigning.show_plan(campaigning.Changes(name, seed, experiments, runtime), out, as_json=json)


@campaign.command()
def run(
    name: Name,
    out: Annotated[
        Path | None, typer.Option(help="Directory of the records and reports; campaign-NAME if left out.")
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(help="Experiments side by side; one per CPU if left out.")
    ] = None,
    shard: Annotated[str, typer.Option(help="I/N: only the Ith of N parts.")] = "1/1",
    resume: Annotated[bool, typer.Option("--resume", help="Go on with what is there.")] = False,
    seed: Seed = None,
    experiments: Experiments = None,
    runtime: Runtime = None,
    executor: Annotated[str, typer.Option(help="local processes, or dask (needs --scheduler).")] = "local",
    scheduler: Annotated[str | None, typer.Option(help="Address of a Dask scheduler.")] = None,
    json: Json = False,
) -> None:
    """Run it, and judge it.

    Exit code: 0 all gates pass, 1 one does not, 2 usage, 3 trouble of the harness, 130 interrupted.
    """
    from aftbed.cli import campaigning  # noqa: PLC0415

    changes = campaigning.Changes(name, seed, experiments, runtime)
    how = campaigning.How(out, jobs, shard, resume, executor, scheduler)
    raise typer.Exit(campaigning.run(changes, how, as_json=json))


@campaign.command()
def report(folder: Folder, json: Json = False) -> None:
    """Judge the records of a campaign again, and write its reports anew."""
    from aftbed.cli import campaigning  # noqa: PLC0415

    raise typer.Exit(campaigning.report(folder, as_json=json))


@campaign.command()
def export(
    folder: Folder,
    out: Annotated[Path, typer.Option(help="A file: .csv, or .parquet (pip install 'aftbed[parquet]').")],
) -> None:
    """The results as a table, one row each."""
    from aftbed.cli import campaigning  # noqa: PLC0415

    campaigning.export(folder, out)


@campaign.command()
def merge(
    folders: Annotated[list[Path], typer.Argument(help="The directories of all shards.")],
    out: Annotated[Path, typer.Option(help="A new directory.")],
    json: Json = False,
) -> None:
    """One campaign out of its shards."""
    from aftbed.cli import campaigning  # noqa: PLC0415

    raise typer.Exit(campaigning.merge(folders, out, as_json=json))


@campaign.command()
def compare(base: Folder, new: Folder, json: Json = False) -> None:
    """What differs between two campaigns of the same plan, experiment by experiment.

    Exit code: 0 no stratum has become worse, 1 one has, 2 usage.
    """
    from aftbed.cli.campaignpairs import run as compared  # noqa: PLC0415

    raise typer.Exit(compared(base, new, as_json=json))


@campaign.command()
def assumptions(folder: Folder) -> None:
    """What each mechanism assumes, and what came of it where that does not hold, as Markdown."""
    from aftbed.campaign import ledger  # noqa: PLC0415
    from aftbed.campaign.assumptions import markdown  # noqa: PLC0415

    print(markdown(ledger.read(folder / ledger.NAME)), end="")


Experiment = Annotated[str, typer.Argument(help="Id of the experiment, its beginning, or its number.")]


@campaign.command()
def replay(folder: Folder, experiment: Experiment, json: Json = False) -> None:
    """Run one experiment of a campaign again."""
    from aftbed.cli import campaigning  # noqa: PLC0415

    raise typer.Exit(campaigning.replay(folder, experiment, as_json=json))


@campaign.command()
def shrink(folder: Folder, experiment: Experiment, json: Json = False) -> None:
    """The smallest experiment with the same outcome, in the simulator."""
    from aftbed.cli import campaigning  # noqa: PLC0415

    raise typer.Exit(campaigning.shrink(folder, experiment, as_json=json))

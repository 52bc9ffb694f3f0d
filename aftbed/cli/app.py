"""All commands. What a command needs is imported when it runs: `aftbed --help` answers at once."""

from pathlib import Path
from typing import Annotated

import typer

from aftbed.cli.adapting import adapt as adapt_commands
from aftbed.cli.bench import bench
from aftbed.cli.campaign import campaign
from aftbed.cli.explore import explore
from aftbed.cli.ftm import ftm as ftm_commands
from aftbed.cli.inject import inject
from aftbed.cli.log import log
from aftbed.cli.scenario import scenario as scenario_commands
from aftbed.cli.sim import sim

app = typer.Typer(
    name="aftbed",
    help="A testbed for Adaptive Fault Tolerance: a car that goes on braking when its server dies.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.add_typer(inject, name="inject")
app.add_typer(adapt_commands, name="adapt")
app.add_typer(bench, name="bench")
app.add_typer(ftm_commands, name="ftm")
app.add_typer(explore, name="explore")
app.add_typer(campaign, name="campaign")
app.add_typer(log, name="log")
app.add_typer(scenario_commands, name="scenario")

Run = Annotated[str | None, typer.Option("--run", help="Id of the run, where several are alive.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")]


def _version(asked: bool) -> None:
    if asked:
        from aftbed.campaign.plan import code_version  # noqa: PLC0415 - for this alone

        typer.echo(f"aftbed {code_version()}")
        raise typer.Exit


Version = Annotated[
    bool,
    typer.Option("--version", callback=_version, is_eager=True, help="Print it, with a digest of the code."),
]


@app.callback()
def aftbed(*, version: Version = False) -> None:
    """What comes before a command."""


@app.command()
def run(
    ftm: Annotated[str, typer.Option(help="none, pbr, lfr, tr, pbr+tr, ...: aftbed ftm list.")] = "pbr",
    scenario: Annotated[str, typer.Option(help="Name of a scenario, or a YAML file.")] = "ccrs-50",
    placement: Annotated[str, typer.Option(help="process (one per brick) or replica.")] = "process",
    pace: Annotated[str, typer.Option(help="real, a factor (4), or max (lockstep).")] = "real",
    seed: Annotated[int, typer.Option(help="Of all chance in the run.")] = 0,
    faults: Annotated[
        list[str] | None, typer.Option("--inject", help='E.g. "crash primary at checkpoint.sent nth 100".')
    ] = None,
    adaptations: Annotated[
        list[str] | None, typer.Option("--adapt", help='E.g. "compose lfr+tr at request 120".')
    ] = None,
    recipe: Annotated[str, typer.Option(help="Of every --adapt: drained or paper.")] = "drained",
    force: Annotated[
        bool, typer.Option("--force", help="Carry out --adapt even where it does not suit the function.")
    ] = False,
    policy: Annotated[
        str | None, typer.Option(help="When to adapt by itself: name of a policy, or a YAML file.")
    ] = None,
    approve: Annotated[str, typer.Option(help="What --policy proposes: auto (do it) or ask.")] = "auto",
    brake_policy: Annotated[
        str, typer.Option(help="Of the brake ECU on lost requests: hold, release or latch.")
    ] = "latch",
    record: Annotated[
        str | None, typer.Option(help="Keep the record of the run in this new directory.")
    ] = None,
    replay: Annotated[str | None, typer.Option(help="A candump log to replay instead of a drive.")] = None,
    dbc: Annotated[str | None, typer.Option(help="The DBC of the replayed log.")] = None,
    map_file: Annotated[str | None, typer.Option("--map", help="What the log's signals mean.")] = None,
    load: Annotated[
        str | None, typer.Option(help="COUNT[@RATE]: synthetic requests (per second) instead of a drive.")
    ] = None,
    bus_port: Annotated[int, typer.Option(help="TCP port of the bus on 127.0.0.1; 0 is any free one.")] = 0,
    pin: Annotated[bool, typer.Option(help="Keep each replica's chain on one core.")] = True,
    unsafe_memory: Annotated[
        bool, typer.Option("--unsafe-memory", help='Allow --inject "bitflip memory ...".')
    ] = False,
    mcap: Annotated[Path | None, typer.Option(help="Write the run to this file, for Foxglove.")] = None,
    trace: Annotated[Path | None, typer.Option(help="Write its nodes to this file, for Perfetto.")] = None,
    json: Json = False,
) -> None:
    """Drive a car at an obstacle, under a fault tolerance mechanism; end with a verdict.

    Exit code: 0 pass, 1 a promise was broken, 2 usage, 3 inconclusive, 130 interrupted and cleaned.
    """
    from aftbed.cli import running  # noqa: PLC0415

    asked = running.Asked(
        ftm=ftm,
        scenario=scenario,
        placement=placement,
        pace=pace,
        seed=seed,
        faults=tuple(faults or ()),
        adaptations=tuple(adaptations or ()),
        recipe=recipe,
        force=force,
        policy=policy,
        approve=approve,
        brake_policy=brake_policy,
        record=record,
        replay=replay,
        dbc=dbc,
        map_file=map_file,
        load=load,
        bus_port=bus_port,
        pin=pin,
        unsafe_memory=unsafe_memory,
        mcap=mcap,
        trace=trace,
    )
    raise typer.Exit(running.run(asked, as_json=json))


@app.command()
def check(
    record: Annotated[Path, typer.Argument(help="The directory of --record.")],
    json: Json = False,
) -> None:
    """Judge a recorded run again."""
    from aftbed.cli.show import show_verdict  # noqa: PLC0415
    from aftbed.judge.record import read_record  # noqa: PLC0415
    from aftbed.judge.verdict import EXIT_CODES, judge  # noqa: PLC0415

    verdict = judge(read_record(record))
    show_verdict(verdict, as_json=json)
    raise typer.Exit(EXIT_CODES[verdict.verdict])


@app.command()
def status(run: Run = None, json: Json = False) -> None:
    """How a live run is."""
    from aftbed.cli import live  # noqa: PLC0415

    live.status(run, as_json=json)


@app.command()
def ps(run: Run = None, json: Json = False) -> None:
    """The processes of a live run: name, role, pid, CPU, memory (PSS)."""
    from aftbed.cli import live  # noqa: PLC0415

    live.ps(run, as_json=json)


@app.command()
def graph(
    ftm: Annotated[str | None, typer.Option(help="Show this FTM's graph; without it, a live run's.")] = None,
    placement: Annotated[str, typer.Option(help="With --ftm: process or replica.")] = "process",
    style: Annotated[str, typer.Option("--format", help="text, dot or mermaid.")] = "text",
    run: Run = None,
) -> None:
    """The bricks, their channels and their nodes."""
    from aftbed.cli import live  # noqa: PLC0415

    live.graph(run, ftm, placement, style)


@app.command()
def stop(run: Run = None) -> None:
    """End a live run; its command prints the verdict so far."""
    from aftbed.cli import live  # noqa: PLC0415

    live.stop(run)


@app.command()
def doctor(
    clean: Annotated[bool, typer.Option("--clean", help="Remove what dead runs left behind.")] = False,
    json: Json = False,
) -> None:
    """What of this machine is missing or in the way, and what dead runs left behind.

    Exit code: 0 nothing is missing and nothing left, 1 something is.
    """
    from aftbed.cli import doctor as doctoring  # noqa: PLC0415

    raise typer.Exit(doctoring.doctor(clean=clean, as_json=json))


app.command()(sim)

"""The table of all commands. A command's module is imported when the command or its help is called."""

from typing import Annotated, Final

import typer

from aftbed.cli.lazy import CommandTable, group_of

COMMANDS: Final[CommandTable] = {
    "run": ("run:run", "Drive a car at an obstacle, under a fault tolerance mechanism; end with a verdict."),
    "check": ("check:check", "Judge a recorded run again."),
    "list": ("runs:list_", "The runs that live, and the records of runs: mechanism, scenario, age, verdict."),
    "status": ("live:status", "Show the state of a live run."),
    "ps": ("live:ps", "The processes of a live run: name, role, pid, CPU, memory (PSS)."),
    "graph": ("live:graph", "The bricks, their channels and their nodes."),
    "web": ("web:web", "The page of a live run in a browser, to watch and to steer it."),
    "stop": ("live:stop", "End a live run; its command prints the verdict so far."),
    "doctor": ("doctor:doctor", "What this machine lacks, and what dead runs left behind."),
    "sim": ("sim:sim", "Simulate runs in virtual time; the same seed gives the same run."),
    "inject": ("inject:inject", "Inject a fault into a live run."),
    "adapt": ("adapt:adapt", "Change the mechanism of a live run: update, switch, compose."),
    "bench": ("bench:bench", "Measure, with the bare limit measured beside each figure."),
    "ftm": ("ftm:ftm", "What each mechanism tolerates and needs, and which one suits."),
    "init": ("init:init", "Write a file or a project to begin with: scenario, campaign, mechanism, ..."),
    "schema": ("schema:schema", "The JSON Schema of a kind of YAML file, for editors."),
    "app": ("function:function", "The protected function of a user: what it declares, measured."),
    "explore": ("explore:explore", "Simulate every experiment of one kind, with an exact count."),
    "campaign": (
        "campaign:campaign",
        "Many experiments from one file, judged with statistics, ended by a gate.",
    ),
    "log": ("log:log", "Convert a log of the bus or the record of a run for other tools."),
    "map": ("maps:maps", "Maps of other radars: check one, propose one for a DBC and a log."),
    "scenario": (
        "scenario:scenario",
        "Drives and published tables: what must stop, and what still does under faults.",
    ),
    "completion": ("completion:completion", "Have bash, zsh or fish complete words: the script for it."),
    "man": ("manual:man", "The manual page: commands, options, exit codes, files."),
}


app = typer.Typer(
    name="aftbed",
    cls=group_of(COMMANDS),
    help="A testbed for Adaptive Fault Tolerance: a car that goes on braking when its server dies.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _version(wanted: bool) -> None:
    if wanted:
        from aftbed.runtime.unix.code_version import code_version  # noqa: PLC0415 - only for --version

        typer.echo(f"aftbed {code_version()}")
        raise typer.Exit


@app.callback()
def aftbed(
    *,
    version: Annotated[
        bool,
        typer.Option(
            "--version",
            callback=_version,
            is_eager=True,
            help="Print the version, with a digest of the code.",
        ),
    ] = False,
) -> None:
    """Options that come before a command."""

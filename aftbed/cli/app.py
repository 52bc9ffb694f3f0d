"""The table of all commands. A command's module is imported when the command or its help is called."""

import importlib
from typing import Annotated, Any, Final

import typer
from typer.core import TyperCommand, TyperGroup

# The module of each command, and the help that `aftbed --help` shows. The module has an attribute with the
# name of the command: a function, or a typer.Typer that holds the subcommands.
COMMANDS: Final = {
    "run": ("run", "Drive a car at an obstacle, under a fault tolerance mechanism; end with a verdict."),
    "check": ("check", "Judge a recorded run again."),
    "status": ("live", "Show the state of a live run."),
    "ps": ("live", "The processes of a live run: name, role, pid, CPU, memory (PSS)."),
    "graph": ("live", "The bricks, their channels and their nodes."),
    "stop": ("live", "End a live run; its command prints the verdict so far."),
    "doctor": ("doctor", "What this machine lacks, and what dead runs left behind."),
    "sim": ("sim", "Simulate runs in virtual time; the same seed gives the same run."),
    "inject": ("inject", "Inject a fault into a live run."),
    "adapt": ("adapt", "Change the mechanism of a live run: update, switch, compose."),
    "bench": ("bench", "Measure, with the bare limit measured beside each figure."),
    "ftm": ("ftm", "What each mechanism tolerates and needs, and which one suits."),
    "explore": ("explore", "Simulate every experiment of one kind, with an exact count."),
    "campaign": ("campaign", "Many experiments from one file, judged with statistics, ended by a gate."),
    "log": ("log", "Convert a log of the bus or the record of a run for other tools."),
    "scenario": (
        "scenario",
        "Drives and published tables: what must stop, and what still does under faults.",
    ),
}


class LazyCommand(TyperCommand):
    """A name and a help text. The module behind it is imported when the command is called."""

    def __init__(self, name: str, module: str, about: str) -> None:
        super().__init__(name, help=about, rich_markup_mode=None)
        self._module = module

    def make_context(self, *arguments: Any, **settings: Any) -> Any:
        """The context of the command that is loaded, so that typer goes on with that one."""
        return self.load().make_context(*arguments, **settings)

    def load(self) -> TyperCommand | TyperGroup:
        """The command, with its options or its subcommands."""
        assert self.name is not None
        found = getattr(importlib.import_module(f"aftbed.cli.{self._module}"), self.name)
        if isinstance(found, typer.Typer):
            return typer.main.get_group(found)
        alone = typer.Typer(add_completion=False, rich_markup_mode=None)
        alone.command(self.name)(found)
        command = typer.main.get_command(alone)
        assert isinstance(command, TyperCommand)
        return command


class CommandTable(TyperGroup):
    """All commands, not yet loaded."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        for name, (module, about) in COMMANDS.items():
            self.add_command(LazyCommand(name, module, about))


app = typer.Typer(
    name="aftbed",
    cls=CommandTable,
    help="A testbed for Adaptive Fault Tolerance: a car that goes on braking when its server dies.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _version(wanted: bool) -> None:
    if wanted:
        from aftbed.campaign.plan import code_version  # noqa: PLC0415 - only for --version

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

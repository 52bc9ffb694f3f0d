"""The table of all commands: lazy loading, the help, exit codes; and commands whose options are a struct."""

import subprocess
import sys
from pathlib import Path
from typing import Annotated

import msgspec
import pytest
import typer
from fakerun import Call
from liveruns import Home
from typer.testing import CliRunner

from aftbed.cli.app import COMMANDS
from aftbed.cli.lazy import CommandTable, LazyCommand
from aftbed.cli.options import takes
from aftbed.cli.scenario import SUBCOMMANDS
from aftbed.runtime.unix import run_directory

# -- the table


@pytest.mark.parametrize(
    ("table", "name"), [(table, name) for table in (COMMANDS, SUBCOMMANDS) for name in table]
)
def test_the_help_in_the_table_is_that_of_the_command(table: CommandTable, name: str) -> None:
    lazy = LazyCommand(name, *table[name])
    loaded = lazy.load()
    assert loaded.help is not None and loaded.help.split("\n\n")[0] == lazy.help


def test_the_help_of_all_commands_imports_no_command() -> None:
    code = (
        "import sys; from aftbed.cli import main; sys.argv = ['aftbed', '--help']\n"
        "try: main()\n"
        "finally: print(*sorted(name for name in sys.modules), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    modules = set(done.stderr.split())
    ours = {name for name in modules if name.partition(".")[0] == "aftbed"}
    assert ours == {
        "aftbed",
        "aftbed.cli",
        "aftbed.cli.app",
        "aftbed.cli.examples",
        "aftbed.cli.interrupted",
        "aftbed.cli.lazy",
        "aftbed.cli.parsing",
        "aftbed.core",
        "aftbed.core.errors",
        "aftbed.runtime",
        "aftbed.runtime.unix",
        "aftbed.runtime.unix.interrupts",
    }
    assert not modules & {
        "pydantic",
        "msgspec",
        "rich",
        "yaml",
        "can",
        "cantools",
        "psutil",
        "scipy",
        "numpy",
        "jinja2",
    }
    assert all(f"  {name} " in done.stdout for name in COMMANDS)


def test_a_command_with_plain_options_does_not_import_pydantic(home: Home) -> None:
    code = (
        "import sys; from aftbed.cli import main; sys.argv = ['aftbed', 'status', '--run', 'abc', '--json']\n"
        "try: main()\n"
        "finally: print(*sorted(name for name in sys.modules), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "no such run is alive" in done.stderr
    assert not {"pydantic", "email", "rich", "yaml", "can", "numpy"} & set(done.stderr.split())


def test_a_mistyped_command_is_refused_with_a_suggestion(call: Call) -> None:
    code, _, err = call("campain")
    assert code == 2
    assert err.startswith("aftbed: error: unknown command 'campain'; did you mean 'campaign'? (one of: ")


def test_help_of_a_command_and_of_a_subcommand(call: Call) -> None:
    code, out, _ = call("run", "--help")
    assert code == 0 and " run [OPTIONS]\n" in out and "--unsafe-memory" in out
    code, out, _ = call("campaign", "run", "--help")
    assert code == 0 and " campaign run [OPTIONS]" in out and "--shard" in out


def test_surroundings_in_which_no_run_can_be_are_exit_code_2(home: Home, call: Call) -> None:
    """The example is a directory of runs that other users could read."""
    root = run_directory.root()
    root.chmod(0o755)
    code, _, err = call("status")
    root.chmod(0o700)
    assert code == 2
    assert err == f"aftbed: error: {root}: must be a directory of this user alone (mode 0700); remove it\n"


def test_trouble_is_exit_code_3(call: Call) -> None:
    """The example is a file that the system refuses when the work is done."""
    code, out, err = call("sim", "--diagram", "/proc/picture")
    assert code == 3 and "verdict: pass" in out
    assert err == "aftbed: trouble: /proc/picture: No such file or directory\n"


# -- commands whose options are a struct


class Wheel(msgspec.Struct, frozen=True, kw_only=True):
    size: Annotated[int, typer.Argument(help="In inches.")]
    colour: Annotated[str, typer.Option(help="Any.")] = "black"
    nuts: Annotated[tuple[Path, ...], typer.Option("--nut")] = ()
    spare: Annotated[bool, typer.Option("--spare")] = False
    brand: Annotated[str | None, typer.Option()] = None


@pytest.mark.parametrize(
    ("words", "wheel"),
    [
        (["17"], Wheel(size=17)),
        (["17", "--colour", "red", "--spare"], Wheel(size=17, colour="red", spare=True)),
        (["9", "--nut", "a", "--nut", "b"], Wheel(size=9, nuts=(Path("a"), Path("b")))),
        (["9", "--brand", ""], Wheel(size=9, brand="")),
    ],
)
def test_the_fields_of_a_struct_are_options(words: list[str], wheel: Wheel) -> None:
    found: list[Wheel] = []

    @takes(Wheel)
    def fit(given: Wheel) -> None:
        """Fit a wheel."""
        found.append(given)

    car = typer.Typer(rich_markup_mode=None)
    car.command()(fit)
    assert CliRunner().invoke(car, words).exit_code == 0
    assert found == [wheel]
    shown = CliRunner().invoke(car, ["--help"]).output
    assert "Fit a wheel." in shown and "In inches." in shown and "[default: black]" in shown
    assert CliRunner().invoke(car, []).exit_code == 2, "an argument without a default is required"

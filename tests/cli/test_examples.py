"""The examples in the help: every command has one, and each is taken by the command that it calls."""

import shlex
from collections.abc import Iterator
from typing import Any

import pytest
import typer

from aftbed.cli.app import app
from aftbed.cli.examples import EXAMPLES


def commands(group: Any, words: str = "") -> Iterator[tuple[str, Any]]:
    """Each command that is no group, and is not hidden, by its words."""
    for name, lazy in group.commands.items():
        command = lazy.load() if hasattr(lazy, "load") else lazy
        path = f"{words} {name}".lstrip()
        if hasattr(command, "commands"):
            yield from commands(command, path)
        elif not command.hidden:
            yield path, command


COMMANDS = dict(commands(typer.main.get_command(app)))


def test_every_command_has_an_example() -> None:
    assert set(EXAMPLES) == set(COMMANDS)


@pytest.mark.parametrize(
    ("words", "line"), [(words, one) for words, lines in EXAMPLES.items() for one in lines]
)
def test_an_example_is_taken_by_its_command(words: str, line: str) -> None:
    given = shlex.split(line)
    if words == "inject crash" and " " in given[1]:  # the fault as one argument
        words, given = "inject fault", ["inject", "fault", *given[1:]]
    path = words.split()
    assert given[: len(path)] == path
    COMMANDS[words].make_context(words, given[len(path) :])  # raises ConfigError of what it does not take


def test_the_help_shows_them_as_they_are_typed() -> None:
    command = COMMANDS["scenario import"]
    shown = command.get_help(typer.Context(command, info_name="aftbed scenario import"))
    assert "Examples:\n    aftbed scenario import drive.xosc --ego Host --out scenarios\n" in shown

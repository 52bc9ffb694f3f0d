"""Commands whose module is imported when they are called: the help of a group imports none of them."""

import gc
import importlib
from collections.abc import Mapping
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from aftbed.cli import examples
from aftbed.cli.parsing import PlainCommand, PlainGroup
from aftbed.runtime.unix.interrupts import uninterrupted

CommandTable = Mapping[
    str, tuple[str, str]
]  # name of a command: MODULE:ATTRIBUTE below aftbed.cli, help in one line


class LazyCommand(TyperCommand):
    """A name and a help text. The attribute is a function, or a typer.Typer that holds subcommands."""

    def __init__(self, name: str, place: str, about: str, group: str = "") -> None:
        super().__init__(name, help=about, rich_markup_mode=None)
        self._place = place
        self._words = f"{group} {name}".lstrip()

    def make_context(self, *arguments: Any, **settings: Any) -> Any:
        """The context of the command that is loaded, so that typer goes on with that one."""
        return self.load().make_context(*arguments, **settings)

    def load(self) -> TyperCommand | TyperGroup:
        """The command, with its options or its subcommands."""
        module, _, attribute = self._place.partition(":")
        with uninterrupted():
            found = getattr(importlib.import_module(f"aftbed.cli.{module}"), attribute)
        if not gc.isenabled():  # see `main`
            gc.freeze()
            gc.enable()
        parent = typer.Typer(rich_markup_mode=None)
        if isinstance(found, typer.Typer):
            for command in found.registered_commands:
                command.cls = PlainCommand
            parent.add_typer(found, name=self.name, help=self.help, no_args_is_help=True)
        else:
            parent.command(self.name, cls=PlainCommand)(found)
        assert self.name is not None
        loaded = typer.main.get_group(parent).commands[self.name]
        assert isinstance(loaded, TyperCommand | TyperGroup)
        loaded.epilog = examples.epilog(self._words)
        for name, command in getattr(loaded, "commands", {}).items():
            command.epilog = examples.epilog(f"{self._words} {name}")
        return loaded


def group_of(table: CommandTable, group: str = "") -> type[TyperGroup]:
    """A group of that name that has, after the commands that it defines, those of `table`."""

    class LazyGroup(PlainGroup):
        def __init__(self, **settings: Any) -> None:
            super().__init__(**settings)
            for name, (place, about) in table.items():
                self.add_command(LazyCommand(name, place, about, group))

    return LazyGroup

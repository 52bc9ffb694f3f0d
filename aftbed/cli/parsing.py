"""Commands whose words are converted here, where that is plain: typer converts with pydantic.

typer (0.29) builds a pydantic adapter for each option, even for one that was not given. The import and the
adapters take 80 ms of CPU time, half of what it takes to import all libraries of a run. Most options are
words, numbers, paths and flags; those are converted here, to the same values. A command line with anything
else in it (a value that is wrong, an option that only typer knows to check, help) is left to typer as a
whole. What typer refuses is said in our words: `usage`.
"""

import inspect
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, ClassVar, Final, Union, get_args, get_origin

import typer
from typer.core import TyperCommand, TyperGroup
from typer.models import ParameterInfo

# The class of all that typer refuses, in its own copy of click or in click itself, by its version.
_UsageError: Final[type[Exception]] = sys.modules[typer.BadParameter.__module__].UsageError
_INT: Final = re.compile(r"[-+]?[0-9]{1,18}", re.ASCII)
_FLOAT: Final = re.compile(r"[-+]?[0-9]{1,18}(\.[0-9]{1,18})?([eE][-+]?[0-9]{1,2})?", re.ASCII)


class _LeftToTyperError(Exception):
    """Something in the words is not plain."""


class PlainCommand(TyperCommand):
    """A command that typer has made of a function."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Take in the words of the command line; none is left. Raises ConfigError."""
        words = tuple(args)
        try:
            ctx.params.update(self._plain_values(ctx, list(args)))
        except _LeftToTyperError:
            try:
                return super().parse_args(ctx, args)
            except _UsageError as error:
                raise self._explained(error, ctx, words) from error
        except _UsageError as error:
            raise self._explained(error, ctx, words) from error
        ctx.args = []
        return []

    def _explained(self, error: Exception, ctx: Any, words: Sequence[str]) -> Exception:
        from aftbed.cli import usage  # noqa: PLC0415 - only of a mistake

        declared = inspect.signature(self.callback).parameters if self.callback is not None else {}
        kinds = {name: _in_words(one.annotation) for name, one in declared.items()}
        return usage.explained(error, ctx, words, kinds)

    def _plain_values(self, ctx: Any, args: list[str]) -> dict[str, object]:
        """By the name of the parameter. Raises _LeftToTyperError; of words that are no options, typer's."""
        if ctx.resilient_parsing or self.callback is None or (self.no_args_is_help and not args):
            raise _LeftToTyperError
        given, left, _ = self.make_parser(ctx).parse_args(args=args)
        if left:
            raise _LeftToTyperError
        declared = inspect.signature(self.callback).parameters
        found: dict[str, object] = {}
        for one in self.get_params(ctx):
            word = given.get(one.name)
            if one.is_eager and not word:  # help
                continue
            if one.is_eager or one.callback is not None or one.name not in declared:
                raise _LeftToTyperError
            if word is None and one.required:
                raise _LeftToTyperError
            default = one.get_default(ctx)
            found[one.name] = _value(declared[one.name].annotation, default, word)
        return found


class PlainGroup(TyperGroup):
    """A group of commands. The word for one of them comes without options of the group, as a rule."""

    MEANT: ClassVar[Mapping[str, str]] = {}  # commands by what others call them

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """As that of typer, which would convert the option for help too, even if it is not given."""
        add_help_option = self.add_help_option
        self.add_help_option = add_help_option and not (args and not args[0].startswith("-"))
        words = tuple(args)
        try:
            return super().parse_args(ctx, args)
        except _UsageError as error:
            from aftbed.cli import usage  # noqa: PLC0415 - only of a mistake

            raise usage.explained(error, ctx, words, {}) from error
        finally:
            self.add_help_option = add_help_option

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command that the first word names. Raises ConfigError."""
        if args[0] in self.commands:
            return super().resolve_command(ctx, args)
        from aftbed.cli import usage  # noqa: PLC0415 - only of a mistake

        raise usage.no_such_command(ctx, args, self.MEANT)


def _in_words(annotation: object) -> str:
    """What a value of the type has to be; "" if that needs no words."""
    try:
        info, kind = _declared(annotation)
    except _LeftToTyperError:
        return ""
    if get_origin(kind) in (list, tuple):
        kind = get_args(kind)[0]
    what = "a whole number" if kind is int else "a number" if kind is float else ""
    if info.min is not None:
        what += f" from {info.min:g} on" if info.max is None else f" from {info.min:g} to {info.max:g}"
    return what


def _value(annotation: object, default: object, word: object) -> object:
    """What a parameter gets. `word` is a text, a tuple or list of them, True of a flag; None: not given."""
    info, kind = _declared(annotation)
    several = get_origin(kind) in (list, tuple)
    if several:
        kind = get_args(kind)[0]
    if word is None:
        if not isinstance(default, str | int | float | Path | list | tuple | None):
            raise _LeftToTyperError
        if several and not isinstance(default, list | tuple | None):
            raise _LeftToTyperError
        return list(default or ()) if several else default  # type: ignore[arg-type]
    if several:
        if not isinstance(word, list | tuple):
            raise _LeftToTyperError
        return [_converted(kind, info, one) for one in word]
    return _converted(kind, info, word)


def _declared(annotation: object) -> tuple[ParameterInfo, object]:
    """What typer was told about the parameter, and its type, without None."""
    if get_origin(annotation) is not Annotated:
        raise _LeftToTyperError
    kind, info, *others = get_args(annotation)
    if others or not isinstance(info, ParameterInfo):
        raise _LeftToTyperError
    if get_origin(kind) in (Union, UnionType):
        kinds = [one for one in get_args(kind) if one is not type(None)]
        if len(kinds) != 1:
            raise _LeftToTyperError
        kind = kinds[0]
    return info, kind


def _converted(kind: object, info: ParameterInfo, word: object) -> object:
    if isinstance(word, bool) and kind is bool:
        return word
    convert = _CONVERSIONS.get(kind)
    if convert is None or not isinstance(word, str) or info.parser is not None or info.envvar is not None:
        raise _LeftToTyperError
    return convert(info, word)


def _text(info: ParameterInfo, word: str) -> str:
    return word


def _whole(info: ParameterInfo, word: str) -> int:
    value = int(word) if _INT.fullmatch(word) else None
    if value is None or not _within(info, value):
        raise _LeftToTyperError
    return value


def _number(info: ParameterInfo, word: str) -> float:
    value = float(word) if _FLOAT.fullmatch(word) else None
    if value is None or not _within(info, value):
        raise _LeftToTyperError
    return value


def _within(info: ParameterInfo, value: float) -> bool:
    return (info.min is None or info.min <= value) and (info.max is None or value <= info.max)


def _path(info: ParameterInfo, word: str) -> Path:
    checked = info.exists or info.resolve_path or info.allow_dash or info.path_type is not None
    if checked or not (info.file_okay and info.dir_okay) or info.writable:
        raise _LeftToTyperError
    if info.readable and os.path.lexists(word) and not os.access(word, os.R_OK):
        raise _LeftToTyperError
    return Path(word)


_CONVERSIONS: Final[Mapping[object, Callable[[ParameterInfo, str], object]]] = {
    str: _text,
    int: _whole,
    float: _number,
    Path: _path,
}

"""What is wrong in a command line, in our words: those of typer reach no user.

typer says what it refuses by the class of an exception, in English of its own. Each class becomes a
ConfigError here that says where (command, option or argument), what was found and what is allowed, with the
nearest that exists.
"""

import difflib
import re
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, cast

import typer

from aftbed.core.errors import ConfigError, unknown

_CLICK: Final = sys.modules[
    typer.BadParameter.__module__
]  # typer's own copy of click, or click: by its version
_PHRASES: Final = ("--inject", "--adapt", "--fault", "--when", "--bench", "--app")  # their values have spaces
_NEAR: Final = 0.7  # how much an option is like another one that is suggested: dashes count too
_RUN_ID: Final = re.compile(r"[0-9a-f]+")
_LOAD: Final = re.compile(r"[0-9]+@[0-9]+")
_SCENARIO_FILE: Final = (".yaml", ".yml")
_LOG_FILE: Final = (".log", ".asc", ".blf", ".trc", ".mf4")
_OPTIONS_MEANT: Final = {  # by what others call them
    "-h": "--help",
    "-o": "--out",
    "-j": "--jobs",
    "-n": "--count",
    "--fault": "--inject",
    "--faults": "--inject",  # as `aftbed sim` called it
    "--mechanism": "--ftm",
    "--output": "--out",
    "--parallel": "--jobs",
    "--speed": "--pace",
    "--event": "--at",
    "--time": "--after",
    "--for": "--duration",
    "--duration": "--for",
    "--id": "--run",
    "--overwrite": "--force",
    "--yes": "--force",
    "--xml": "--junit",
    "--report": "--html",
}


def explained(error: Exception, ctx: Any, words: Sequence[str], kinds: Mapping[str, str]) -> Exception:
    """What to raise instead of typer's `error` about the words behind the command of `ctx`.

    `kinds`: what the parameter of a name takes, where there is more to say than its help does.
    """
    if isinstance(error, _CLICK.NoArgsIsHelpError):
        return cast("Exception", error)  # it is the help of a group
    where = _where(ctx)
    if isinstance(error, _CLICK.NoSuchOption):
        return _no_such_option(ctx, error.option_name)
    if isinstance(error, _CLICK.BadOptionUsage):
        option = _options(ctx)[error.option_name]
        if option.is_flag:
            return ConfigError(f"{where}{error.option_name} takes no value")
        return ConfigError(f"{where}{error.option_name} lacks its value: {_about(option)}")
    if isinstance(error, _CLICK.MissingParameter):
        return ConfigError(f"{where}{_label(error.param)} is missing: {_about(error.param)}")
    given, left, _ = ctx.command.make_parser(ctx).parse_args(args=list(words))
    if isinstance(error, _CLICK.BadParameter) and error.param is not None:
        allowed = kinds.get(error.param.name) or _about(error.param)
        found = _shown(given.get(error.param.name))
        return ConfigError(f"{where}{_label(error.param)} {found}: {allowed} is allowed")
    if left:
        return ConfigError(_surplus(ctx, words, left))
    return ConfigError(f"{where}{shlex.join(words)!r} is not understood (`{_help(ctx)}`)")


def no_such_command(ctx: Any, words: Sequence[str], meant: Mapping[str, str]) -> ConfigError:
    """The first of the words is none of the group's commands. `meant`: commands by what others call them."""
    if words[0].startswith("-"):
        return _no_such_option(ctx, words[0])
    known = [name for name, command in ctx.command.commands.items() if not command.hidden]
    return ConfigError(f"{_where(ctx)}{unknown('command', words[0], known, meant)}")


def _names(ctx: Any) -> list[str]:
    """The words of the command behind the name of the program, which may be `python -m aftbed`."""
    return [] if ctx.parent is None else [*_names(ctx.parent), ctx.info_name]


def _where(ctx: Any) -> str:
    names = _names(ctx)
    return f"{' '.join(names)}: " if names else ""


def _help(ctx: Any) -> str:
    return " ".join(("aftbed", *_names(ctx), "--help"))


def _no_such_option(ctx: Any, option: str) -> ConfigError:
    by_help = _help(ctx)
    reason = f"{_where(ctx)}unknown option {option!r}"
    if hasattr(ctx.command, "commands"):
        return ConfigError(f"{reason}: options stand behind a command (`{by_help}`)")
    options = _options(ctx)
    near = [_OPTIONS_MEANT[option]] if _OPTIONS_MEANT.get(option) in options else []
    near = near or difflib.get_close_matches(option, options, n=1, cutoff=_NEAR)
    if near:
        reason += f"; did you mean {near[0]!r}?"
    elif owner := _owner(ctx, option):
        reason += f", which belongs to `{owner}`"
    return ConfigError(f"{reason} (`{by_help}` lists all)")


def _owner(ctx: Any, option: str) -> str:
    """A command that has the option, the first in the order of the help; "" if none has."""
    for name, command in getattr(ctx.find_root().command, "commands", {}).items():
        for inner, leaf in {"": command, **getattr(_loaded(command), "commands", {})}.items():
            if any(option in param.opts for param in _loaded(leaf).params):
                return f"aftbed {name} {inner}".rstrip()
    return ""


def _loaded(command: Any) -> Any:
    """The command itself of one that is imported when it is called."""
    return command.load() if hasattr(command, "load") else command


def _options(ctx: Any) -> dict[str, Any]:
    """The parameter by each of its names."""
    every = (one for one in ctx.command.get_params(ctx) if one.param_type_name == "option")
    return {name: one for one in every for name in (*one.opts, *one.secondary_opts)}


def _label(param: Any) -> str:
    """As the help names it."""
    if param.param_type_name == "option":
        return str(max(param.opts, key=len))
    return str(param.metavar or param.name)


def _about(param: Any) -> str:
    return str(param.help or "`--help` says what it is").rstrip(".")


def _shown(found: object) -> str:
    words = found if isinstance(found, list | tuple) else (found,)
    return " ".join(repr(word) for word in words)


# -- words that are too many ----------------------------------------------------------------------


def _surplus(ctx: Any, words: Sequence[str], left: Sequence[str]) -> str:
    arguments = [_label(one) for one in ctx.command.params if one.param_type_name == "argument"]
    behind = f" behind {' '.join(arguments)}" if arguments else ""
    meant = _meant(_options(ctx), words, left)
    hint = f"; did you mean `{meant}`?" if meant else ""
    return f"{_where(ctx)}found {' '.join(left)!r}{behind}, allowed are options{hint}"


def _meant(options: Mapping[str, Any], words: Sequence[str], surplus: Sequence[str]) -> str:
    """The option for which the words were meant; "" if that is not known."""
    first = surplus[0]
    if f"--{first}" in options:
        option = f"--{first}"
        values = () if options[option].is_flag else surplus[1:]
        return " ".join((option, *_quoted(option, values)))
    position = words.index(first)
    if position >= 2 and words[position - 2] in _PHRASES:
        option = words[position - 2]
        behind = words[position - 1 :]
        end = next((number for number, word in enumerate(behind) if word.startswith("--")), len(behind))
        return " ".join((option, *_quoted(option, behind[:end])))
    option = next((one for one, fits in _BY_CONTENT.items() if one in options and fits(first)), "")
    if option == "--ftm" and option in words:
        return f"{option} {words[words.index(option) + 1]}+{first}"
    return f"{option} {first}" if option else ""


def _quoted(option: str, words: Sequence[str]) -> list[str]:
    return [f'"{" ".join(words)}"'] if option in _PHRASES and len(words) > 1 else list(words)


def _is_scenario(word: str) -> bool:
    from aftbed.vehicle.scenarios.library import scenario_names  # noqa: PLC0415 - only of a mistake

    return word.endswith(_SCENARIO_FILE) or word.lower() in scenario_names()


def _is_expression(word: str) -> bool:
    from aftbed.ftm.compose import canonical  # noqa: PLC0415 - only of a mistake

    try:
        return bool(canonical(word))
    except ConfigError:
        return False


_BY_CONTENT: Final[Mapping[str, Callable[[str], bool]]] = {  # by its option, whether a word is a value of it
    "--scenario": _is_scenario,
    "--replay": lambda word: word.lower().endswith(_LOG_FILE),
    "--load": lambda word: bool(_LOAD.fullmatch(word)),
    "--ftm": _is_expression,
    "--run": lambda word: bool(_RUN_ID.fullmatch(word)),
}

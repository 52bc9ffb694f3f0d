"""What commands share: options, checks of their values, options declared as one struct, JSON output."""

import functools
import inspect
import json
import os
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from types import GenericAlias
from typing import Annotated, Any, Final, Generic, TypeVar, get_args, get_origin

import msgspec
import typer

from aftbed.core.errors import ConfigError, shown
from aftbed.core.requirements import check_requirements
from aftbed.core.script import RECIPES

SEED_MAX: Final = 2**63 - 1
RATE_HZ_MAX: Final = 100_000.0
JOBS_MAX: Final = 256

Run = Annotated[str | None, typer.Option("--run", help="Id of the run; needed if several are alive.")]
App = Annotated[
    str | None,
    typer.Option(help="The protected function: a class, .so, .fmu, or a program; the brake if left out."),
]
Requests = Annotated[
    str | None,
    typer.Option(
        help="Requests instead of a car: FILE (CSV, JSON lines) or MODULE:FUNCTION, FILE.py:FUNCTION."
    ),
]
Expect = Annotated[
    str | None, typer.Option(help="With --requests: a file of the reply that each of them must get.")
]
Tolerance = Annotated[
    float | None, typer.Option(help="With --expect FILE.csv: by how much numbers of f32 and f64 may differ.")
]
Ftti = Annotated[
    str | None, typer.Option(help="Fault tolerant time interval, as 100ms: a fault handled later fails.")
]
Html = Annotated[Path | None, typer.Option(help="Write a report of the run as one page to this file.")]
Junit = Annotated[Path | None, typer.Option(help="Write the verdict to this file, as JUnit XML.")]
VERIFIES: Final = "--verifies"
VERIFIES_HELP: Final = "A requirement, as SG-1, that the run verifies; may be given several times."
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")]
Quiet = Annotated[
    bool, typer.Option("--quiet", "-q", help="Print the verdict and its reasons, and nothing else.")
]
Ftm = Annotated[str, typer.Option(help="none, pbr, lfr, tr, pbr+tr, ...: aftbed ftm list.")]
Seed = Annotated[int, typer.Option(help="Seed of all random numbers.")]
TrustedFolders = Annotated[
    list[Path] | None,
    typer.Option("--trust", help="Directory whose functions may be executed; may be given several times."),
]


def choices(names: Iterable[str]) -> str:
    """As the help shows what an option allows."""
    return f"<{'|'.join(names)}>"


Recipe = Annotated[
    str,
    typer.Option(metavar=choices(RECIPES), help="drained, or paper: SIGSTOP, kill, launch, link, SIGCONT."),
]

Arguments = TypeVar("Arguments", bound=msgspec.Struct)


class StructCommand(Generic[Arguments]):
    """A function of one struct, as a command whose options are the fields of the struct.

    typer reads the options from `__signature__` and `__annotations__`, as it does for a plain function.
    Inherited fields come last. A field of type `tuple[T, ...]` is an option that can be given several times.
    The function returns the exit code; None is 0.
    """

    def __init__(self, function: Callable[[Arguments], int | None], arguments: type[Arguments]) -> None:
        functools.update_wrapper(self, function)
        self._function, self._arguments = function, arguments
        fields = {field.name: _parameter(field) for field in msgspec.structs.fields(arguments)}
        names = [name for kind in arguments.__mro__ for name in inspect.get_annotations(kind)]
        parameters = [fields[name] for name in dict.fromkeys(names) if name in fields]
        self.__signature__ = inspect.Signature(parameters)
        self.__annotations__ = {one.name: one.annotation for one in parameters}

    def __call__(self, **given: object) -> None:
        """Called by typer, with a list for each option that can be given several times."""
        values = {name: tuple(v) if isinstance(v, list) else v for name, v in given.items() if v is not None}
        raise typer.Exit(self._function(self._arguments(**values)) or 0)


def takes(
    arguments: type[Arguments],
) -> Callable[[Callable[[Arguments], int | None]], StructCommand[Arguments]]:
    """Decorator below `@app.command()`: the options are the fields of `arguments`."""
    return lambda function: StructCommand(function, arguments)


def _parameter(field: msgspec.structs.FieldInfo) -> inspect.Parameter:
    annotation, default = field.type, field.default
    kind, *about = get_args(annotation) if get_origin(annotation) is Annotated else (annotation,)
    if get_origin(kind) is tuple:
        several: Any = GenericAlias(list, get_args(kind)[:1])
        if default is not msgspec.NODEFAULT:
            several, default = several | None, None
        annotation = Annotated[(several, *about)]
    if default is msgspec.NODEFAULT:
        default = inspect.Parameter.empty
    return inspect.Parameter(
        field.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation
    )


def note_unusable() -> None:
    """Where all mechanisms are listed: tell which packages have one that cannot be used, and why."""
    from aftbed.ftm.compose import load_installed  # noqa: PLC0415 - commands without mechanisms need it not

    for why in load_installed():
        print(f"aftbed: note: {shown(why)}", file=sys.stderr)


def separated(given: tuple[str, ...]) -> tuple[str, ...]:
    """The values of an option that takes several, separated by commas or given one by one."""
    return tuple(name for text in given for name in text.split(","))


def requirements(given: tuple[str, ...]) -> tuple[str, ...]:
    """Of `--verifies`. Raises ConfigError."""
    names = separated(given)
    check_requirements(VERIFIES, names)
    return names


def check_range(option: str, value: int, least: int, most: int) -> None:
    """Raise ConfigError if the value of `option` is not in the range."""
    if not least <= value <= most:
        raise ConfigError(f"{option} {value}: {least} to {most} are allowed")


def check_seed(seed: int) -> None:
    """Raise ConfigError if `--seed` is out of range."""
    check_range("--seed", seed, 0, SEED_MAX)


def jobs_of(jobs: int | None) -> int:
    """How many processes `--jobs` asks for; one per usable CPU if left out. Raises ConfigError."""
    if jobs is not None:
        check_range("--jobs", jobs, 1, JOBS_MAX)
    return jobs or len(os.sched_getaffinity(0))


def check_file(option: str, path: Path | None, suffix: str = "") -> None:
    """Raise ConfigError if `path` cannot be written, before the work whose result goes there."""
    if path is None:
        return
    if path.suffix != (suffix or path.suffix) or path.is_dir() or not path.absolute().parent.is_dir():
        kind = f"file {suffix}" if suffix else "file"
        raise ConfigError(f"{option} {path}: a {kind} in a directory that exists is allowed")


def print_json(document: object) -> None:
    """Print one JSON document, in one line; in ASCII where the output takes no other characters."""
    text = msgspec.json.encode(document).decode()
    try:
        text.encode(sys.stdout.encoding)
    except UnicodeEncodeError:
        text = json.dumps(json.loads(text))
    print(text)


def print_blocks(**blocks: list[str]) -> None:
    """Print each block's lines, its name before the first."""
    for name, lines in blocks.items():
        for index, line in enumerate(lines):
            print(f"{'' if index else name:<10} {line}")


def class_source(text: str, folder: Path | None = None) -> str:
    """`FILE.py:CLASS` with the absolute path of the file, which is looked up in `folder`, here if left out.

    Raises ConfigError if there is no such file.
    """
    place, colon, name = text.rpartition(":")
    if not (colon and place and name.isidentifier()):
        raise ConfigError(f"{text!r} names no class; MODULE:CLASS or FILE.py:CLASS is allowed")
    if not place.endswith(".py"):
        return text
    path = ((folder or Path.cwd()) / place).resolve()
    if not path.is_file():
        raise ConfigError(f"{text}: {path}: no such file")
    return f"{path}:{name}"

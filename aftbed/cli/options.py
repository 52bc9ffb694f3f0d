"""Options that several commands share, and commands whose options are declared as one struct."""

import functools
import inspect
import os
from collections.abc import Callable
from typing import Annotated, Final, Generic, TypeVar, get_args, get_origin

import msgspec
import typer

from aftbed.core.errors import ConfigError

SEED_MAX: Final = 2**63 - 1
RATE_HZ_MAX: Final = 100_000.0
JOBS_MAX: Final = 256

Run = Annotated[str | None, typer.Option("--run", help="Id of the run; needed if several are alive.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")]
Seed = Annotated[int, typer.Option(help="Seed of all random numbers.")]
Recipe = Annotated[str, typer.Option(help="drained, or paper: SIGSTOP, kill, launch, link, SIGCONT.")]

Arguments = TypeVar("Arguments", bound=msgspec.Struct)


class StructCommand(Generic[Arguments]):
    """A function of one struct, as a command whose options are the fields of the struct.

    typer reads the options from `__signature__` and `__annotations__`, as it does for a plain function.
    Inherited fields come last. A field of type `tuple[T, ...]` is an option that can be given several times.
    """

    def __init__(self, function: Callable[[Arguments], None], arguments: type[Arguments]) -> None:
        functools.update_wrapper(self, function)
        self._function, self._arguments = function, arguments
        fields = {field.name: _parameter(field) for field in msgspec.structs.fields(arguments)}
        names = [
            name for kind in arguments.__mro__ for name in inspect.get_annotations(kind) if name in fields
        ]
        parameters = [fields[name] for name in dict.fromkeys(names)]
        self.__signature__ = inspect.Signature(parameters)
        self.__annotations__ = {one.name: one.annotation for one in parameters}

    def __call__(self, **given: object) -> None:
        """Called by typer, with a list for each option that can be given several times."""
        values = {name: tuple(v) if isinstance(v, list) else v for name, v in given.items() if v is not None}
        self._function(self._arguments(**values))


def takes(
    arguments: type[Arguments],
) -> Callable[[Callable[[Arguments], None]], StructCommand[Arguments]]:
    """Decorator below `@app.command()`: the options are the fields of `arguments`."""
    return lambda function: StructCommand(function, arguments)


def _parameter(field: msgspec.structs.FieldInfo) -> inspect.Parameter:
    annotation, default = field.type, field.default
    kind, *about = get_args(annotation) if get_origin(annotation) is Annotated else (annotation,)
    if get_origin(kind) is tuple:
        annotation, default = Annotated[(list[get_args(kind)[0]] | None, *about)], None  # type: ignore[misc]
    if default is msgspec.NODEFAULT:
        default = inspect.Parameter.empty
    return inspect.Parameter(
        field.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation
    )


def separated(given: tuple[str, ...]) -> tuple[str, ...]:
    """The values of an option that takes several, separated by commas or given one by one."""
    return tuple(name for text in given for name in text.split(","))


def jobs_of(jobs: int | None) -> int:
    """How many processes `--jobs` asks for; one per usable CPU if left out. Raises ConfigError."""
    if jobs is not None and not 1 <= jobs <= JOBS_MAX:
        raise ConfigError(f"--jobs {jobs}: 1 to {JOBS_MAX} are allowed")
    return jobs or len(os.sched_getaffinity(0))


def check_seed(seed: int) -> None:
    """Raise ConfigError if `--seed` is out of range."""
    if not 0 <= seed <= SEED_MAX:
        raise ConfigError(f"--seed {seed}: 0 to {SEED_MAX} are allowed")

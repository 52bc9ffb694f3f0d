"""Texts that name a function of a user.

package.module:Class            a class, found as any module is
path/file.py:Class              a class in a file
path/lib.so                     a C library (`aft.h`)
path/model.fmu[:ports.yaml]     a co-simulation model, with the map of its ports; `ports.yaml` beside it
program arguments               a program on stdin and stdout, if there is a blank, or such a file
"""

import re
import shlex
import shutil
from enum import Enum
from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.errors import ConfigError

PORTS_NAME: Final = "ports.yaml"
FORMS: Final = 'MODULE:CLASS, FILE.py:CLASS, FILE.so, FILE.fmu[:PORTS.yaml] or "PROGRAM ARGUMENTS" is allowed'
_LIBRARY: Final = re.compile(r"\.so(\.[0-9]+)*$")
_MODEL: Final = re.compile(r"(?P<model>.*\.fmu)(:(?P<ports>.+))?$")


class FunctionKind(Enum):
    CLASS = "class"
    LIBRARY = "so"
    MODEL = "fmu"
    PROGRAM = "stdio"


class FunctionSource(msgspec.Struct, frozen=True):
    """`place`: a module, a file, or a command line; `part`: the class in it, or the file of its ports."""

    kind: FunctionKind
    place: str
    part: str = ""

    def __str__(self) -> str:
        return f"{self.place}:{self.part}" if self.part else self.place

    @property
    def words(self) -> list[str]:
        """Of the command line of a program. Raises ConfigError."""
        try:
            return shlex.split(self.place)
        except ValueError as error:
            raise ConfigError(f"{self.place}: {str(error).lower()}") from None

    def files(self) -> list[Path]:
        """The files that are executed or read, but for those of a class: see `runtime.unix.trust`.

        Raises ConfigError where there is no such program.
        """
        match self.kind:
            case FunctionKind.CLASS:
                return []
            case FunctionKind.PROGRAM:
                program = shutil.which(self.words[0])
                if program is None:
                    raise ConfigError(f"{self.place}: no program {self.words[0]}")
                found = [Path(program), *map(Path, self.words[1:])]
                return [path.resolve() for path in found if path.is_absolute() and path.is_file()]
            case _:
                return [Path(self.place), *([Path(self.part)] if self.part else [])]


def parse_source(text: str) -> FunctionSource:
    """What `text` names. Nothing is looked up, but whether a single word is a program. Raises ConfigError."""
    if not text.strip():
        raise ConfigError(f"{text!r} names no function; {FORMS}")
    if model := _MODEL.match(text):
        beside = str(Path(model["model"]).parent / PORTS_NAME)
        return FunctionSource(FunctionKind.MODEL, model["model"], model["ports"] or beside)
    if _LIBRARY.search(text):
        return FunctionSource(FunctionKind.LIBRARY, text)
    place, colon, name = text.rpartition(":")
    if colon and place and name.isidentifier() and (place.endswith(".py") or " " not in place):
        return FunctionSource(FunctionKind.CLASS, place, name)
    if len(text.split()) > 1 or Path(text).is_file() or shutil.which(text):
        return FunctionSource(FunctionKind.PROGRAM, text)
    raise ConfigError(f"{text!r} names no function; {FORMS}")


def is_foreign(text: str) -> bool:
    """Whether it names a function that is no Python class; "" is the built-in one."""
    return bool(text) and parse_source(text).kind is not FunctionKind.CLASS


def located(text: str, folder: Path | None = None) -> str:
    """`text` with absolute paths; relative ones are looked up in `folder`, here if left out.

    Raises ConfigError where a file, or a program, is missing.
    """
    here = folder or Path.cwd()
    source = parse_source(text)

    def file(path: str) -> str:
        found = (here / path).resolve()
        if not found.is_file():
            raise ConfigError(f"{text}: {found}: no such file")
        return str(found)

    match source.kind:
        case FunctionKind.CLASS:
            place = file(source.place) if source.place.endswith(".py") else source.place
            return f"{place}:{source.part}"
        case FunctionKind.PROGRAM:
            first, *rest = source.words
            if "/" in first:
                first = str((here / first).absolute())
            if shutil.which(first) is None:
                raise ConfigError(f"{text}: no program {first}")
            words = [str((here / word).absolute()) if (here / word).is_file() else word for word in rest]
            return shlex.join([first, *words])
        case _:
            return str(
                FunctionSource(source.kind, file(source.place), file(source.part) if source.part else "")
            )


def renamed(text: str) -> str:
    """Another text that names the same function, whose paths are absolute, so that an update to it does
    something; "" where there is none, as of a class in a module.
    """
    source = parse_source(text)
    if source.kind is FunctionKind.PROGRAM and len(source.words) > 1:
        first, *rest = map(shlex.quote, source.words)
        return " ".join([f"{first}''" if first.startswith("'") else f"'{first}'", *rest])
    path = Path(source.place)
    if not path.is_absolute():
        return ""
    return str(msgspec.structs.replace(source, place=f"{path.parent}/./{path.name}"))

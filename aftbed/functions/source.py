"""Texts that name a function of a user.

package.module:Class            a class, found as any module is
path/file.py:Class              a class in a file
path/lib.so                     a C library (`aft.h`)
path/model.fmu[:ports.yaml]     a co-simulation model, with the map of its ports; `ports.yaml` beside it
program arguments               a program on stdin and stdout, if there is a blank or a slash, or such a file

Behind the text may be a version, `@sha256:` and twelve digits: other content of the same files, for which
a run has exchanged the function (`runtime.unix.trust`). Without one, it is what the run has loaded first.
"""

import re
import shlex
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.errors import ConfigError

PORTS_NAME: Final = "ports.yaml"
FORMS: Final = 'MODULE:CLASS, FILE.py:CLASS, FILE.so, FILE.fmu[:PORTS.yaml] or "PROGRAM ARGUMENTS" is allowed'
_LIBRARY: Final = re.compile(r"\.so(\.[0-9]+)*$")
_VERSION: Final = re.compile(r"(?P<text>.*)@sha256:(?P<version>[0-9a-f]{12})", re.S)
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
    version: str = ""

    def __str__(self) -> str:
        return _versioned(f"{self.place}:{self.part}" if self.part else self.place, self.version)

    @property
    def key(self) -> str:
        """What is loaded as one: the module of a class, else the whole."""
        return _versioned(self.place, self.version) if self.kind is FunctionKind.CLASS else str(self)

    @property
    def words(self) -> list[str]:
        """Of the command line of a program. Raises ConfigError."""
        try:
            return shlex.split(self.place)
        except ValueError as error:
            raise ConfigError(f"{self.place}: {str(error).lower()}") from None

    def reading(self, paths: Mapping[str, str]) -> "FunctionSource":
        """The same from other files: `paths` has the new path by the one of `files`. No class."""

        def other(path: str) -> str:
            return paths.get(str(Path(path).resolve()), path)

        if self.kind is not FunctionKind.PROGRAM:
            return msgspec.structs.replace(self, place=other(self.place), part=self.part and other(self.part))
        first, *rest = self.words
        first = paths.get(str(Path(_which(first) or first).resolve()), first)
        return msgspec.structs.replace(self, place=shlex.join([first, *map(other, rest)]))

    def files(self) -> list[Path]:
        """The files that are executed or read, but for those of a class: see `runtime.unix.trust`.

        Raises ConfigError where there is no such program.
        """
        match self.kind:
            case FunctionKind.CLASS:
                return []
            case FunctionKind.PROGRAM:
                program = _which(self.words[0])
                if program is None:
                    raise ConfigError(f"{self.place}: no program {self.words[0]}")
                found = [Path(program), *map(Path, self.words[1:])]
                return [path.resolve() for path in found if path.is_absolute() and path.is_file()]
            case _:
                return [Path(self.place), *([Path(self.part)] if self.part else [])]


def parse_source(text: str) -> FunctionSource:
    """What `text` names. Nothing is looked up, but whether a single word is a program. Raises ConfigError."""
    if versioned := _VERSION.fullmatch(text):
        return msgspec.structs.replace(parse_source(versioned["text"]), version=versioned["version"])
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
    if len(text.split()) > 1 or "/" in text or Path(text).is_file() or _which(text):
        return FunctionSource(FunctionKind.PROGRAM, text)
    raise ConfigError(f"{text!r} names no function; {FORMS}")


def _versioned(text: str, version: str) -> str:
    return f"{text}@sha256:{version}" if version else text


def told_of(text: str, reason: str) -> str:
    """`reason`, with the function that `text` names in front unless it names that itself."""
    source = parse_source(text)
    files = (source.place, source.part) if source.kind is FunctionKind.MODEL else (source.place,)
    return reason if text in reason or reason.startswith(files) else f"{text}: {reason}"


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
            return _versioned(f"{place}:{source.part}", source.version)
        case FunctionKind.PROGRAM:
            first, *rest = source.words
            if "/" in first:
                first = str((here / first).absolute())
            if Path(first).is_file() and first.endswith(".py"):
                raise ConfigError(f"{text}: which class of it? {text}:CLASS is allowed")
            if Path(first).is_dir():
                raise ConfigError(f"{text}: is a directory; {FORMS}")
            if _which(first) is None:
                raise ConfigError(f"{first} is no program that can be executed; {FORMS}")
            words = [str((here / word).absolute()) if (here / word).is_file() else word for word in rest]
            return _versioned(shlex.join([first, *words]), source.version)
        case _:
            place = file(source.place)
            part = file(source.part) if source.part else ""
            return str(FunctionSource(source.kind, place, part, source.version))


def renamed(text: str) -> str:
    """Another text that names the same function, whose paths are absolute, so that an update to it does
    something; "" where there is none, as of a class in a module.
    """
    source = parse_source(text)
    if source.kind is FunctionKind.PROGRAM and len(source.words) > 1:
        first, *rest = map(shlex.quote, source.words)
        words = " ".join([f"{first}''" if first.startswith("'") else f"'{first}'", *rest])
        return _versioned(words, source.version)
    path = Path(source.place)
    if not path.is_absolute():
        return ""
    return str(msgspec.structs.replace(source, place=f"{path.parent}/./{path.name}"))


def _which(program: str) -> str | None:
    import shutil  # noqa: PLC0415 - with it come three libraries of compression, which no node needs

    return shutil.which(program)

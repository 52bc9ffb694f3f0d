"""Loads a protected function, in the process that will host it, never in one that serves."""

import contextlib
import importlib
import importlib.util
import traceback
from collections.abc import Callable
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType
from typing import Final, assert_never

from aftbed.core.application import REPLY_BYTES_MAX, STATE_BYTES_MAX, Application, Characteristics
from aftbed.core.errors import ConfigError, FunctionFailedError, PeerError
from aftbed.functions.source import FunctionKind, FunctionSource, parse_source

APPLICATION_NAMES: Final = ("execute", "capture", "restore", "characteristics")


class SourceLoader(SourceFileLoader):
    """Compiles the file that is there: a compiled one beside it is not read, and none is written."""

    def get_code(self, fullname: str) -> CodeType:
        return compile(self.source(), self.path, "exec", dont_inherit=True)

    def source(self) -> bytes:
        return self.get_data(self.path)


def load_module(place: str) -> ModuleType:
    """The module called `place`, or in that file if it ends in `.py`. Raises ConfigError without the file."""
    if not place.endswith(".py"):
        return importlib.import_module(place)
    name = Path(place).stem
    spec = importlib.util.spec_from_file_location(name, place, loader=SourceLoader(name, place))
    if spec is None or spec.loader is None or not Path(place).is_file():
        raise ConfigError(f"{place}: no such file")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Code:
    """How code from outside of the package gets into this process: here, whatever the user has named."""

    def module(self, place: str) -> ModuleType:
        """A module, or a file that ends in `.py`, for bricks and functions. Raises ConfigError."""
        return load_module(place)

    def function_module(self, source: FunctionSource) -> ModuleType:
        """The module of a function that is a class. Raises ConfigError."""
        return self.module(source.place)

    def permit(self, source: FunctionSource) -> FunctionSource:
        """Called before a function that is no class is loaded; what to load for it. Raises ConfigError."""
        return source


class NoCode(Code):
    """For what was read from others."""

    def module(self, place: str) -> ModuleType:
        raise ConfigError(f"{place}: no code from outside of the package is executed here")

    def permit(self, source: FunctionSource) -> FunctionSource:
        raise ConfigError(f"{source}: no code from outside of the package is executed here")


OWN_CODE: Final = Code()
NO_CODE: Final = NoCode()


def load_class(source: str, code: Code) -> type:
    """The class that `MODULE:CLASS` or `FILE.py:CLASS` names. Raises ConfigError."""
    place, colon, name = source.rpartition(":")
    if not colon or not place or not name:
        raise ConfigError(f"{source!r} names no class (MODULE:CLASS or FILE.py:CLASS)")
    return _class_in(source, place, name, lambda: code.module(place))


def _class_in(source: str, place: str, name: str, load: Callable[[], ModuleType]) -> type:
    try:
        module = load()
    except ConfigError:
        raise
    except Exception as error:  # whatever a stranger's module does
        raise ConfigError(f"{source}: cannot be imported: {type(error).__name__}: {error}") from error
    found = getattr(module, name, None)
    if not isinstance(found, type):
        classes = sorted(
            n
            for n, value in vars(module).items()
            if isinstance(value, type) and value.__module__ == module.__name__
        )
        raise ConfigError(f"{source}: {place} has no class {name} (it has: {', '.join(classes) or 'none'})")
    return found


def load_application(source: str, code: Code) -> Callable[[], Application]:
    """The maker of a protected function. Raises ConfigError if it is none; so may the maker."""
    named = parse_source(source)
    if named.kind is not FunctionKind.CLASS:
        named = code.permit(named)
    match named.kind:  # what a run does not use costs it no import
        case FunctionKind.CLASS:
            return _checked(_application_class(named, code))
        case FunctionKind.LIBRARY:
            from aftbed.functions.library import library_function  # noqa: PLC0415

            return library_function(Path(named.place))
        case FunctionKind.PROGRAM:
            from aftbed.functions.program import program_function  # noqa: PLC0415

            return program_function(named.place)
        case FunctionKind.MODEL:
            from aftbed.functions.fmu import fmu_function  # noqa: PLC0415

            return fmu_function(Path(named.place), Path(named.part))
        case _:
            assert_never(named.kind)


def preload_for(source: str) -> None:
    """Import what a function of the kind of `source` needs, and nothing of the user's: all forks have it.

    Where that fails, a process that hosts such a function will say so.
    """
    with contextlib.suppress(ConfigError, OSError):  # OSError: a text that is too long for the name of a file
        if source and parse_source(source).kind is FunctionKind.MODEL:
            from aftbed.functions.fmu import import_fmpy  # noqa: PLC0415 - an extra, and 0.3 s

            import_fmpy()


def characteristics_of(source: str, code: Code) -> Characteristics:
    """What the protected function of `source` declares. Raises ConfigError if it declares nothing."""
    make = load_application(source, code)
    return declared_in(source, make if hasattr(make, "characteristics") else make())


def declared_in(source: str, function: object) -> Characteristics:
    """The same of `function`, which was made of `source`. Raises ConfigError."""
    declared: object = getattr(function, "characteristics", None)
    if not isinstance(declared, Characteristics):
        raise ConfigError(f"{source}: characteristics: found {declared!r}, allowed is Characteristics(...)")
    return declared


def _application_class(source: FunctionSource, code: Code) -> type:
    found = _class_in(str(source), source.place, source.part, lambda: code.function_module(source))
    missing = [n for n in APPLICATION_NAMES if not hasattr(found, n)]
    if missing:
        raise ConfigError(f"{source} is no protected function: it lacks {', '.join(missing)}")
    return found


def _checked(found: type) -> Callable[[], Application]:
    """The class, with what it does checked: no bytes, too many, or any error but PeerError ends the node.

    Otherwise nothing that it sends could be read, and the service would stand still. Without an assertion
    of its own, every reply is acceptable.
    """

    name = found.__qualname__

    def tried(call: Callable[..., object], *given: object) -> object:
        try:
            return call(*given)
        except PeerError:
            raise
        except Exception as error:
            *_, last = traceback.extract_tb(error.__traceback__)
            where = f"{last.filename}:{last.lineno}, in {last.name}"
            raise FunctionFailedError(f"{name}: {type(error).__name__}: {error} ({where})") from error

    def checked(what: str, result: object, bytes_max: int) -> bytes:
        if not isinstance(result, bytes):
            kind = type(result).__name__
            raise FunctionFailedError(f"{name}: {what} returned {kind}, bytes are required")
        if len(result) > bytes_max:
            raise FunctionFailedError(
                f"{name}: {what} returned {len(result)} bytes, at most {bytes_max} are allowed"
            )
        return result

    class Checked(found):  # type: ignore[misc]
        def execute(self, request: bytes) -> bytes:
            return checked("execute", tried(super().execute, request), REPLY_BYTES_MAX)

        def capture(self) -> bytes:
            return checked("capture", tried(super().capture), STATE_BYTES_MAX)

        def restore(self, state: bytes) -> None:
            tried(super().restore, state)

        def acceptable(self, request: bytes, reply: bytes) -> bool:
            own = getattr(super(), "acceptable", None)
            return own is None or bool(tried(own, request, reply))

    class Tracked(Checked):
        def changes(self, page_bytes: int) -> object:
            return tried(super().changes, page_bytes)

        def patch(self, page_bytes: int, pages: object) -> None:
            tried(super().patch, page_bytes, pages)

    made = Tracked if hasattr(found, "changes") and hasattr(found, "patch") else Checked
    made.__name__, made.__qualname__ = found.__name__, found.__qualname__
    return made

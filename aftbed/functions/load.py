"""Loads a protected function, in the process that will host it, never in one that serves."""

from collections.abc import Callable
from types import ModuleType
from typing import Final

from aftbed.core.application import REPLY_BYTES_MAX, STATE_BYTES_MAX, Application, Characteristics
from aftbed.core.errors import ConfigError
from aftbed.functions.source import FunctionKind, parse_source

APPLICATION_NAMES: Final = ("execute", "capture", "restore", "characteristics")
LoadModule = Callable[[str], ModuleType]  # a module, or a file that ends in `.py`


def load_class(source: str, load_module: LoadModule) -> type:
    """The class that `MODULE:CLASS` or `FILE.py:CLASS` names. Raises ConfigError."""
    place, colon, name = source.rpartition(":")
    if not colon or not place or not name:
        raise ConfigError(f"{source!r} names no class (MODULE:CLASS or FILE.py:CLASS)")
    try:
        module = load_module(place)
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


def load_application(source: str, load_module: LoadModule) -> Callable[[], Application]:
    """The maker of a protected function. Raises ConfigError if it is none; so may the maker."""
    named = parse_source(source)
    match named.kind:
        case FunctionKind.CLASS:
            return _checked(_application_class(source, load_module))
        case _:
            raise ConfigError(f"{source} names no class (MODULE:CLASS or FILE.py:CLASS)")


def characteristics_of(source: str, load_module: LoadModule) -> Characteristics:
    """What the protected function of `source` declares. Raises ConfigError if it declares nothing."""
    make = load_application(source, load_module)
    declared: object = getattr(make if isinstance(make, type) else make(), "characteristics", None)
    if not isinstance(declared, Characteristics):
        raise ConfigError(f"{source}: characteristics: found {declared!r}, allowed is Characteristics(...)")
    return declared


def _application_class(source: str, load_module: LoadModule) -> type:
    found = load_class(source, load_module)
    missing = [n for n in APPLICATION_NAMES if not hasattr(found, n)]
    if missing:
        raise ConfigError(f"{source} is no protected function: it lacks {', '.join(missing)}")
    return found


def _checked(found: type) -> Callable[[], Application]:
    """The class, with its results checked: what is no bytes, or too long, ends the node (fail-silence).

    Otherwise nothing that it sends could be read, and the service would stand still. Without an assertion
    of its own, every reply is acceptable.
    """

    class Checked(found):  # type: ignore[misc]
        def execute(self, request: bytes) -> bytes:
            return _bytes("execute", super().execute(request), REPLY_BYTES_MAX)

        def capture(self) -> bytes:
            return _bytes("capture", super().capture(), STATE_BYTES_MAX)

        def acceptable(self, request: bytes, reply: bytes) -> bool:
            own = getattr(super(), "acceptable", None)
            return own is None or own(request, reply)

    Checked.__name__, Checked.__qualname__ = found.__name__, found.__qualname__
    return Checked


def _bytes(what: str, result: object, bytes_max: int) -> bytes:
    if not isinstance(result, bytes):
        raise TypeError(f"{what} returned {type(result).__name__}, bytes are required")
    if len(result) > bytes_max:
        raise ValueError(f"{what} returned {len(result)} bytes, at most {bytes_max} are allowed")
    return result

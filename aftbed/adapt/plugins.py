"""Making bricks: those of the catalog, the Engine, and classes that were written off line.

A brick designed off line (paper, III-B) is a class that follows the brick contract, takes a `Setting`, and
says in `KIND` which ports it has: those of the brick whose place it takes. It is found by `MODULE:CLASS`
or `FILE.py:CLASS`, and loaded in the process that will host it, never in one that serves.
"""

from collections.abc import Callable
from types import ModuleType
from typing import Final

from aftbed.adapt.engine import AdaptationEngine
from aftbed.core.application import REPLY_BYTES_MAX, STATE_BYTES_MAX, Application, Characteristics
from aftbed.core.brick import Brick
from aftbed.core.errors import ConfigError
from aftbed.core.graph import BrickSpec, Kind
from aftbed.ftm.registry import KINDS, Setting, make

APPLICATION_NAMES: Final = ("execute", "capture", "restore", "acceptable", "characteristics")
BRICK_NAMES: Final = ("step", "open_ports", "quiescent")
LoadModule = Callable[[str], ModuleType]


def load(source: str, load_module: LoadModule) -> type:
    """The class that `source` names. Raises ConfigError: no such module or file, no such class."""
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
    """The maker of a protected function. Raises ConfigError if it is none."""
    found = load(source, load_module)
    missing = [n for n in APPLICATION_NAMES if not hasattr(found, n)]
    if missing:
        raise ConfigError(f"{source} is no protected function: it lacks {', '.join(missing)}")
    return _checked(found)


def _checked(found: type) -> Callable[[], Application]:
    """The class, with its results checked: what is no bytes, or too long, ends the node (fail-silence).

    Otherwise nothing that it sends could be read, and the service would stand still.
    """

    class Checked(found):  # type: ignore[misc]
        def execute(self, request: bytes) -> bytes:
            return _bytes("execute", super().execute(request), REPLY_BYTES_MAX)

        def capture(self) -> bytes:
            return _bytes("capture", super().capture(), STATE_BYTES_MAX)

    Checked.__name__, Checked.__qualname__ = found.__name__, found.__qualname__
    return Checked


def _bytes(what: str, result: object, bytes_max: int) -> bytes:
    if not isinstance(result, bytes):
        raise TypeError(f"{what} returned {type(result).__name__}, bytes are required")
    if len(result) > bytes_max:
        raise ValueError(f"{what} returned {len(result)} bytes, at most {bytes_max} are allowed")
    return result


def characteristics_of(source: str, load_module: LoadModule) -> Characteristics:
    """What the protected function of `source` declares. Raises ConfigError if it declares nothing."""
    declared: object = getattr(load_application(source, load_module), "characteristics", None)
    if not isinstance(declared, Characteristics):
        raise ConfigError(f"{source}: characteristics: found {declared!r}, allowed is Characteristics(...)")
    return declared


def make_brick(spec: BrickSpec, setting: Setting, load_module: LoadModule) -> Brick:
    """A new brick for `spec`. Raises ConfigError where a class written off line does not fit."""
    if spec.source:
        return _off_line(spec, setting, load_module)
    if spec.kind == "engine":
        return AdaptationEngine()
    return make(spec.kind, setting)


def _off_line(spec: BrickSpec, setting: Setting, load_module: LoadModule) -> Brick:
    found = load(spec.source, load_module)
    missing = [n for n in BRICK_NAMES if not callable(getattr(found, n, None))]
    if missing:
        raise ConfigError(f"{spec.source} is no brick: it lacks {', '.join(missing)}")
    wanted, declared = KINDS[spec.kind], getattr(found, "KIND", None)
    if not isinstance(declared, Kind):
        raise ConfigError(
            f"{spec.source} does not say its ports: it lacks KIND = Kind(...), as of {wanted.name}"
        )
    for side in ("inputs", "outputs"):
        has, needs = set(getattr(declared, side)), set(getattr(wanted, side))
        if has != needs:
            raise ConfigError(
                f"{spec.source} cannot take the place of {spec.name}: its {side} are"
                f" {', '.join(sorted(has)) or 'none'}, wanted are {', '.join(sorted(needs)) or 'none'}"
            )
    try:
        brick: Brick = found(setting)
    except Exception as error:  # a stranger's constructor
        raise ConfigError(f"{spec.source}: cannot be made: {type(error).__name__}: {error}") from error
    return brick

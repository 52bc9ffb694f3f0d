"""Making bricks: those of the catalog, the Engine, and classes that were written off line.

A brick designed off line (paper, III-B) is a class that follows the brick contract, takes a `Setting`, and
says in `KIND` which ports it has: those of the brick whose place it takes. It is found by `MODULE:CLASS`
or `FILE.py:CLASS`, and loaded in the process that will host it, never in one that serves.
"""

from typing import Final

from aftbed.adapt.engine import AdaptationEngine
from aftbed.core.brick import Brick
from aftbed.core.errors import ConfigError
from aftbed.core.graph import BrickSpec, Kind
from aftbed.ftm.registry import KINDS, Setting, make
from aftbed.functions.load import Code, load_class

BRICK_NAMES: Final = ("step", "open_ports", "quiescent")


def make_brick(spec: BrickSpec, setting: Setting, code: Code) -> Brick:
    """A new brick for `spec`. Raises ConfigError where a class written off line does not fit."""
    if spec.source:
        return _off_line(spec, setting, code)
    if spec.kind == "engine":
        return AdaptationEngine()
    return make(spec.kind, setting)


def _off_line(spec: BrickSpec, setting: Setting, code: Code) -> Brick:
    found = load_class(spec.source, code)
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

"""What the words of all faults have in common: whole numbers, how often a fault comes again, conditions."""

import re
from typing import Final, cast

from aftbed.core.busfault import QUANTITIES, Condition, Quantity
from aftbed.core.errors import ConfigError, unknown
from aftbed.core.persistence import CHANCE, EVERY, INTERMITTENT, Chance, Every

NUMBER: Final = re.compile(r"-?[0-9]{1,9}(\.[0-9]{1,6})?")
COUNT_MAX: Final = 10**12 - 1
_WHOLE: Final = re.compile(r"[0-9]{1,12}")
_PART: Final = re.compile(r"[01](\.[0-9]{1,6})?")


def whole(what: str, text: str, least: int, most: int | None = None) -> int:
    """A whole number in its limits. Raises ConfigError."""
    value = int(text) if _WHOLE.fullmatch(text) else least - 1
    if value < least or (most is not None and value > most):
        limits = f"from {least} on" if most is None else f"from {least} to {most}"
        raise ConfigError(f"{what} {text[:40]!r}: a whole number {limits} is allowed")
    return value


def intermittent(word: str, text: str) -> Every | Chance:
    """What stands behind `intermittent`: `every N`, or `p CHANCE`. Raises ConfigError."""
    if word == EVERY:
        return Every(whole(EVERY, text, 1, COUNT_MAX))
    if word != CHANCE:
        raise unknown(f"word behind {INTERMITTENT!r}:", word[:40], (EVERY, CHANCE))
    p = float(text) if _PART.fullmatch(text) else 0.0
    if not 0 < p <= 1:
        raise ConfigError(f"p {text[:40]!r}: a chance above 0 and up to 1 is allowed, as 0.1")
    return Chance(p)


def condition(quantity: str, than: str, value: str) -> Condition:
    """What stands behind `when`: `ttc < 1.2`. Raises ConfigError."""
    if quantity not in QUANTITIES:
        raise unknown("quantity of the car", quantity[:40], QUANTITIES)
    if than not in ("<", ">"):
        raise ConfigError(f"found {than[:40]!r} where '<' or '>' is expected")
    if not NUMBER.fullmatch(value):
        raise ConfigError(
            f"{quantity} {than} {value[:40]!r}: a number is allowed (ttc in s, gap in m, speed in m/s)"
        )
    return Condition(cast("Quantity", quantity), than == "<", float(value))


def refuse_unsafe(what: str, *, unsafe: bool, say: str = "--unsafe-memory") -> None:
    """Raise ConfigError where `what` strikes memory, and nobody has said that this is wanted, by `say`."""
    if not unsafe:
        raise ConfigError(
            f"{what}: it flips a bit of whatever a process keeps there, the testbed's own code and records"
            f" included, so what comes of it proves nothing about a mechanism alone; say {say} if that is"
            " wanted"
        )

"""Words that mean the same wherever they are written: in a fault, in an adaptation."""

import re
from typing import Final

from aftbed.core.errors import ConfigError

DURATION_MS_MAX: Final = 3_600_000
_UNITS_MS: Final = {"ms": 1, "s": 1000}
_DURATION: Final = re.compile(r"([0-9]{1,10}(?:\.[0-9]{1,6})?)(ms|s)")
_PLAIN: Final = re.compile(r"[1-9][0-9]{0,9}")  # without a unit


def milliseconds(what: str, text: str) -> float:
    """`50ms`, `2s` or `0.5ms`, which is a `what`, in milliseconds. Raises ConfigError."""
    found = _DURATION.fullmatch(text)
    value = float(found[1]) * _UNITS_MS[found[2]] if found else 0.0
    if not 0 < value <= DURATION_MS_MAX:
        raise _refusal(what, text)
    return value


def whole_milliseconds(what: str, text: str) -> int:
    """`milliseconds`, rounded. Raises ConfigError also where nothing is left of them."""
    value = round(milliseconds(what, text))
    if value == 0:
        raise _refusal(what, text)
    return value


def number(value: float) -> str:
    """As it is written: six decimals at most, and none in vain."""
    return f"{value:.6f}".rstrip("0").rstrip(".")


def duration(ms: float) -> str:
    """As `milliseconds` reads it."""
    return f"{number(ms)}ms"


def _refusal(what: str, text: str) -> ConfigError:
    meant = f"; did you mean {text}ms or {text}s?" if _PLAIN.fullmatch(text) else ""
    return ConfigError(
        f"{what} {text[:40]!r}: a positive number with its unit is allowed, as 50ms or 2s,"
        f" up to {DURATION_MS_MAX // _UNITS_MS['s']}s{meant}"
    )

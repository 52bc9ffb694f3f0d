"""Colour of what is printed: none with NO_COLOR (no-color.org), none where standard output is no terminal."""

import os
import sys
from enum import Enum
from typing import Final

DUMB: Final = ("", "dumb", "unknown")  # TERM of what has neither colour nor a cursor that moves


class Style(Enum):
    """How a text looks; the value is its SGR (ECMA-48)."""

    PLAIN = ""
    TITLE = "7"
    STRONG = "1"
    FAINT = "2"
    GOOD = "32"
    NOTE = "36"
    ODD = "35"
    WARN = "33"
    SERIOUS = "1;31"
    ALARM = "1;37;41"


def is_capable() -> bool:
    """Whether standard output is a terminal with a cursor that can be moved."""
    return sys.stdout.isatty() and os.environ.get("TERM", "") not in DUMB


def has_colour() -> bool:
    return is_capable() and not os.environ.get("NO_COLOR")


def painted(text: str, style: Style) -> str:
    """`text` for standard output, in colour if that has some."""
    return f"\x1b[{style.value}m{text}\x1b[0m" if style is not Style.PLAIN and has_colour() else text

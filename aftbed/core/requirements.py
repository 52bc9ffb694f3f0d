"""Identifiers of the requirements that a scenario, a campaign or a run verifies: `verifies: [SG-1, FSR-3.2]`.

They go where safety cases live: into the properties of JUnit XML. So they hold no character that XML forbids,
and no comma, at which tools split them.
"""

import re
from collections.abc import Sequence
from typing import Final

from aftbed.core.errors import FileKeyError

_IDENTIFIER: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._:/+-]{0,63}")
SHOWN_MAX: Final = 64  # characters of one that is refused


def check_requirements(where: str, names: Sequence[str]) -> None:
    """Raises FileKeyError for what is no identifier, and for one that stands twice."""
    for number, name in enumerate(names):
        if not _IDENTIFIER.fullmatch(name):
            raise FileKeyError(
                f"{where}[{number}]",
                f"found {name[:SHOWN_MAX]!r}, allowed is an identifier such as SG-1 or"
                " FSR-3.2: a letter or a digit, then also . _ : / + -, 64 characters at most",
            )
        if names.index(name) < number:
            raise FileKeyError(f"{where}[{number}]", f"{name} stands twice")

"""Reading the words of a fault: its name, its subject, then keys with their values in any order.

    crash primary at checkpoint.sent nth 100
    NAME  SUBJECT KEY VALUE          KEY VALUE

Each kind of fault says which keys it takes (`FaultKind.KEYS`) and reads their values. Numbers, times and
conditions mean the same in all kinds; the readers that several kinds share are here, in `timing` (when and
how often) and in `bit_patterns` (which bits).
"""

import re
from collections.abc import Sequence
from typing import Final

from aftbed.core.errors import ConfigError, unknown

NUMBER: Final = re.compile(r"-?[0-9]{1,9}(\.[0-9]{1,6})?")
PERMANENT, INTERMITTENT, BYTE = "permanent", "intermittent", "byte"
WHEN_KEYS: Final = ("at", "nth", "after", "when")
REPEAT_KEYS: Final = (PERMANENT, INTERMITTENT)
_VALUE_WORDS: Final = {INTERMITTENT: 2, "when": 3}  # of all other keys the value is one word
_WHOLE: Final = re.compile(r"[0-9]{1,12}")


class FaultWords:
    """The words of one fault: name, subject, keys with their values.

    Raises ConfigError where a key is unknown, double or without value.
    """

    def __init__(self, words: Sequence[str], keys: Sequence[str]) -> None:
        self.text = " ".join(words)
        self.name, self.subject, *rest = words
        self._values: dict[str, str] = {}
        while rest:
            key = rest.pop(0)
            if key not in keys:
                raise unknown(f"word in fault {self.text!r}:", key, keys)
            if key in self._values:
                raise ConfigError(f"fault {self.text!r}: {key!r} twice")
            alone = key == PERMANENT or (key == BYTE and (not rest or rest[0].isalpha()))
            count = 0 if alone else _VALUE_WORDS.get(key, 1)
            if len(rest) < count:
                raise ConfigError(f"fault {self.text!r}: {key!r} lacks its value")
            self._values[key] = " ".join(rest.pop(0) for _ in range(count))

    def __contains__(self, key: str) -> bool:
        return key in self._values

    def __getitem__(self, key: str) -> str:
        return self._values[key]

    def get(self, key: str, default: str = "") -> str:
        return self._values.get(key, default)

    def first_of(self, keys: Sequence[str]) -> str | None:
        return next((key for key in keys if key in self._values), None)

    def not_both(self, one: str, other: str) -> None:
        """Raise ConfigError where both keys are given."""
        if one in self and other in self:
            raise ConfigError(f"'{one} {self[one]}' and '{other} {self[other]}': one of them is allowed")

    def nth_needs_event(self) -> None:
        """Raise ConfigError where `nth` is given without the event that it counts."""
        if "nth" in self and "at" not in self:
            nth = self["nth"]
            raise ConfigError(f"'nth {nth}' counts an event: 'at EVENT nth {nth}' is allowed")


def whole(what: str, text: str, least: int, most: int | None = None) -> int:
    """A whole number in its limits. Raises ConfigError."""
    value = int(text) if _WHOLE.fullmatch(text) else least - 1
    if value < least or (most is not None and value > most):
        limits = f"from {least} on" if most is None else f"from {least} to {most}"
        raise ConfigError(f"{what} {text[:40]!r}: a whole number {limits} is allowed")
    return value

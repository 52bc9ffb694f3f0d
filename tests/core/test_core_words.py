"""A duration as a person writes it: with its unit, more than nothing, an hour at most."""

import re
from collections.abc import Callable
from typing import Final

import pytest

from aftbed.core.errors import ConfigError
from aftbed.core.units import DURATION_MS_MAX, milliseconds, whole_milliseconds


@pytest.mark.parametrize(
    ("text", "ms"),
    [
        ("1ms", 1),
        ("50ms", 50),
        ("2s", 2000),
        ("0.5s", 500),
        ("1.25ms", 1.25),
        ("0.000001ms", 0.000001),
        ("3600s", DURATION_MS_MAX),
        ("3600000ms", DURATION_MS_MAX),
    ],
)
def test_durations(text: str, ms: float) -> None:
    assert milliseconds("after", text) == ms


@pytest.mark.parametrize(
    ("text", "ms"), [("1ms", 1), ("2s", 2000), ("0.6ms", 1), ("1.4ms", 1), ("3600s", DURATION_MS_MAX)]
)
def test_whole_durations_are_rounded(text: str, ms: int) -> None:
    found = whole_milliseconds("after", text)
    assert found == ms and isinstance(found, int)


Reads = Callable[[str, str], float]
BAD: Final = (
    *("", "0", "ms", "s", "5 ms", "5min", "5mss", "-5ms", "+5ms", "1e3ms", ".5s", "5.s", "0.0000001s"),
    *("0ms", "0.0s", "3600.1s", "3600001ms", "3601s", "9" * 11 + "ms", "²s"),
)


@pytest.mark.parametrize("read", [milliseconds, whole_milliseconds])
@pytest.mark.parametrize("text", BAD)
def test_what_is_no_duration_is_named_with_what_is_allowed(read: Reads, text: str) -> None:
    allowed = "a positive number with its unit is allowed, as 50ms or 2s, up to 3600s"
    with pytest.raises(ConfigError, match=f"^{re.escape(f'after {text!r}: {allowed}')}$"):
        read("after", text)


def test_a_number_without_a_unit_gets_both() -> None:
    with pytest.raises(ConfigError, match=r"up to 3600s; did you mean 5ms or 5s\?$"):
        milliseconds("after", "5")


@pytest.mark.parametrize("text", ["0.4ms", "0.5ms", "0.0001s"])
def test_less_than_a_millisecond_is_no_whole_one(text: str) -> None:
    with pytest.raises(ConfigError, match=f"^for '{re.escape(text)}': a positive number"):
        whole_milliseconds("for", text)


@pytest.mark.parametrize("unit", ["s", "ms"])
def test_a_number_of_any_length_is_named_but_not_in_full(unit: str) -> None:
    with pytest.raises(ConfigError, match=f"^after '{'9' * 40}': a positive"):
        milliseconds("after", "9" * 400 + unit)

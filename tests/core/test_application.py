"""Numbers in replies and states: where they are, and how far two of them are apart."""

import math
import struct
from typing import Final

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.core.application import BITS, AccessKind, Field, approximate, difference
from aftbed.core.errors import ConfigError

MARK: Final = 0xAB
FIELDS: Final = (Field("brake", "f64", 1), Field("count", "u16", 9))
numbers: Final = st.floats(-1e6, 1e6)


def reply(brake: float, count: int = 3, mark: int = MARK) -> bytes:
    return struct.pack("<BdH", mark, brake, count)


@given(numbers, numbers, st.integers(0, 65535), st.integers(0, 65535))
def test_the_largest_difference_of_a_number(one: float, other: float, first: int, second: int) -> None:
    found = difference(FIELDS, reply(one, first), reply(other, second))
    assert found == max(abs(one - other), abs(first - second))


@pytest.mark.parametrize(
    ("fields", "one", "other"),
    [
        ((), reply(1.0), reply(1.5)),  # nothing is known of its numbers
        (FIELDS, reply(1.0), reply(1.0, mark=1)),  # a byte that is no number
        (FIELDS, reply(1.0), reply(1.0)[:-1]),
        (FIELDS, reply(1.0)[:-1], reply(1.5)[:-1]),  # too short for its fields
        (FIELDS, reply(1.0), reply(math.nan)),
        (FIELDS, reply(math.inf), reply(-math.inf)),
    ],
)
def test_what_no_tolerance_covers(fields: tuple[Field, ...], one: bytes, other: bytes) -> None:
    assert difference(fields, one, other) == math.inf


def test_equal_bytes_do_not_differ() -> None:
    assert difference(FIELDS, reply(math.nan), reply(math.nan)) == 0.0
    assert difference(FIELDS, reply(0.0), reply(-0.0)) == 0.0, "as numbers they are equal"


@pytest.mark.parametrize("tolerance", [0.0, -1e-9, math.nan, math.inf])
def test_a_tolerance_is_more_than_nothing_and_finite(tolerance: float) -> None:
    with pytest.raises(ConfigError, match="a tolerance is more than 0 and finite"):
        approximate(tolerance)


def test_an_approximate_access_says_how_much() -> None:
    assert str(approximate(1e-9)) == "approximate(1e-09)"
    assert approximate(1e-9).kind is AccessKind.APPROXIMATE


def test_the_widths() -> None:
    assert BITS == {
        "bool": 8, "u8": 8, "u16": 16, "u32": 32, "u64": 64, "i8": 8, "i16": 16, "i32": 32, "i64": 64,
        "f32": 32, "f64": 64,
    }  # fmt: skip

"""What the bare server makes of a run, and which replies differ from it by more than they may."""

import struct
from typing import Final

import pytest

from aftbed.core.application import EXACT, Application, Characteristics, Field, StateAccess, approximate
from aftbed.core.errors import FunctionFailedError
from aftbed.judge.bare_server import Change, ReferenceRun, Succession, executed

REQUESTS: Final = [(number, b"request") for number in range(1, 7)]
NUMBER: Final = (Field("sum", "f64", 0),)


class Sum:
    """Counts its requests; what it declares is given."""

    reply_fields = NUMBER

    def __init__(self, access: StateAccess = EXACT, deterministic: bool = True, fails_at: int = 0) -> None:
        self.characteristics = Characteristics(deterministic, access)
        self.sum, self.fails_at = 0.0, fails_at

    def execute(self, request: bytes) -> bytes:
        self.sum += 1.0
        if self.sum == self.fails_at:
            raise FunctionFailedError("Sum: out of numbers")
        return struct.pack("<d", self.sum)

    def capture(self) -> bytes:
        return struct.pack("<d", self.sum)

    def restore(self, state: bytes) -> None:
        (self.sum,) = struct.unpack("<d", state)

    def acceptable(self, request: bytes, reply: bytes) -> bool:
        return True


def wrong(found: ReferenceRun, by: float) -> list[int]:
    """The requests to which a reply is wrong that differs by so much."""
    numbers = ((n, reply, struct.unpack("<d", reply)[0] + by) for n, reply in found.replies)
    return [n for n, reply, other in numbers if found.is_wrong(n, struct.pack("<d", other), reply)]


def succession(first: Application, *changes: Change) -> ReferenceRun:
    return executed(REQUESTS, Succession(lambda: first, list(changes)))


@pytest.mark.parametrize(("by", "numbers"), [(0.0, []), (0.4, []), (0.6, [1, 2, 3, 4, 5, 6])])
def test_replies_may_differ_by_what_the_function_declares(by: float, numbers: list[int]) -> None:
    assert wrong(executed(REQUESTS, Sum(approximate(0.5))), by) == numbers
    assert wrong(executed(REQUESTS, Sum()), by) == (list(range(1, 7)) if by else [])


def test_the_tolerance_of_an_update_does_not_cover_what_came_before() -> None:
    found = succession(Sum(), (4, lambda: Sum(approximate(0.5))))
    assert wrong(found, 0.1) == [1, 2, 3] and wrong(found, 0.6) == [1, 2, 3, 4, 5, 6]
    assert (found.tolerance, found.deterministic) == (0.5, True)


def test_a_state_that_was_approximate_once_stays_it() -> None:
    found = succession(Sum(approximate(0.5)), (3, Sum))
    assert wrong(found, 0.4) == []
    found = succession(Sum(), (2, lambda: Sum(approximate(0.5))), (5, None))
    assert wrong(found, 0.4) == [1]


def test_replies_are_compared_up_to_a_version_that_is_not_deterministic() -> None:
    found = succession(Sum(), (3, lambda: Sum(deterministic=False)), (5, Sum))
    assert wrong(found, 1.0) == [1, 2] and not found.deterministic


def test_a_bare_function_that_fails_leaves_the_replies_unknown() -> None:
    found = executed(REQUESTS, Sum(fails_at=3))
    assert found.unknown == "the bare function fails at request 3: Sum: out of numbers"
    assert found.replies == ()

"""Thousands of cases that take microseconds each, as one test."""

from collections.abc import Callable, Iterable
from typing import TypeVar

Case = TypeVar("Case")
Test = Callable[[Case], None]


def for_each(cases: Iterable[Case]) -> Callable[[Test[Case]], Callable[[], None]]:
    """Make one test of a test of a case. What it raises has the case as a note."""

    def looped(test: Test[Case]) -> Callable[[], None]:
        def all_cases() -> None:
            tried = 0
            for case in cases:
                try:
                    test(case)
                except BaseException as error:
                    error.add_note(f"in the case {case}")
                    raise
                tried += 1
            assert tried, "no case"

        all_cases.__name__, all_cases.__doc__, all_cases.__module__ = (
            test.__name__,
            test.__doc__,
            test.__module__,
        )
        return all_cases

    return looped

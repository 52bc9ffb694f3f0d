"""What the bench does where a measurement fails, or a size is too large."""

import pytest

from aftbed.bench.paper import TRIES, tried
from aftbed.bench.sweep import Sized, sweep_sizes
from aftbed.core.errors import ConfigError, HarnessError


class Flaky:
    """Fails so many times, then gives a number."""

    def __init__(self, failures: int, error: type[Exception] = HarnessError) -> None:
        self.failures, self.calls, self.error = failures, 0, error
        self.told: list[str] = []

    def measure(self) -> int:
        self.calls += 1
        if self.calls <= self.failures:
            raise self.error(f"trouble {self.calls}")
        return 42

    def tried(self) -> int:
        return tried("a figure", self.measure, self.told.append)


@pytest.mark.parametrize("error", [HarnessError, ConfigError])
def test_a_measurement_that_fails_is_begun_anew(error: type[Exception]) -> None:
    flaky = Flaky(TRIES - 1, error)
    assert flaky.tried() == 42
    assert flaky.told == ["a figure", "a figure, again (trouble 1)", "a figure, again (trouble 2)"]


def test_one_that_fails_again_and_again_is_trouble_of_the_harness() -> None:
    flaky = Flaky(TRIES)
    with pytest.raises(HarnessError, match="a figure: failed 3 times, the last time: trouble 3"):
        flaky.tried()


def test_a_fault_of_ours_is_not_tried_again() -> None:
    flaky = Flaky(1, ZeroDivisionError)
    with pytest.raises(ZeroDivisionError):
        flaky.tried()
    assert flaky.calls == 1


def test_behind_the_first_size_that_is_not_carried_none_is_tried() -> None:
    asked: list[int] = []

    def measure(size_bytes: int) -> Sized:
        asked.append(size_bytes)
        return Sized("pbr", size_bytes, refused="too large" if size_bytes > 100 else "")

    rows = sweep_sizes("pbr", (10_000, 100, 1_000), measure)
    assert asked == [100, 1_000]
    assert [(row.state_bytes, bool(row.refused)) for row in rows] == [
        (100, False),
        (1_000, True),
        (10_000, True),
    ]
    assert rows[2].refused == "not tried: a smaller one is not carried"

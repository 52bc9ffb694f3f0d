"""Failure counts of a whole fault space, out of what was sampled of it."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.campaign.statistics import FailureCount, Interval, extrapolated, proportion
from aftbed.core.errors import ConfigError

SAMPLES = st.tuples(st.integers(0, 400), st.integers(0, 400)).map(sorted)
POPULATIONS = st.integers(1, 100_000)


def test_it_is_the_share_times_the_population() -> None:
    found, share = extrapolated(3, 200, 64_000), proportion(3, 200)
    assert found.failures == pytest.approx(960)
    assert found.interval.low == pytest.approx(share.low * 64_000)
    assert found.interval.high == pytest.approx(share.high * 64_000)


def test_a_mechanism_that_only_dilutes_does_not_better_its_count() -> None:
    """Schirmeier et al. (DSN 2015): four no-operations before the program "Hi" raise its coverage from 62.5 %
    to 75 %, though the same 48 faults (of 8 cycles, then 12, of 16 bits) do harm."""
    assert extrapolated(48, 128, 128).failures == extrapolated(48, 192, 192).failures == 48


def test_a_fault_space_that_was_not_sampled_can_hold_anything() -> None:
    assert extrapolated(0, 0, 1000) == FailureCount(None, Interval(0.0, 1000.0))


@given(SAMPLES, POPULATIONS, st.floats(0.5, 0.999))
def test_the_count_lies_within_its_interval_and_that_within_the_fault_space(
    sample: list[int], population: int, confidence: float
) -> None:
    found, tiny = extrapolated(*sample, population, confidence), 1e-9 * population
    assert 0 <= found.interval.low <= found.interval.high <= population
    if found.failures is not None:
        assert found.interval.low - tiny <= found.failures <= found.interval.high + tiny


@given(SAMPLES, POPULATIONS)
def test_what_does_harm_and_what_does_not_are_mirror_images(sample: list[int], population: int) -> None:
    failures, sampled = sample
    harm = extrapolated(failures, sampled, population).interval
    none = extrapolated(sampled - failures, sampled, population).interval
    assert harm.low == pytest.approx(population - none.high, abs=1e-6 * population)
    assert harm.high == pytest.approx(population - none.low, abs=1e-6 * population)


def test_a_confidence_that_is_none_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"^confidence 95: more than 0 and less than 1 is allowed"):
        extrapolated(1, 2, 3, confidence=95)

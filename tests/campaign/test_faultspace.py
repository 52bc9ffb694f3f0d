"""Failure counts and coverage of a whole fault space, out of what was sampled of it."""

from random import Random
from typing import Final

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.campaign.statistics import (
    Coverage,
    FailureCount,
    Interval,
    StratumCounts,
    coverage,
    extrapolated,
    extrapolated_sum,
    proportion,
)
from aftbed.core.errors import ConfigError

SEED: Final = 20261
STRATA: Final = st.lists(
    st.tuples(st.integers(0, 400), st.integers(0, 400), st.integers(1, 100_000)).map(
        lambda drawn: StratumCounts(min(drawn[:2]), max(drawn[:2]), drawn[2])
    ),
    min_size=1,
    max_size=6,
)


def test_a_mechanism_that_only_dilutes_betters_its_coverage_and_not_its_count() -> None:
    """Schirmeier et al. (DSN 2015): four no-operations before the program "Hi" raise its coverage from 62.5 %
    to 75 %, though the same 48 faults (of 8 cycles, then 12, of 16 bits) do harm."""
    base, diluted = StratumCounts(48, 128, 128), StratumCounts(48, 192, 192)
    assert coverage([base], distinct=True) == Coverage(0.625, Interval(0.625, 0.625))
    assert coverage([diluted], distinct=True) == Coverage(0.75, Interval(0.75, 0.75))
    same = FailureCount(48.0, Interval(48.0, 48.0))
    assert extrapolated(48, 128, 128, distinct=True) == extrapolated(48, 192, 192, distinct=True) == same


def test_one_stratum_is_the_share_times_its_population() -> None:
    found, share = extrapolated(3, 200, 64_000), proportion(3, 200)
    assert found.failures == pytest.approx(960)
    assert found.interval.low == pytest.approx(share.low * 64_000)
    assert found.interval.high == pytest.approx(share.high * 64_000)


@pytest.mark.parametrize(
    ("a", "m", "b", "n", "low", "high"),
    [  # Newcombe, Statistics in Medicine 17 (1998) 873-890, table II, method 10: the difference a/m - b/n
        (56, 70, 48, 80, 0.0524, 0.3339),
        (9, 10, 3, 10, 0.1705, 0.8090),
        (6, 7, 2, 7, 0.0582, 0.8062),
        (5, 56, 0, 29, -0.0381, 0.1926),
        (0, 10, 0, 20, -0.1611, 0.2775),
        (10, 10, 0, 20, 0.6791, 1.0),
    ],
)
def test_the_interval_of_a_sum_is_that_of_newcombe(
    a: int, m: int, b: int, n: int, low: float, high: float
) -> None:
    """a/m - b/n is the sum of two shares, a/m and (n - b)/n, less one: two strata of one fault each."""
    found = extrapolated_sum([StratumCounts(a, m, 1), StratumCounts(n - b, n, 1)], method="wilson").interval
    assert (round(found.low - 1, 4), round(found.high - 1, 4)) == (low, high)


def test_what_was_sampled_more_does_not_count_more() -> None:
    """Half of the small stratum fails and was tried most; nearly all faults are in the other."""
    found = coverage([StratumCounts(450, 900, 100), StratumCounts(1, 100, 9900)])
    assert found.share == pytest.approx(1 - (0.5 * 100 + 0.01 * 9900) / 10_000)


def test_strata_without_a_failure_still_leave_a_doubt() -> None:
    """Less of it than one of them alone would: their errors are independent."""
    strata = [StratumCounts(0, 200, 1000)] * 4
    found, one = coverage(strata), coverage(strata[:1])
    assert found.share == 1.0 and found.interval.high == 1.0
    assert one.interval.low == pytest.approx(0.025 ** (1 / 200))
    assert 1 - found.interval.low == pytest.approx((1 - one.interval.low) / 2)


def test_a_stratum_that_was_not_sampled_can_hold_anything() -> None:
    sampled = [StratumCounts(2, 100, 3000)]
    known, all_of_it = extrapolated_sum(sampled), extrapolated_sum([*sampled, StratumCounts(0, 0, 1000)])
    assert all_of_it.failures is None
    assert all_of_it.interval == Interval(known.interval.low, known.interval.high + 1000)
    assert coverage([*sampled, StratumCounts(0, 0, 1000)]).share is None
    assert coverage([StratumCounts(0, 0, 1000)]) == Coverage(None, Interval(0.0, 1.0))
    assert coverage([]) == Coverage(None, Interval(0.0, 1.0))
    assert extrapolated_sum([]) == FailureCount(0.0, Interval(0.0, 0.0))


def test_distinct_faults_can_be_counted_on() -> None:
    """Of 1000 faults 990 were tried, 40 of them did harm: 40 to 50 do, whatever a binomial says."""
    found = extrapolated(40, 990, 1000, distinct=True)
    assert found.interval == Interval(40.0, 50.0)
    assert extrapolated(40, 990, 1000).interval.high > 50


@given(strata=STRATA, confidence=st.floats(0.5, 0.999), method=st.sampled_from(["clopper-pearson", "wilson"]))
def test_the_count_lies_within_its_interval_and_that_within_the_fault_space(
    strata: list[StratumCounts], confidence: float, method: str
) -> None:
    population = sum(stratum.population for stratum in strata)
    count, share = extrapolated_sum(strata, confidence, method), coverage(strata, confidence, method)
    tiny = 1e-9 * population
    assert 0 <= count.interval.low <= count.interval.high <= population
    assert 0 <= share.interval.low <= share.interval.high <= 1
    assert (count.failures is None) == (share.share is None) == any(s.sampled == 0 for s in strata)
    if count.failures is not None:
        assert count.interval.low - tiny <= count.failures <= count.interval.high + tiny


@given(strata=STRATA)
def test_what_does_harm_and_what_does_not_are_mirror_images(strata: list[StratumCounts]) -> None:
    population = sum(stratum.population for stratum in strata)
    harmless = [StratumCounts(s.sampled - s.failures, s.sampled, s.population) for s in strata]
    harm, none = extrapolated_sum(strata).interval, extrapolated_sum(harmless).interval
    assert harm.low == pytest.approx(population - none.high, abs=1e-6 * population)
    assert harm.high == pytest.approx(population - none.low, abs=1e-6 * population)


@given(strata=STRATA, times=st.integers(2, 20))
def test_more_experiments_of_the_same_shares_make_it_narrower(
    strata: list[StratumCounts], times: int
) -> None:
    more = [StratumCounts(s.failures * times, s.sampled * times, s.population) for s in strata]
    wide, narrow = extrapolated_sum(strata).interval, extrapolated_sum(more).interval
    assert narrow.low >= wide.low - 1e-6 and narrow.high <= wide.high + 1e-6


@pytest.mark.parametrize(
    "shares",
    [(0.001, 0.02, 0.3), (0.0005, 0.0005, 0.9), (0.2, 0.5, 0.05), (0.02, 0.0, 0.02)],
)
def test_simulated_campaigns_over_a_known_fault_space_are_held(shares: tuple[float, float, float]) -> None:
    chance, sizes, populations = Random(SEED), (300, 100, 60), (60_000, 9000, 1000)
    truth = 1 - sum(s * p for s, p in zip(shares, populations, strict=True)) / sum(populations)
    held = 0
    for _ in range(400):
        failed = [sum(chance.random() < s for _ in range(n)) for s, n in zip(shares, sizes, strict=True)]
        found = coverage([StratumCounts(*drawn) for drawn in zip(failed, sizes, populations, strict=True)])
        held += found.interval.low <= truth <= found.interval.high
    assert held / 400 >= 0.95


def test_what_is_asked_for_wrongly_is_named() -> None:
    with pytest.raises(ConfigError, match=r"^confidence 95: more than 0 and less than 1 is allowed"):
        extrapolated(1, 2, 3, confidence=95)
    with pytest.raises(
        ConfigError, match=r"^unknown interval method 'normal' \(one of: clopper-pearson, wilson\)"
    ):
        coverage([StratumCounts(1, 2, 3)], method="normal")

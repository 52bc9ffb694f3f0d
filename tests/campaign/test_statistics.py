"""Intervals: against what is published, and against what they promise: to hold the truth often enough."""

import math
import subprocess
import sys
import time
from random import Random
from typing import Final

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import special

from aftbed.campaign.statistics import (
    Interval,
    half_width,
    look_confidence,
    proportion,
    quantile,
    quantile_interval,
    quantile_needs,
)
from aftbed.core.errors import ConfigError

CONFIDENCES: Final = st.floats(0.5, 0.999)
COUNTS: Final = st.integers(0, 5000).flatmap(lambda of: st.tuples(st.integers(0, of), st.just(of)))
SEED: Final = 20260
TINY: Final = 1e-9


# --- shares -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("count", "of", "low", "high"),
    [  # Newcombe, Statistics in Medicine 17 (1998) 857-872, table I, method 5: Clopper-Pearson
        (81, 263, 0.2527, 0.3676),
        (15, 148, 0.0578, 0.1617),
        (0, 20, 0.0, 0.1684),
        (1, 29, 0.0009, 0.1776),
    ],
)
def test_clopper_pearson_is_that_of_newcombe(count: int, of: int, low: float, high: float) -> None:
    found = proportion(count, of)
    assert (round(found.low, 4), round(found.high, 4)) == (low, high)


@pytest.mark.parametrize(
    ("count", "of", "confidence", "low", "high"),
    [  # printed by R's binom.test; the first is of its manual (Conover 1971, p. 97)
        (682, 925, 0.95, 0.7076683, 0.7654066),
        (9, 24, 0.95, 0.1879929, 0.5940636),
        (542, 3611, 0.90, 0.1403939, 0.1602214),
        (1, 1497, 0.90, 3.426347e-05, 3.164954e-03),
    ],
)
def test_clopper_pearson_is_that_of_r(
    count: int, of: int, confidence: float, low: float, high: float
) -> None:
    found = proportion(count, of, confidence)
    assert (found.low, found.high) == pytest.approx((low, high), rel=1e-6)


def test_no_failure_at_all_is_no_proof_that_there_is_none() -> None:
    """The closed form is 1 - (alpha/2)^(1/n). Wald's interval would have no width."""
    assert proportion(0, 1000).low == 0
    assert proportion(0, 1000).high == pytest.approx(1 - 0.025**0.001)


def test_of_no_experiment_nothing_is_known() -> None:
    assert proportion(0, 0) == Interval(0.0, 1.0)


@given(counts=COUNTS, confidence=CONFIDENCES)
def test_the_interval_is_of_shares_and_holds_the_estimate(counts: tuple[int, int], confidence: float) -> None:
    count, of = counts
    found = proportion(count, of, confidence)
    assert 0 <= found.low <= found.high <= 1
    if of:
        assert found.low <= count / of + TINY and count / of - TINY <= found.high
    assert (found.low == 0) >= (count == 0) and (found.high == 1) >= (count == of)


@given(counts=COUNTS, confidence=CONFIDENCES)
def test_what_fails_and_what_does_not_are_mirror_images(counts: tuple[int, int], confidence: float) -> None:
    count, of = counts
    fails, holds = (proportion(k, of, confidence) for k in (count, of - count))
    assert fails.low == pytest.approx(1 - holds.high, abs=TINY)
    assert fails.high == pytest.approx(1 - holds.low, abs=TINY)


@given(counts=COUNTS, times=st.integers(2, 20), confidence=CONFIDENCES)
def test_more_experiments_of_the_same_share_make_it_narrower(
    counts: tuple[int, int], times: int, confidence: float
) -> None:
    count, of = counts
    wide, narrow = (proportion(count * k, of * k, confidence) for k in (1, times))
    assert half_width(narrow) < half_width(wide) or of == 0


@given(counts=COUNTS.filter(lambda counts: counts[1] > 0))
def test_more_confidence_makes_it_wider(counts: tuple[int, int]) -> None:
    widths = [half_width(proportion(*counts, c)) for c in (0.5, 0.9, 0.95, 0.99, 0.999)]
    assert widths == sorted(widths)


def held(of: int, share: float) -> float:
    """The probability that the interval of `of` experiments holds `share`, of all counts there can be."""
    below = [float(special.bdtr(count, of, share)) for count in range(of + 1)]
    masses = [after - before for before, after in zip([0.0, *below], below, strict=False)]
    intervals = [proportion(count, of) for count in range(of + 1)]
    return math.fsum(m for m, i in zip(masses, intervals, strict=True) if i.low <= share <= i.high)


@pytest.mark.parametrize("of", [5, 30, pytest.param(200, marks=pytest.mark.deep)])
def test_clopper_pearson_holds_its_confidence_for_every_share(of: int) -> None:
    assert min(held(of, step / 500) for step in range(1, 500)) >= 0.95


@pytest.mark.parametrize(("share", "of"), [(0.001, 400), (0.02, 150), (0.5, 40), (0.97, 300)])
def test_simulated_campaigns_of_a_known_share_are_held(share: float, of: int) -> None:
    chance = Random(SEED)
    campaigns = [sum(chance.random() < share for _ in range(of)) for _ in range(1000)]
    found = [proportion(count, of) for count in campaigns]
    assert sum(i.low <= share <= i.high for i in found) / len(found) >= 0.95


# --- looks --------------------------------------------------------------------------------------------------


def test_one_look_costs_nothing_and_five_share_the_error() -> None:
    assert look_confidence(0.95, 1) == pytest.approx(0.95)
    assert look_confidence(0.95, 5) == pytest.approx(0.99)
    assert look_confidence(0.99, 20) == pytest.approx(0.9995)


def test_who_looks_five_times_is_wrong_too_often_unless_he_said_so_before() -> None:
    """The worst stop rule there is: stop at the first look whose interval leaves the truth out."""
    chance, truth, looks = Random(SEED), 0.3, (100, 200, 300, 400, 500)
    wrong = {0.95: 0, look_confidence(0.95, 5): 0}
    for _ in range(1000):
        failed = [chance.random() < truth for _ in range(looks[-1])]
        for confidence in wrong:
            found = (proportion(sum(failed[:of]), of, confidence) for of in looks)
            wrong[confidence] += any(not i.low <= truth <= i.high for i in found)
    undeclared, declared = wrong.values()
    assert undeclared > 100 and declared <= 50


# --- quantiles ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "low", "high"),
    [  # a table of textbooks: confidence intervals of the median by ranks, at 95 % or the next above
        (6, 1, 6),
        (8, 1, 8),
        (9, 2, 8),
        (10, 2, 9),
        (12, 3, 10),
        (15, 4, 12),
        (17, 5, 13),
        (20, 6, 15),
    ],
)
def test_the_interval_of_a_median_has_the_ranks_of_the_tables(size: int, low: int, high: int) -> None:
    ranks = range_of(size)
    Random(SEED).shuffle(ranks)
    assert quantile_interval(ranks, 0.5) == Interval(low, high)


@pytest.mark.parametrize(
    ("q", "least"), [(0.5, 6), (0.9, 36), (0.95, 72), (0.99, 368), (0.999, 3688), (0.01, 368)]
)
def test_too_few_values_bound_no_quantile(q: float, least: int) -> None:
    """0.99^367 is still more than 0.025: all of 367 values may well lie below the p99."""
    assert quantile_needs(q) == least
    values = [float(value) for value in range(least)]
    assert quantile_interval(values, q) is not None
    assert quantile_interval(values[1:], q) is None


@pytest.mark.parametrize("values", [[], [1.0]])
def test_of_nothing_or_one_value_there_is_no_interval(values: list[float]) -> None:
    assert quantile_interval(values, 0.5) is None


VALUES: Final = st.lists(st.floats(0, 1e6), min_size=1, max_size=400)


@given(values=VALUES, q=st.floats(0.01, 0.99), confidence=CONFIDENCES)
def test_the_interval_of_a_quantile_is_of_values_and_holds_the_estimate(
    values: list[float], q: float, confidence: float
) -> None:
    found = quantile_interval(values, q, confidence)
    assert (found is None) == (len(values) < quantile_needs(q, confidence))
    if found is not None:
        assert found.low <= quantile(values, q) <= found.high
        assert found.low in values and found.high in values


@given(size=st.integers(1, 3000), q=st.floats(0.01, 0.99), confidence=CONFIDENCES)
def test_each_bound_of_a_quantile_leaves_out_its_half_and_no_nearer_value_does(
    size: int, q: float, confidence: float
) -> None:
    found = quantile_interval(range_of(size), q, confidence)
    beyond = (1 - confidence) / 2
    if found is not None:
        low, high = int(found.low), int(found.high)
        assert special.bdtr(low - 1, size, q) <= beyond < special.bdtr(low, size, q)
        assert special.bdtrc(high - 1, size, q) <= beyond < special.bdtrc(high - 2, size, q)


def range_of(size: int) -> list[float]:
    return [float(rank) for rank in range(1, size + 1)]


@pytest.mark.parametrize(("q", "size"), [(0.5, 25), (0.9, 120), (0.99, 500)])
def test_simulated_times_of_two_modes_and_a_long_tail_are_held(q: float, size: int) -> None:
    """Nine of ten recoveries take 1 ms and a bit, one takes 5 ms and a log-normal more."""
    chance = Random(SEED)

    def recovery_ms() -> float:
        return 1 + chance.random() if chance.random() < 0.9 else 5 + chance.lognormvariate(0, 1.5)

    truth = quantile([recovery_ms() for _ in range(200_000)], q)
    held_by = 0
    for _ in range(400):
        found = quantile_interval([recovery_ms() for _ in range(size)], q)
        assert found is not None
        held_by += found.low <= truth <= found.high
    assert held_by / 400 >= 0.94


def test_ten_thousand_times_take_less_than_a_second() -> None:
    values = [Random(SEED).random() for _ in range(10_000)]
    start_s = time.process_time()
    assert quantile_interval(values, 0.99)
    assert time.process_time() - start_s < 1


# --- what the user may not ask for --------------------------------------------------------------------------


@pytest.mark.parametrize("confidence", [0.0, 1.0, 95.0, -0.1, math.nan])
def test_a_confidence_that_is_none_is_refused(confidence: float) -> None:
    said = f"confidence {confidence:g}: more than 0 and less than 1 is allowed, 0.95 is usual"
    for refused in (
        lambda: proportion(1, 2, confidence),
        lambda: look_confidence(confidence, 3),
        lambda: quantile_interval([1.0], 0.5, confidence),
        lambda: quantile_needs(0.5, confidence),
    ):
        with pytest.raises(ConfigError) as error:
            refused()
        assert str(error.value) == said


def test_what_is_asked_for_wrongly_is_named() -> None:
    for refused, said in (
        (lambda: look_confidence(0.95, 0), "looks 0: at least 1 is allowed"),
        (
            lambda: quantile_interval([1.0], 99),
            "quantile 99: more than 0 and less than 1 is allowed, 0.99 for p99",
        ),
    ):
        with pytest.raises(ConfigError) as error:
            refused()
        assert str(error.value) == said


def test_the_command_line_does_not_wait_for_scipy() -> None:
    code = "import sys, aftbed.cli.app; sys.exit(any(name in sys.modules for name in ('scipy', 'numpy')))"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=60).returncode == 0

"""Two campaigns of one plan, compared pair by pair."""

from math import comb
from pathlib import Path
from random import Random
from typing import Final

import msgspec
import pytest
from campaigns import planned, result
from hypothesis import given
from hypothesis import strategies as st

from aftbed.campaign.compare import compare, mcnemar, paired_quantile_shift
from aftbed.campaign.ledger import Ledger, head_of
from aftbed.campaign.statistics import quantile
from aftbed.core.errors import ConfigError

SEED: Final = 20262
FEW: Final = 400  # resamples: enough for a test


@pytest.mark.parametrize(
    ("only_base", "only_new", "p"),
    [
        (2, 9, 0.06543),  # R package exact2x2, vignette of the exact McNemar test
        (86, 150, 3.716e-05),  # the same package: approval ratings of Agresti (1990), p. 350
        (12, 2, 0.0129),  # Armitage and Berry (1994), p. 127, by Liddell's exact test
        (1, 7, 0.070),  # Fagerland, Lydersen and Laake (2013): airway hyper-responsiveness
    ],
)
def test_mcnemar_is_what_is_published(only_base: int, only_new: int, p: float) -> None:
    assert mcnemar(only_base, only_new) == pytest.approx(p, rel=5e-3)


@given(only_base=st.integers(0, 200), only_new=st.integers(0, 200))
def test_mcnemar_is_a_fair_coin_and_has_no_side(only_base: int, only_new: int) -> None:
    fewer, all_of_them = min(only_base, only_new), only_base + only_new
    tail = sum(comb(all_of_them, heads) for heads in range(fewer + 1)) / 2**all_of_them
    assert mcnemar(only_base, only_new) == mcnemar(only_new, only_base) == pytest.approx(min(1.0, 2 * tail))


def test_pairs_that_agree_show_no_change() -> None:
    assert mcnemar(0, 0) == 1.0
    assert mcnemar(5, 5) == 1.0
    assert mcnemar(0, 6) == pytest.approx(2 / 64)


def drives(chance: Random, pairs: int) -> list[float]:
    """Recovery times that depend far more on the drive than on the mechanism."""
    return [chance.lognormvariate(0, 1) for _ in range(pairs)]


def test_a_shift_of_all_is_found_to_the_digit() -> None:
    base = drives(Random(SEED), 500)
    found = paired_quantile_shift(
        base, [time_ms + 0.25 for time_ms in base], 0.99, Random(SEED), resamples=FEW
    )
    assert found is not None
    assert found.low == pytest.approx(0.25) and found.high == pytest.approx(0.25)


def test_the_sign_says_which_is_slower() -> None:
    base = drives(Random(SEED), 500)
    slower = paired_quantile_shift(base, [2 * t for t in base], 0.9, Random(SEED), resamples=FEW)
    faster = paired_quantile_shift([2 * t for t in base], base, 0.9, Random(SEED), resamples=FEW)
    assert slower is not None and faster is not None
    assert slower.low > 0 > faster.high


def test_pairs_show_what_two_samples_would_hide() -> None:
    """5 % slower, of times that differ by powers of ten: seen only because each is compared with its own."""
    chance = Random(SEED)
    base = drives(chance, 400)
    new = [time_ms * 1.05 + chance.gauss(0, 0.001) for time_ms in base]
    found = paired_quantile_shift(base, new, 0.5, Random(SEED), resamples=FEW)
    chance.shuffle(new)
    unpaired = paired_quantile_shift(base, new, 0.5, Random(SEED), resamples=FEW)
    assert found is not None and unpaired is not None
    assert found.low > 0 and unpaired.low < 0 < unpaired.high


def test_the_tail_alone_can_be_worse() -> None:
    """One of fifty takes ten times as long as before: the median does not show it, the p99 does."""
    base = drives(Random(SEED), 2000)
    new = [time_ms * 10 if index % 50 == 0 else time_ms for index, time_ms in enumerate(base)]
    median = paired_quantile_shift(base, new, 0.5, Random(SEED), resamples=FEW)
    p99 = paired_quantile_shift(base, new, 0.99, Random(SEED), resamples=FEW)
    assert median is not None and p99 is not None
    assert median.low <= 0.02 and p99.low > 1


@pytest.mark.deep
@pytest.mark.parametrize("q", [0.5, 0.9])
def test_simulated_pairs_of_a_known_shift_are_held(q: float) -> None:
    chance = Random(SEED)

    def pair() -> tuple[float, float]:
        drive = chance.expovariate(1)
        return drive + chance.random(), 1.2 * drive + chance.random()

    many = [pair() for _ in range(100_000)]
    truth = quantile([new for _, new in many], q) - quantile([base for base, _ in many], q)
    held = 0
    for _ in range(300):
        base, new = zip(*(pair() for _ in range(120)), strict=True)
        found = paired_quantile_shift(base, new, q, chance, resamples=FEW)
        assert found is not None
        held += found.low <= truth <= found.high
    assert held / 300 >= 0.92


@given(
    base=st.lists(st.floats(0, 1e6), max_size=40),
    seed=st.integers(0, 2**32),
    q=st.floats(0.05, 0.95),
)
def test_the_seed_repeats_it_and_nothing_changed_is_no_shift(base: list[float], seed: int, q: float) -> None:
    found, again = (paired_quantile_shift(base, base[::-1], q, Random(seed), 0.9, 100) for _ in range(2))
    assert found == again
    same = paired_quantile_shift(base, base, q, Random(seed), 0.9, 100)
    assert same is None or (same.low, same.high) == (0.0, 0.0)


def test_too_few_pairs_bound_no_tail() -> None:
    times = drives(Random(SEED), 368)
    assert paired_quantile_shift(times[:367], times[:367], 0.99, Random(SEED), resamples=FEW) is None
    assert paired_quantile_shift(times, times, 0.99, Random(SEED), resamples=FEW) is not None
    assert paired_quantile_shift([], [], 0.5, Random(SEED)) is None


def test_what_is_asked_for_wrongly_is_named() -> None:
    times = [1.0] * 10
    with pytest.raises(
        ConfigError, match=r"^quantile 50: more than 0 and less than 1 is allowed, 0.99 for p99$"
    ):
        paired_quantile_shift(times, times, 50, Random(SEED))
    with pytest.raises(ConfigError, match=r"^resamples 10: at least 200 are allowed at confidence 0.95$"):
        paired_quantile_shift(times, times, 0.5, Random(SEED), resamples=10)
    with pytest.raises(AssertionError, match=r"^10 and 9 are no pairs"):
        paired_quantile_shift(times, times[1:], 0.5, Random(SEED))


def test_experiments_are_a_pair_wherever_the_files_of_their_function_lie(tmp_path: Path) -> None:
    head = head_of(planned(tmp_path))

    def in_folder(folder: str) -> Ledger:
        one = result()
        text = f"update app to {folder}/./brake.py:Brake at request 3"
        there = msgspec.structs.replace(
            one.experiment, app=f"{folder}/brake.py:Brake", scenario=f"{folder}/s.yaml", adaptations=(text,)
        )
        return Ledger(tmp_path, head, (msgspec.structs.replace(one, experiment=there),))

    found = compare(in_folder("/a"), in_folder("/b/c"))
    assert found.unpaired == 0 and found.same_outcomes


def test_a_campaign_of_many_strata_is_compared(tmp_path: Path) -> None:
    """Each stratum has a part of the confidence, and so the more resamples."""
    results = tuple(
        result(stratum=f"pbr · {n % 40}", index=n, recovery_ms=2.0 + n % 3) for n in range(40 * 3)
    )
    found = Ledger(tmp_path, head_of(planned(tmp_path)), results)
    assert [change.pairs for change in compare(found, found).changes] == [3] * 40

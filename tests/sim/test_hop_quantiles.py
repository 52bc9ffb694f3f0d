"""The measured distribution that the simulator draws its delays from is one."""

import itertools

from aftbed.runtime.latencies import HOP_QUANTILES_NS


def test_there_is_a_value_for_each_step_of_a_128th() -> None:
    assert len(HOP_QUANTILES_NS) == 129
    assert all(isinstance(delay_ns, int) and delay_ns > 0 for delay_ns in HOP_QUANTILES_NS)


def test_they_ascend() -> None:
    assert all(lower <= upper for lower, upper in itertools.pairwise(HOP_QUANTILES_NS))


def test_the_median_is_that_of_a_hop_between_processes() -> None:
    assert 1_000 <= HOP_QUANTILES_NS[64] <= 100_000

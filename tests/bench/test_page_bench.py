"""`aftbed bench page`: a page reads while it measures, and both sides are measured."""

import pytest

from aftbed.bench.page import bench_page

pytestmark = pytest.mark.process


def test_a_page_reads_while_the_cycle_is_measured() -> None:
    found = bench_page("pbr", "replica", 0.2, rounds=1)
    assert found.snapshots >= 1 and found.requests >= 1
    assert found.ratio.rounds == 1 and found.limit.name == "cycle without a page"
    assert found.cycle_us.p50 > 0

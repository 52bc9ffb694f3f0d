"""`aftbed bench simulator`: what it counts is the same from run to run, and the rate is that of the ratio."""

import gc
import sys

import pytest

from aftbed.bench.simulator import bench_simulator, calls_per_request
from aftbed.core.errors import ConfigError
from aftbed.runtime.sim.world import Setup


def test_calls_are_counted_and_the_profile_hook_is_as_before() -> None:
    hook = sys.getprofile()
    calls = calls_per_request(Setup("none"))
    assert sys.getprofile() is hook
    assert calls == calls_per_request(Setup("none"))
    assert 0 < calls < calls_per_request(Setup("pbr")), "a mechanism costs calls"


def test_what_the_garbage_collector_calls_is_not_counted() -> None:
    calls, collections = calls_per_request(Setup("none")), list[str]()

    def collected(phase: str, _: dict[str, int]) -> None:
        collections.append(phase)

    threshold = gc.get_threshold()
    gc.callbacks.append(collected)
    gc.set_threshold(10)
    try:
        assert calls_per_request(Setup("none")) == calls
    finally:
        gc.set_threshold(*threshold)
        gc.callbacks.remove(collected)
    assert collections and gc.isenabled()


def test_the_rate_is_that_of_the_median_round() -> None:
    found = bench_simulator("none", "process", 200, rounds=2)
    assert found.requests_per_s == round(1e6 / found.request_us.p50)
    assert found.ratio.rounds == 2
    assert found.limit.name == f"{found.calls:g} calls of an empty function"


def test_an_unknown_mechanism_is_refused() -> None:
    with pytest.raises(ConfigError, match="unknown FTM 'pbx'"):
        bench_simulator("pbx", "process", 200)

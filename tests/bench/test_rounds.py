"""A figure and its limit in turn: the order, the arithmetic of the ratio, and what a person reads.

No test depends on speed: the samples are made up.
"""

import os
from collections.abc import Sequence
from itertools import pairwise
from typing import Final

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.bench import cycle
from aftbed.bench import rounds as module
from aftbed.bench.rounds import (
    FAILURES_MAX,
    BesideLimit,
    InRounds,
    MachineWatch,
    Meanwhile,
    QuantileRatio,
    Ratio,
    as_node,
    beside_limit,
    cores,
    in_turn,
    shares,
    text,
    together,
)
from aftbed.bench.runs import Percentiles
from aftbed.core.errors import ConfigError, HarnessError

MACHINE: Final = Meanwhile(1.5, 0.25, 80.0, 1200.0, 0.5, None, None)
times = st.lists(st.floats(0.001, 1e6), min_size=1, max_size=30)


def values(count: int, step: float = 1.0) -> list[float]:
    """`step`, 2 `step`, ..."""
    return [step * number for number in range(1, count + 1)]


# -- the order


def test_figure_and_limit_alternate_in_short_rounds_and_each_is_first_in_turn() -> None:
    order: list[str] = []

    def figure(number: int) -> int:
        order.append(f"figure {number}")
        return 10 * number

    def limit(number: int) -> str:
        order.append(f"limit {number}")
        return str(number)

    found = in_turn(3, figure, limit)
    assert order == ["limit 0", "figure 0", "figure 1", "limit 1", "limit 2", "figure 2"]
    assert found.figures == [0, 10, 20] and found.limits == ["0", "1", "2"]
    assert found.machine.seconds >= 0


def test_a_measurement_that_fails_is_repeated_and_counted() -> None:
    """Only that one: a kill that a busy machine did not carry out costs no other round."""
    order: list[str] = []

    def figure(number: int) -> int:
        order.append(f"figure {number}")
        if order.count("figure 1") == 1 and number == 1:
            raise HarnessError("the machine is too busy")
        return number

    found = in_turn(2, figure, lambda number: order.append(f"limit {number}"))
    assert order == ["limit 0", "figure 0", "figure 1", "figure 1", "limit 1"]
    assert found.figures == [0, 1] and found.machine.failures == 1


def test_what_is_measured_together_is_repeated_together() -> None:
    begun: list[int] = []

    def both(number: int) -> tuple[int, str]:
        begun.append(number)
        if begun == [0, 1]:
            raise HarnessError("the machine is too busy")
        return 10 * number, str(number)

    shown: list[tuple[int, int]] = []
    found = together(3, both, lambda done, total: shown.append((done, total)))
    assert begun == [0, 1, 1, 2] and shown == [(0, 3), (1, 3), (2, 3), (3, 3)]
    assert (found.figures, found.limits, found.machine.failures) == ([0, 10, 20], ["0", "1", "2"], 1)


def test_a_bench_that_fails_again_and_again_ends_with_the_reason() -> None:
    tries: list[int] = []

    def figure(number: int) -> int:
        tries.append(number)
        raise ConfigError("the run ended")

    with pytest.raises(ConfigError, match="the run ended"):
        in_turn(11, figure, lambda number: number)
    assert tries == [0] * (FAILURES_MAX + 1)


@given(st.integers(1, 10_000), st.integers(1, 50))
def test_events_are_shared_out_evenly_and_no_round_is_empty(count: int, rounds: int) -> None:
    found = shares(count, rounds)
    assert sum(found) == count and len(found) == min(rounds, count)
    assert min(found) >= 1 and max(found) - min(found) <= 1


# -- the ratio


def test_the_ratio_is_to_the_median_of_the_limit_of_the_same_round() -> None:
    """The machine is ten times as slow in the second round, and the ratio does not see it."""
    found = beside_limit(
        "a limit", [values(100), values(100, 10.0)], [[1.0, 2.0, 900.0], [10.0, 20.0, 20.0]]
    ).ratio
    assert found.p50 == QuantileRatio(median=25.0, q1=25.0, q3=25.0, all=25.0)
    assert found.p99 == QuantileRatio(median=49.5, q1=49.5, q3=49.5, all=49.5)
    assert found.rounds == 2


def test_median_and_quartiles_are_over_the_rounds() -> None:
    """One disturbed round of eleven moves neither."""
    calm = beside_limit("a limit", [[float(n)] for n in range(1, 12)], [[1.0]] * 11).ratio
    assert (calm.p50.q1, calm.p50.median, calm.p50.q3) == (3.0, 6.0, 9.0)
    disturbed = beside_limit("a limit", [[float(n)] for n in range(1, 11)] + [[1e9]], [[1.0]] * 11).ratio
    assert (disturbed.p50.q1, disturbed.p50.median, disturbed.p50.q3) == (3.0, 6.0, 9.0)
    assert disturbed.p99.all == 1e9


def test_a_p99_that_no_round_supports_is_that_of_all_rounds() -> None:
    """Of 20 rounds of 10, the p99 of a round is its greatest; of all 200 it is the third greatest."""
    figures = [values(10) for _ in range(18)] + [[*values(9), 500.0], [*values(9), 700.0]]
    found = beside_limit("a limit", figures, [[1.0]] * 20).ratio
    assert found.p99.median == 10.0 and found.p99.all == 10.0
    figures[0][-1] = 600.0
    assert beside_limit("a limit", figures, [[1.0]] * 20).ratio.p99.all == 500.0


def test_the_limit_has_its_name_and_is_that_of_all_rounds() -> None:
    found = beside_limit("memcpy", [[5.0], [5.0]], [[1.04, 2.0], [3.0, 4.06]], 1)
    assert msgspec.to_builtins(found.limit) == {
        "p50": 2.0,
        "p95": 4.1,
        "p99": 4.1,
        "max": 4.1,
        "name": "memcpy",
    }


@given(st.lists(st.tuples(times, times), min_size=1, max_size=12), st.floats(0.01, 100))
def test_a_machine_of_another_speed_has_the_same_ratio(
    measured: Sequence[tuple[list[float], list[float]]], slower: float
) -> None:
    figures, limits = [one for one, _ in measured], [other for _, other in measured]
    here = beside_limit("a limit", figures, limits).ratio
    there = beside_limit(
        "a limit",
        [[slower * v for v in one] for one in figures],
        [[slower * v for v in one] for one in limits],
    ).ratio
    for one, other in ((here.p50, there.p50), (here.p99, there.p99)):
        assert msgspec.structs.astuple(one) == pytest.approx(
            msgspec.structs.astuple(other), rel=1e-6, abs=0.002
        )
        assert one.q1 <= one.median <= one.q3


@pytest.mark.parametrize(("figures", "limits"), [([[1.0], []], [[1.0], [1.0]]), ([[1.0]] * 2, [[1.0], []])])
def test_a_round_that_measured_nothing_is_named(
    figures: list[list[float]], limits: list[list[float]]
) -> None:
    with pytest.raises(HarnessError, match="a limit: nothing was measured in round 2 of 2"):
        beside_limit("a limit", figures, limits)


# -- as a node


def test_a_limit_runs_as_a_node_and_the_bench_as_before() -> None:
    cpus, policy = os.sched_getaffinity(0), os.sched_getscheduler(0)
    for cpu in (min(cpus), None):
        with as_node(cpu):
            assert os.sched_getscheduler(0) == os.SCHED_BATCH
            assert os.sched_getaffinity(0) == ({cpu} if cpu is not None else cpus)
        assert (os.sched_getaffinity(0), os.sched_getscheduler(0)) == (cpus, policy)
    assert cores(pin=False) == (None, None)
    assert cores(pin=True) == (tuple(sorted(cpus)[:2]) if len(cpus) > 1 else (None, None))


# -- the machine


def stat(idle: int, steal: int, switches: int) -> str:
    return f"cpu  100 0 50 {idle} 10 0 0 {steal} 7 7\ncpu0 1 2 3\nctxt {switches}\n"


def test_steal_is_a_share_of_the_time_of_all_cores(
    tmp_path: os.PathLike[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = module.Path(tmp_path) / "stat"
    monkeypatch.setattr(module, "_STAT", path)
    path.write_text(stat(1000, 20, 5))
    watch = MachineWatch()
    path.write_text(stat(1075, 45, 500))
    found = watch.found()
    assert (found.steal_percent, found.busy_percent) == (25.0, 25.0)
    assert found.switches_per_s is not None and found.switches_per_s > 0


def test_a_machine_that_shows_nothing_is_not_known(
    tmp_path: os.PathLike[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_STAT", module.Path(tmp_path) / "absent")
    monkeypatch.setattr(module, "frequencies_mhz", list)
    found = MachineWatch().found()
    assert (found.steal_percent, found.busy_percent, found.switches_per_s) == (None, None, None)
    assert (found.mhz_min, found.mhz_max) == (None, None)


def test_this_machine_is_watched() -> None:
    watch = MachineWatch()
    for _, _ in pairwise(range(3)):
        watch.look()
    found = watch.found()
    assert found.load >= 0
    assert (found.mhz_min is None) == (found.mhz_max is None)
    if found.mhz_min is not None and found.mhz_max is not None:
        assert 0 < found.mhz_min <= found.mhz_max


# -- for people


class Inner(BesideLimit, frozen=True):
    """A figure inside of a document."""

    help_ms: Percentiles


class Document(InRounds, frozen=True):
    """A made-up document."""

    ftm: str
    time_us: Percentiles
    parts: dict[str, Percentiles]
    requests: dict[str, int]
    help: Inner
    back: Percentiles | msgspec.UnsetType = msgspec.UNSET


def test_what_a_person_reads() -> None:
    beside = beside_limit("a ring", [[2.0], [3.0], [4.0]], [[1.0]] * 3, 1)
    one = Percentiles(1.0, 2.0, 3.0, 4.0)
    document = Document(
        "pbr",
        one,
        {"fencing": one},
        {"sent": 3, "lost": 0},
        Inner(one, limit=beside.limit, ratio=beside.ratio),
        limit=beside.limit,
        ratio=beside.ratio,
        machine=MACHINE,
    )
    limit = "a ring: p50 1.0  p95 1.0  p99 1.0  max 1.0"
    ratio = "p50 3 (2 to 4)  p99 3 (2 to 4)  of all rounds: p50 3  p99 4  rounds 3"
    shown = [line.split(maxsplit=1) for line in text(document)]
    assert shown == [
        ["ftm", "pbr"],
        ["time_us", "p50 1.0  p95 2.0  p99 3.0  max 4.0"],
        ["parts.fencing", "p50 1.0  p95 2.0  p99 3.0  max 4.0"],
        ["requests", "sent 3  lost 0"],
        ["help.help_ms", "p50 1.0  p95 2.0  p99 3.0  max 4.0"],
        ["help.limit", limit],
        ["help.ratio", ratio],
        ["limit", limit],
        ["ratio", ratio],
        [
            "machine",
            "seconds 1.5  steal_percent 0.25  busy_percent 80.0  switches_per_s 1200.0  load 0.5  failures 0",
        ],
    ]


def test_the_keys_of_a_document() -> None:
    beside = beside_limit("a ring", [[2.0]], [[1.0]])
    found = msgspec.to_builtins(beside)
    assert found["ratio"]["p50"] == {"median": 2.0, "q1": 2.0, "q3": 2.0, "all": 2.0}
    assert set(found["ratio"]) == {"p50", "p99", "rounds"}
    assert msgspec.convert(found["ratio"], Ratio) == beside.ratio
    assert set(msgspec.to_builtins(MACHINE)) == {
        "seconds",
        "steal_percent",
        "busy_percent",
        "switches_per_s",
        "load",
        "mhz_min",
        "mhz_max",
        "failures",
    }


def test_a_function_of_the_user_is_measured_in_turn_with_the_other_cycle(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It may take longer than a turn of two runs that live side by side."""
    begun: list[tuple[str, str, int]] = []

    def cycles_us(run: cycle.CycleRun, count: int) -> list[float]:
        begun.append((run.ftm, run.placement, count))
        return [40.0 if run.placement == "replica" else 100.0] * count

    monkeypatch.setattr(cycle.CycleRun, "cycles_us", cycles_us)
    ours = cycle.CycleRun("pbr", "replica", application="mine:Function")
    other = ours._replace(ftm="lfr", placement="process")
    found = cycle.bench_cycle_beside(ours, other, 5, rounds=2)
    assert sorted(begun[:2]) == [("lfr", "process", 3), ("pbr", "replica", 3)]
    assert sorted(begun[2:]) == [("lfr", "process", 2), ("pbr", "replica", 2)]
    assert begun[0][0] != begun[2][0], "the one that comes first alternates"
    assert (found.cycle_us.p50, found.limit.p50, found.ratio.p50.median) == (40.0, 100.0, 0.4)
    assert (found.limit.name, found.requests) == ("cycle under lfr, process", 5)

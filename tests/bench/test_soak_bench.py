"""`aftbed bench soak`: what it makes of the figures of a run, and one short run."""

import itertools
from random import Random
from typing import Final

import pytest
from homes import Home
from tales import Tale

from aftbed.bench import soak
from aftbed.bench.recovery import DEATH
from aftbed.bench.soak import Death, Quantity, SoakPlan, Trend, bench_soak, in_deaths, trend, with_trends
from aftbed.core.errors import ConfigError
from aftbed.core.events import FIRST_FAULT, Event
from aftbed.ftm.compose import DUPLEX_EXPRESSIONS
from aftbed.inject.model import FaultReport
from aftbed.inject.receipts import ReceiptState, record_detail

FIGURE: Final = Quantity("a figure", "MB", 1.0)
PLAN: Final = SoakPlan(30.0, 500.0, 2.0, 5.0, "process")


def measured(slope: float, count: int, noise: float = 0.5) -> Trend:
    """Of values every 30 s, of which one is far off."""
    chance = Random(7)
    times_ns = [3e10 * number for number in range(count)]
    values = [10 + slope * t_ns / 1e12 + chance.uniform(-noise, noise) for t_ns in times_ns]
    values[count // 2] += 400
    return trend(FIGURE, list(zip(times_ns, values, strict=True)))


@pytest.mark.parametrize(
    ("slope", "count", "finding"),
    [(0.0, 60, "flat"), (-9.0, 60, "flat"), (3.0, 60, "grows"), (0.0, 10, "unknown")],
)
def test_a_figure_is_flat_or_grows_with_confidence_or_it_is_not_known(
    slope: float, count: int, finding: str
) -> None:
    found = measured(slope, count)
    assert found.finding == finding
    assert found.low is not None and found.high is not None and found.low <= slope <= found.high


def test_too_few_values_have_no_slope() -> None:
    found = trend(FIGURE, [(number * 1e9, float(number)) for number in range(7)])
    assert (found.slope, found.finding) == (None, "unknown")


def crashes(slope: float, drift: float) -> Trend:
    """Of a run that takes longer by `slope` per 1000 s, on a machine that does by `drift`."""
    chance = Random(7)
    times_ns = [2 * 10**9 * number for number in range(400)]
    deaths = [Death(t_ns, (1 + drift * t_ns / 1e12) * chance.uniform(1.0, 2.0)) for t_ns in times_ns]
    taken_ms = [
        (t_ns + 10**6, (2 + slope * t_ns / 1e12) * (1 + drift * t_ns / 1e12) * chance.uniform(1.0, 2.0))
        for t_ns in times_ns
    ]
    return in_deaths("primary", soak.FAILOVER_BOUND, taken_ms, deaths)


@pytest.mark.parametrize(
    ("slope", "drift", "finding"),
    [(0.0, 0.0, "flat"), (0.0, 2.0, "flat"), (2.0, 0.0, "grows"), (2.0, 2.0, "grows")],
)
def test_a_machine_that_becomes_slower_is_not_a_failover_that_does(
    slope: float, drift: float, finding: str
) -> None:
    assert crashes(slope, drift).finding == finding


def test_a_death_that_takes_ten_times_as_long_is_not_the_unit_of_a_failover() -> None:
    chance = Random(7)
    deaths = [Death(2 * 10**9 * number, 2 * chance.lognormvariate(0, 1)) for number in range(900)]
    taken_ms = [(death.t_ns + 10**6, 12 * chance.uniform(0.7, 1.4)) for death in deaths[8::16]]
    assert in_deaths("client", soak.REPLACEMENT_BOUND, taken_ms, deaths).finding == "flat"


def test_a_fault_that_does_not_strike_leaves_the_strikes_of_others_theirs() -> None:
    reports = [
        FaultReport("crash client", ReceiptState.APPLIED),
        FaultReport("crash proxy", ReceiptState.NOT_ACTIVATED, number=1),
        FaultReport("crash proxy", ReceiptState.APPLIED, number=2),
        FaultReport("crash client", ReceiptState.APPLIED, number=3),
    ]
    tale = Tale()
    for number, ms in ((0, 10), (2, 6), (3, 20)):
        strike = record_detail(FIRST_FAULT + number)
        tale.note("supervisor.1", Event.FAULT_APPLIED, detail=strike).wait(ms - 5).served(number + 1)
    history = tale.history()
    assert [ms for _, ms in soak.replacements(history, reports, "client")] == [10, 20]
    assert [ms for _, ms in soak.replacements(history, reports, "proxy")] == [6]


def test_a_figure_that_grows_fails_a_run_that_was_served_right() -> None:
    flat, grows, unknown = (measured(*one) for one in ((0.0, 60), (3.0, 60), (0.0, 10)))
    assert with_trends("pass", [flat]) == ("pass", [])
    assert with_trends("pass", [flat, unknown])[0] == "inconclusive"
    assert with_trends("pass", [unknown, grows])[0] == "fail"
    assert with_trends("inconclusive", [flat]) == ("inconclusive", [])
    assert with_trends("fail", [unknown])[0] == "fail"


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        (SoakPlan(30.0, 500.0, 2.0, 5.0, "single"), "both replicas die with their node"),
        (SoakPlan(30.0, 500.0, 2.0, 5.0, "nowhere"), "unknown placement 'nowhere'"),
        (SoakPlan(30.0, 0.0, 2.0, 5.0, "process"), "--rate 0: 1 to 5000 requests a second are allowed"),
        (SoakPlan(0.0, 500.0, 0.0, 0.0, "process"), "--minutes 0: 0.05 to 3333 are allowed"),
        (SoakPlan(1.0, 500.0, 0.01, 5.0, "process"), "--crash-every 0.01: 0 .none., or 0.1 to 60 s"),
        (SoakPlan(1.0, 500.0, 2.0, 61.0, "process"), "--adapt-every 61: 0 .none., or 0.1 to 60 s"),
    ],
)
def test_what_cannot_be_run_is_refused_before(plan: SoakPlan, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        soak.check(plan)


def test_crashes_and_adaptations_begin_when_they_are_due() -> None:
    soak.check(PLAN)
    begun = list(itertools.islice(soak._agenda(PLAN, 100.0), 6))
    assert begun == [
        (102.0, "crash"),
        (104.0, "crash"),
        (105.0, "adapt"),
        (106.0, "crash"),
        (108.0, "crash"),
        (110.0, "crash"),
    ]
    calm = SoakPlan(30.0, 500.0, 0.0, 0.0, "process")
    assert list(itertools.islice(soak._agenda(calm, 0.0), 2)) == [(5.0, "sample"), (10.0, "sample")]


@pytest.mark.process
def test_a_short_run_serves_all_and_does_not_say_that_nothing_grows(home: Home) -> None:
    found = bench_soak(SoakPlan(0.1, 200.0, 0.5, 1.0, "process"), lambda _: None)
    assert found.judged == "pass", found.reasons
    assert (found.requests.sent, found.requests.lost) == (1200, 0)
    assert found.crashes["primary"] >= 1 and sum(found.crashes.values()) >= 2
    assert set(found.adaptations) <= set(DUPLEX_EXPRESSIONS) and found.adaptations
    assert [one.unit for one in found.trends if one.what.startswith("crash to next reply")] == ["x"] * 3
    assert found.death_ms is not None and any(DEATH in line for line in soak.text(found))
    assert found.verdict == "inconclusive" and any("too short to tell" in one for one in found.reasons)
    assert "verdict: inconclusive" in list(soak.text(found))


@pytest.mark.process
@pytest.mark.deep
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("placement", ["process", "replica"])
def test_nothing_grows(home: Home, placement: str) -> None:
    found = bench_soak(SoakPlan(15.0, 500.0, 2.0, 5.0, placement), print)
    assert found.judged == "pass", found.reasons
    assert not [one for one in found.trends if one.finding == "grows"]

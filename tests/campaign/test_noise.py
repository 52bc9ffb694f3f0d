"""What is said of a run on a machine that was too busy for times to mean anything."""

from types import SimpleNamespace

import pytest
from campaigns import result
from msgspec.structs import replace
from tales import Sums, Tale, good

from aftbed.campaign import experiment
from aftbed.campaign.experiment import QUIET_SECONDS, STALL_MS, Probe, by_waits, without_times
from aftbed.core.events import Event
from aftbed.judge.checks import Evidence
from aftbed.judge.intervals import STARVED_MS_MIN, starved
from aftbed.judge.record import RunRecord
from aftbed.judge.reference import reference_run
from aftbed.runtime.unix.options import LoadRun, RunOptions


@pytest.mark.parametrize(
    ("starved_ms", "seconds", "word"),
    [
        (STARVED_MS_MIN, 0.1, False),
        (STARVED_MS_MIN + 1, 0.1, True),
        (STARVED_MS_MIN + 1, 10.0, False),  # a long run waits more in all
        (501.0, 10.0, True),
    ],
)
def test_a_node_that_waits_long_for_a_cpu_makes_a_run_noisy(
    starved_ms: float, seconds: float, word: bool
) -> None:
    assert starved(starved_ms, seconds) is word


@pytest.mark.parametrize(
    ("outcome", "unexpected", "after"),
    [
        ("degraded", False, "inconclusive"),  # late
        ("hang", True, "inconclusive"),
        ("tolerated", True, "inconclusive"),  # a failover that was not expected: a false alarm
        ("tolerated", False, "tolerated"),
        ("masked", False, "masked"),
        ("sdc", True, "sdc"),  # no machine is so busy that it makes up a wrong value
        ("omission", True, "omission"),
    ],
)
def test_what_a_slow_machine_can_bring_about_is_inconclusive(
    outcome: str, unexpected: bool, after: str
) -> None:
    found = without_times(result(outcome, unexpected=unexpected, recovery_ms=70.0, blackout_ms=70.0))
    assert (found.outcome, found.noisy) == (after, True)
    assert found.unexpected is (unexpected and after == outcome)
    assert (found.recovery_ms, found.blackout_ms) == (None, None)


@pytest.mark.parametrize(
    ("ftm", "unexpected", "after"),
    [
        ("pbr+sup", True, "inconclusive"),  # its deadline passed
        ("pbr+sup", False, "detected_stop"),
        ("pbr+assert", True, "detected_stop"),
    ],
)
def test_supervision_may_take_a_busy_machine_for_a_slow_replica(
    ftm: str, unexpected: bool, after: str
) -> None:
    found = result("detected_stop", unexpected=unexpected)
    found = replace(found, experiment=replace(found.experiment, ftm=ftm))
    assert without_times(found).outcome == after


@pytest.mark.parametrize(
    ("outcome", "after"),
    [("unavailable", "inconclusive"), ("omission", "inconclusive"), ("sdc", "sdc"), ("masked", "masked")],
)
def test_a_fault_that_found_one_replica_because_of_a_busy_machine_is_inconclusive(
    outcome: str, after: str
) -> None:
    found = without_times(result(outcome, unexpected=outcome != "masked"), alone=True)
    assert (found.outcome, found.unexpected) == (after, outcome == after == "sdc")


def told(tale: Tale) -> Evidence:
    record = RunRecord(RunOptions("", "", "", "pbr", "process", 0, LoadRun(3, 0.0)), tale.history(), None)
    return Evidence(record, reference_run(record.history, Sums()))


@pytest.mark.parametrize(
    ("waited_ms", "unexpected", "alarmed", "word"),
    [
        (STALL_MS + 1, True, False, True),
        (STALL_MS + 1, False, False, False),  # the campaign may be about the loss of both
        (STALL_MS, True, False, False),  # no node waited: the mechanism is late
        (STALL_MS + 1, False, True, True),  # also an expected outcome may have come about by a false alarm
        (STALL_MS, False, True, False),
    ],
)
def test_a_fault_struck_one_replica_by_the_waits_of_a_busy_machine(
    waited_ms: float, unexpected: bool, alarmed: bool, word: bool
) -> None:
    tale = good().note("recovery.1", Event.RECOVERY_ENTER).note("b/server.1", Event.FAULT_APPLIED)
    if alarmed:
        tale = (
            Tale()
            .served(1)
            .note("b/watchdog.1", Event.WATCHDOG_SUSPECT)
            .note("a/server.1", Event.FAULT_APPLIED)
        )
    found = replace(result("unavailable", unexpected=unexpected), starved_ms=waited_ms)
    assert by_waits(found, told(tale)) is word


def test_a_probe_is_calibrated_by_the_machine_it_runs_on() -> None:
    assert Probe().quiet_ms < 1000


def test_a_machine_found_quiet_behind_an_experiment_is_not_measured_again_before_the_next(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    late_ms, now_s, taken = 0.1, 100.0, []

    def lateness_ms() -> float:
        taken.append(late_ms)
        return late_ms

    monkeypatch.setattr(experiment, "lateness_ms", lateness_ms)
    monkeypatch.setattr(experiment, "time", SimpleNamespace(monotonic=lambda: now_s))
    probe = Probe()
    assert not probe.noisy()
    late_ms, now_s = 1000.0, now_s + QUIET_SECONDS / 2
    assert not probe.noisy()
    assert len(taken) == 2  # the first of them when it was made
    now_s += QUIET_SECONDS
    assert probe.noisy()
    late_ms = 0.1
    assert not probe.noisy()  # one that was busy is measured again at once
    assert len(taken) == 4

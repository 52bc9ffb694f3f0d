"""An experiment is an outcome, whatever happens in it; what happens to its record is raised."""

import errno
from pathlib import Path

import msgspec
import pytest
from records import whole

from aftbed.campaign import experiment
from aftbed.campaign.experiment import (
    Experiment,
    Result,
    carry_out,
    forbidden_by,
    golden_drive,
    known_outcome,
)
from aftbed.campaign.plan import plan
from aftbed.campaign.spec import read_spec
from aftbed.judge.outcome import OUTCOMES
from aftbed.vehicle.plant import VehicleResult
from aftbed.vehicle.scenarios.library import load_scenario

CALM = Experiment("0" * 16, 0, 0, "s", 5, "pbr", "process", "sim", "", 20, 400.0, ())
DRIVE = msgspec.structs.replace(
    CALM, ftm="none", scenario="ccrs-50", faults=("crash primary at server.exit nth 60",)
)


def test_what_goes_wrong_in_keeping_is_raised() -> None:
    """Nothing may be told as done that is in no ledger."""

    def full(_: Result) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        carry_out(CALM, full)


def test_an_error_of_any_kind_is_an_outcome(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bug of ours in one experiment of ten thousand ends neither the campaign nor as a pass."""
    monkeypatch.setattr(experiment, "setup_of", lambda *_: 1 // 0)
    kept: list[Result] = []
    result = carry_out(CALM, kept.append)
    assert (result.outcome, result.activated) == ("harness_error", False)
    assert result.reasons[0].startswith("ZeroDivisionError: ")
    assert kept == [result]


@pytest.mark.parametrize(
    ("outcome", "known"),
    [
        ("masked", "inconclusive"),
        ("tolerated", "inconclusive"),
        ("degraded", "degraded"),
        ("omission", "inconclusive"),
        ("unavailable", "unavailable"),
        ("hang", "hang"),
        ("sdc", "sdc"),
    ],
)
def test_a_run_that_ends_without_redundancy_is_known_where_its_outcome_says_it(
    tmp_path: Path, outcome: str, known: str
) -> None:
    record = whole(tmp_path)
    assert record.end is not None
    record.end["unfinished"] = ["b/after is missing"]
    found, reasons = known_outcome(outcome, ("seen",), record.verdict())
    assert found == known
    assert reasons == (("seen",) if found == outcome else tuple(record.verdict().reasons))


def test_a_run_that_left_processes_behind_is_trouble_of_the_harness(tmp_path: Path) -> None:
    record = whole(tmp_path)
    assert record.end is not None
    record.end["reason"] = "killed"
    assert known_outcome("masked", (), record.verdict())[0] == "harness_error"


@pytest.mark.simulation
def test_a_drive_is_compared_with_the_golden_one() -> None:
    """A car that hits what the bare server stops for is at least `unavailable`."""
    golden = golden_drive("ccrs-50", CALM.seed)
    assert golden is not None and golden.stop_gap_m is not None and golden.stop_gap_m > 0
    hit = carry_out(DRIVE, lambda _: None)
    assert hit.collision and hit.golden_gap_m == golden.stop_gap_m
    assert OUTCOMES.index(hit.outcome) >= OUTCOMES.index("unavailable")
    calm = carry_out(msgspec.structs.replace(DRIVE, ftm="pbr"), lambda _: None)
    assert not calm.collision and calm.gap_m == pytest.approx(golden.stop_gap_m, abs=0.05)


GHOST = "radar ghost range 30 speed 22 after 1s for {ms}ms"


@pytest.mark.simulation
@pytest.mark.parametrize(("ms", "outcome"), [(40, "masked"), (60, "unavailable")])
def test_what_a_scenario_forbids_is_no_service_either(ms: int, outcome: str) -> None:
    """A car that brakes for nothing hits nothing; but `aftbed sim` fails such a drive."""
    ghost = msgspec.structs.replace(DRIVE, scenario="free-drive", faults=(GHOST.format(ms=ms),))
    found = carry_out(ghost, lambda _: None)
    assert (found.outcome, found.collision, found.activated) == (outcome, False, True)
    assert found.reasons == (() if ms == 40 else ("the car braked, expected no_braking",))


def test_what_the_golden_drive_does_too_is_no_fault_of_the_faults() -> None:
    scenario = load_scenario("ccrs-50")
    golden = VehicleResult(False, None, 0.4, 0.4, 9.0, True)
    assert forbidden_by(scenario, golden, golden) == []
    hit = msgspec.structs.replace(golden, collision=True, impact_speed_kmh=7.25, stop_gap_m=None)
    assert forbidden_by(scenario, hit, golden) == ["collision at 7.2 km/h, expected stop"]
    assert forbidden_by(scenario, hit, hit) == []


@pytest.mark.simulation
@pytest.mark.parametrize("name", ["radar", "radar-ghost"])
def test_the_campaigns_of_the_radar_come_to_what_they_expect(name: str) -> None:
    """The first drive of each stratum, without a mechanism: none of them changes what the radar reports."""
    found = plan(read_spec(name))
    first = [one for one in found.experiments() if one.ftm == "none" and one.number == 0]
    assert len(first) > 5
    for one in first:
        result = carry_out(msgspec.structs.replace(one, runtime="sim"), lambda _: None)
        assert result.activated and not result.unexpected, (one.stratum, one.faults, result.outcome)

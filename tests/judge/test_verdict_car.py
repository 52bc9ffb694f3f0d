"""The verdict over a drive: whether the car did what its scenario expects."""

from pathlib import Path

import msgspec
import pytest
from records import CAR, STOPPED, RecordInTheMaking, whole

from aftbed.runtime.unix.options import ReplayRun
from aftbed.vehicle.plant import VehicleResult


def drive(path: Path, result: VehicleResult | None, end: str = "stopped itself") -> RecordInTheMaking:
    record = whole(path, CAR)
    assert record.end is not None
    if result is not None:
        record.end["result"] = {"end": end, "result": msgspec.to_builtins(result)}
    return record


def test_a_car_that_does_what_the_scenario_expects_passes(path: Path) -> None:
    verdict = drive(path, STOPPED).verdict()
    assert (verdict.verdict, verdict.checks["vehicle"], verdict.scenario) == ("pass", "pass", "ccrs-50")
    assert verdict.vehicle == STOPPED


@pytest.mark.parametrize(
    ("result", "reason"),
    [
        (VehicleResult(True, 31.0, 0.0, None, 9.0, True), "vehicle: collision at 31.0 km/h, expected stop"),
        (VehicleResult(False, None, 5.0, None, 4.0, True), "vehicle: the car did not stop, expected stop"),
        (
            VehicleResult(False, None, 0.2, 0.2, 9.0, True),
            "vehicle: stopped at 0.20 m, at least 0.50 m expected",
        ),
    ],
)
def test_a_car_that_does_not_fails(path: Path, result: VehicleResult, reason: str) -> None:
    verdict = drive(path, result).verdict()
    assert verdict.verdict == "fail" and verdict.reasons == [reason]


def test_a_car_that_did_not_report_is_inconclusive(path: Path) -> None:
    verdict = drive(path, None).verdict()
    assert verdict.verdict == "inconclusive" and verdict.vehicle is None
    assert verdict.reasons == ["vehicle: the car did not report"]


def test_a_drive_that_was_broken_off_is_judged_by_what_it_did(path: Path) -> None:
    under_way = VehicleResult(False, None, 20.0, None, 0.0, False)
    assert drive(path / "1", under_way, end="stopped").verdict().verdict == "pass"
    hit = VehicleResult(True, 31.0, 0.0, None, 9.0, True)
    assert drive(path / "2", hit, end="stopped").verdict().verdict == "fail"


def test_a_replay_gives_its_figures_and_needs_no_car(path: Path) -> None:
    record = whole(path, ReplayRun("drive.log", "radar.dbc", "toyota", None))
    assert record.end is not None
    record.end["result"] = {"played": 5}
    verdict = record.verdict()
    assert (verdict.scenario, verdict.replay, verdict.vehicle) == ("replay drive.log", {"played": 5}, None)
    assert verdict.verdict == "pass" and "vehicle" not in verdict.checks

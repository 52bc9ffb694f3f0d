"""The verdict over a drive: whether the car did what its scenario expects."""

from pathlib import Path
from typing import Final

import msgspec
import pytest
from records import CAR, STOPPED, RecordInTheMaking, whole

from aftbed.runtime.unix.options import CarRun, ReplayRun
from aftbed.vehicle.plant import VehicleResult


def drive(path: Path, result: VehicleResult | None, end: str = "standstill") -> RecordInTheMaking:
    record = whole(path, CAR)
    assert record.end is not None
    if result is not None:
        record.end["result"] = {"end": end, "t_us": 4_000_000, "result": msgspec.to_builtins(result)}
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


HIT: Final = VehicleResult(True, 31.0, 0.0, None, 9.0, True)


@pytest.mark.parametrize(("pace", "told"), [(None, False), (1.0, False), (4.0, True)])
def test_replies_that_came_late_for_the_pace_are_told_and_excuse_nothing(
    path: Path, pace: float | None, told: bool
) -> None:
    """40 ms by the clock are 160 ms on the road at pace 4; the brake ECU holds a request for 60 ms."""
    record = whole(path, CarRun("ccrs-50", pace, "latch"))
    record.request(late_ms=40)
    assert record.end is not None
    record.end["result"] = {"end": "collision", "t_us": 4_000_000, "result": msgspec.to_builtins(HIT)}
    verdict = record.verdict()
    assert (verdict.verdict, verdict.requests.late) == ("fail", int(told))
    assert verdict.reasons[0] == "vehicle: collision at 31.0 km/h, expected stop"
    assert verdict.reasons[1:] == told * [
        "vehicle: 1 replies came more than 60 ms of bus time after their requests, the latest after 0.17 s:"
        " is this machine too slow or too busy for this pace?"
    ]


def test_a_car_that_did_not_report_is_inconclusive(path: Path) -> None:
    verdict = drive(path, None).verdict()
    assert verdict.verdict == "inconclusive" and verdict.vehicle is None
    assert verdict.reasons == ["vehicle: the car did not report"]


def test_a_drive_that_was_broken_off_is_judged_by_what_it_did(path: Path) -> None:
    under_way = VehicleResult(False, None, 20.0, None, 0.0, False)
    for number, (result, word) in enumerate(((under_way, "pass"), (HIT, "fail"))):
        record = drive(path / str(number), result, end="stopped")
        assert record.end is not None
        record.end["reason"] = "interrupted"
        assert record.verdict().verdict == word


def test_a_replay_gives_its_figures_and_needs_no_car(path: Path) -> None:
    record = whole(path, ReplayRun("drive.log", "radar.dbc", "toyota", None))
    assert record.end is not None
    record.end["result"] = whole_log = {"played": {"complete": True}}
    verdict = record.verdict()
    assert (verdict.scenario, verdict.replay, verdict.vehicle) == ("replay drive.log", whole_log, None)
    record.end["result"] = {"played": {"complete": False}}
    assert record.verdict().reasons == ["complete: the log was not replayed to its end"]
    assert verdict.verdict == "pass" and "vehicle" not in verdict.checks

"""The vehicle process on a real bus: the same drive twice, a dead function, pace, stop, a lost hub."""

import threading
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import msgspec
import pytest
from busharness import TestGateway, brake_late, running_hub
from buslog import read_log

from aftbed.core.errors import HarnessError
from aftbed.vehicle.can import bus as bus_module
from aftbed.vehicle.can.dbc_file import Codec, load_dbc
from aftbed.vehicle.can.hub import HubOptions
from aftbed.vehicle.drive_real import CarBuses, DriveOptions, DriveReport, drive
from aftbed.vehicle.plant import Telemetry
from aftbed.vehicle.scenarios.library import load_scenario
from aftbed.vehicle.scenarios.scenario import Scenario

pytestmark = pytest.mark.process

Decide = Callable[[dict[str, float]], tuple[int, float] | None]


@pytest.fixture(scope="module")
def codec() -> Codec:
    return load_dbc()


@pytest.fixture(scope="module")
def ccrs() -> Scenario:
    return load_scenario("ccrs-50")


def never() -> bool:
    return False


def run(
    log: Path,
    codec: Codec,
    scenario: Scenario,
    options: DriveOptions,
    decide: Decide = brake_late,
    stop: Callable[[], bool] = never,
    report: Callable[[Telemetry], None] = lambda _: None,
) -> DriveReport:
    lockstep = options.pace is None
    with (
        running_hub(log, HubOptions(lockstep=lockstep, pace=options.pace or 1.0)) as hub,
        TestGateway(hub.options, codec, decide),
        closing(CarBuses(hub.options)) as buses,
    ):
        return drive(scenario, codec, buses, options, report=report, stop=stop)


def test_the_same_seed_gives_the_same_log_byte_for_byte(tmp_path: Path, codec: Codec, ccrs: Scenario) -> None:
    logs = [tmp_path / f"{n}.log" for n in range(3)]
    lockstep = DriveOptions(pace=None, seed=7)
    first = run(logs[0], codec, ccrs, lockstep)
    second = run(logs[1], codec, ccrs, lockstep)
    other = run(logs[2], codec, ccrs, DriveOptions(pace=None, seed=8))
    assert logs[0].read_bytes() == logs[1].read_bytes() != logs[2].read_bytes()
    assert first == second
    assert (first.end, first.result.collision, first.missing_answers) == ("standstill", False, 0)
    assert first.result.stop_gap_m is not None
    assert first.tracks == first.answers
    assert other.end == "standstill"


def test_every_frame_of_a_lockstep_drive_stands_at_its_time(
    tmp_path: Path, codec: Codec, ccrs: Scenario
) -> None:
    log = tmp_path / "bus.log"
    report = run(log, codec, ccrs, DriveOptions(pace=None))
    frames = [entry.frame for entry in read_log(log)[0]]
    stamps: dict[int, list[int]] = {}
    for frame in frames:
        stamps.setdefault(frame.can_id, []).append(frame.t_us)
    assert stamps[0x110] == stamps[0x120] == list(range(0, report.t_us, 10_000))
    assert stamps[0x130] == stamps[0x100] == list(range(0, report.t_us, 20_000))
    assert stamps[0x131] == list(range(5_000, report.t_us, 100_000))
    batch = [frame.can_id for frame in frames if frame.t_us == 40_000]  # the third answer has a heartbeat
    assert batch == [0x110, 0x120, 0x130, 0x701, 0x100]


def test_a_dead_function_does_not_hang_the_drive(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, codec: Codec, ccrs: Scenario
) -> None:
    monkeypatch.setattr(bus_module, "FIRST_ANSWER_S_MAX", 1.0)
    monkeypatch.setattr(bus_module, "NEXT_ANSWER_S_MAX", 0.0005)
    asked = 0

    def dies(track: dict[str, float]) -> tuple[int, float] | None:
        nonlocal asked
        asked += 1
        return None if asked > 50 else (0, 0.0)

    report = run(tmp_path / "bus.log", codec, ccrs, DriveOptions(pace=None), dies)
    assert (report.end, report.result.collision, report.result.braked) == ("collision", True, False)
    assert (report.answers, report.missing_answers) == (50, report.tracks - 50)


def test_missing_answers_are_counted_and_waited_out(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, codec: Codec, ccrs: Scenario
) -> None:
    monkeypatch.setattr(bus_module, "FIRST_ANSWER_S_MAX", 1.0)
    monkeypatch.setattr(bus_module, "NEXT_ANSWER_S_MAX", 0.3)
    asked = 0

    def stumbles(track: dict[str, float]) -> tuple[int, float] | None:
        nonlocal asked
        asked += 1
        return None if asked in (20, 21, 60) else brake_late(track)

    report = run(tmp_path / "bus.log", codec, ccrs, DriveOptions(pace=None), stumbles)
    assert (report.end, report.result.collision) == ("standstill", False)
    assert (report.missing_answers, report.answers) == (3, report.tracks - 3)


def test_a_short_scenario_ends_in_time(tmp_path: Path, codec: Codec, ccrs: Scenario) -> None:
    seen: list[Telemetry] = []
    short = msgspec.structs.replace(ccrs, duration_ms=200)
    report = run(tmp_path / "bus.log", codec, short, DriveOptions(pace=None), report=seen.append)
    assert (report.end, report.t_us, report.tracks) == ("duration", 200_000, 10)
    assert [telemetry.t_ms for telemetry in seen] == [0, 50, 100, 150, 200]
    assert seen[-1].frames_accepted > 0


def test_pace_4_is_faster_than_pace_1_and_drives_the_same_road(
    tmp_path: Path, codec: Codec, ccrs: Scenario
) -> None:
    short = msgspec.structs.replace(ccrs, duration_ms=1000)
    walls_s, gaps_m = [], []
    for pace in (1.0, 4.0):
        before_s = time.monotonic()
        report = run(tmp_path / f"{pace}.log", codec, short, DriveOptions(pace=pace))
        walls_s.append(time.monotonic() - before_s)
        gaps_m.append(report.result.min_gap_m)
        assert (report.end, report.t_us, report.tracks) == ("duration", 1_000_000, 50)
    assert walls_s[0] >= 1.0
    assert 0.25 <= walls_s[1] < walls_s[0]
    assert gaps_m[0] == gaps_m[1]


def test_a_drive_at_a_pace_no_machine_holds_skips_nothing(
    tmp_path: Path, codec: Codec, ccrs: Scenario
) -> None:
    report = run(tmp_path / "bus.log", codec, ccrs, DriveOptions(pace=10_000.0), lambda _: (0, 0.0))
    assert report.end == "collision"
    frames = [entry.frame for entry in read_log(tmp_path / "bus.log")[0]]
    assert sum(frame.can_id == 0x110 for frame in frames) == -(-report.t_us // 10_000)
    assert report.lag_ms_max > 0


@pytest.mark.parametrize("pace", [None, 1.0])
def test_a_drive_can_be_stopped_with_what_it_has_come_to(
    pace: float | None, tmp_path: Path, codec: Codec, ccrs: Scenario
) -> None:
    over = threading.Event()

    def at_100_ms(telemetry: Telemetry) -> None:
        if telemetry.t_ms >= 100:
            over.set()

    options = DriveOptions(pace=pace)
    report = run(tmp_path / "bus.log", codec, ccrs, options, stop=over.is_set, report=at_100_ms)
    assert report.end == "stopped"
    assert 100_000 <= report.t_us <= 102_000
    assert report.result.min_gap_m is not None


@pytest.mark.parametrize("pace", [None, 1.0])
def test_a_lost_hub_ends_the_drive(pace: float | None, tmp_path: Path, codec: Codec, ccrs: Scenario) -> None:
    with (
        running_hub(tmp_path / "bus.log", HubOptions(lockstep=pace is None)) as hub,
        TestGateway(hub.options, codec, brake_late),
        closing(CarBuses(hub.options)) as buses,
    ):

        def at_100_ms(telemetry: Telemetry) -> None:
            if telemetry.t_ms == 100:
                hub.stop()

        with pytest.raises(HarnessError):
            drive(ccrs, codec, buses, DriveOptions(pace=pace), report=at_100_ms, stop=never)

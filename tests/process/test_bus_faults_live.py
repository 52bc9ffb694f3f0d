"""Faults of the bus and the radar in whole runs, armed before the drive or from a second command."""

import re
from pathlib import Path
from typing import Final

import pytest
from buslog import read_log
from liveruns import SHORT, Command, Home, Started, aftbed

from aftbed.campaign.states import RunState, states_of
from aftbed.inject.model import FaultReport
from aftbed.inject.receipts import BusTimes, ReceiptState
from aftbed.judge.intervals import Reaction
from aftbed.judge.record import read_record
from aftbed.runtime.unix.options import CarRun

pytestmark = pytest.mark.process

DRIVE: Final = ("--scenario", SHORT, "--pace", "max", "--json")
AEB_REQ_ID: Final = 0x100


def test_a_drive_is_disturbed_and_the_receipt_says_how(tmp_path: Path) -> None:
    """In lockstep, so it is one frame of one cycle, and the same one whenever it is run again."""
    words, logs = "corrupt bus RADAR_TRACK bit 21 nth 50", []
    for number in range(2):
        record = tmp_path / str(number)
        done = aftbed("run", *DRIVE, "--inject", words, "--ftti", "30ms", "--record", record)
        assert done.code == 0, done.out + done.err
        detail = "1 frame, at 0.980000 s, id 130; noticed by gateway (checksum)"
        times = BusTimes(980_000, 980_000, 1_000_000)
        verdict = done.verdict()
        assert verdict.faults == [FaultReport(words, ReceiptState.ACTIVATED, detail, bus=times)]
        (found,) = verdict.intervals
        assert (found.fdti_ms, found.fhti_ms, found.reaction) == (0.0, 20.0, Reaction.OPERATIONAL)
        assert verdict.checks["ftti"] == "pass"
        logs.append([line for line in (record / "bus.log").read_text().splitlines() if " 70" not in line])
    assert logs[0] == logs[1] and logs[0]


def test_the_end_counts_all_that_was_struck() -> None:
    done = aftbed("run", *DRIVE, "--inject", "duplicate bus EGO_STATE after 1s for 205ms")
    (found,) = done.verdict().faults
    assert found.receipt.value == "activated" and found.detail.startswith(
        "21 frames, the first at 1.000000 s"
    )


def test_a_silence_is_noticed_by_a_brake_that_falls_back(tmp_path: Path) -> None:
    """The result says when, and the state of the run is that of the simulated one."""
    words, record = "omission bus AEB_REQ after 1s for 100ms", tmp_path / "record"
    done = aftbed("run", *DRIVE, "--inject", words, "--record", record)
    (found,) = done.verdict().faults
    detail = "5 frames, the first at 1.000000 s, id 100; noticed by brake (fallback)"
    assert (found.receipt.value, found.detail) == ("activated", detail)
    car = done.verdict().vehicle
    assert car is not None and car.fallback_s == 1.011, "a cycle and a half after the last request"
    assert states_of(read_record(record)) == (RunState.FALLBACK,)


def test_a_fault_on_a_condition_in_real_time(tmp_path: Path) -> None:
    """It holds for as long as it says, by bus time. What the car comes to is up to the machine."""
    words, record = "bus-off gateway when gap < 15 for 100ms", tmp_path / "record"
    arguments = ("--pace", "4", "--json", "--record", record, "--inject", words)
    done = aftbed("run", "--scenario", "ccrs-20", *arguments)
    (found,) = done.verdict().faults
    assert found.receipt.value == "activated", done.out
    struck = re.match(r"\d+ frames, the first at ([0-9.]+) s", found.detail)
    assert struck is not None, found
    first_us = round(1e6 * float(struck[1]))
    frames, _ = read_log(record / "bus.log")
    intact_us = max(one.frame.t_us for one in frames if one.frame.t_us < first_us)
    sent_us = [one.frame.t_us for one in frames if one.frame.can_id == AEB_REQ_ID]
    assert min(t_us for t_us in sent_us if t_us > intact_us) - intact_us >= 100_000, found
    assert done.verdict().requests.answered == done.verdict().requests.sent > 0


def test_a_fault_that_never_strikes_proves_nothing() -> None:
    done = aftbed("run", *DRIVE, "--inject", "omission bus RADAR_TRACK nth 100000")
    assert done.code == 3
    assert [fault.receipt.value for fault in done.verdict().faults] in (["armed"], ["not_activated"])


def test_a_live_run_is_disturbed_from_a_second_command(home: Home) -> None:
    """The car slows down only by its brake: that has taken in requests then, and misses the next ones."""
    words = "omission bus AEB_REQ when speed < 13 for 100ms"
    with Started(home, CarRun("ccrs-50", 1.0, "latch")) as started:
        started.wait_for("started")
        done = aftbed("inject", "bus", words)
        assert done.code == 0, done.err
        assert words in done.err
        started.wait_for("fault", "activated")
        outcome = started.stop()
    (found,) = outcome.verdict.faults
    assert found.receipt.value == "activated", found
    assert "noticed by brake (" in found.detail, found  # the sign depends on who is late
    assert outcome.verdict.verdict == "pass"


def test_the_radar_sees_a_ghost_and_the_receipt_says_how_often() -> None:
    words = "radar ghost range 1.5 speed 2 after 1s for 200ms"
    done = aftbed("run", *DRIVE, "--inject", words)
    (found,) = done.verdict().faults
    detail = "10 tracks, the first at 1.000000 s; answered"
    assert (found.receipt.value, found.detail) == ("activated", detail), done.out + done.err


def test_a_radar_with_nothing_to_change_proves_nothing() -> None:
    done = aftbed("run", *DRIVE, "--inject", "radar fov range 150", "--inject", "radar missed after 1000s")
    assert done.code == 3, done.out
    assert [fault.receipt.value for fault in done.verdict().faults] == ["not_activated", "armed"]


def test_a_live_car_misses_its_target_for_a_second_command(home: Home) -> None:
    with Started(home, CarRun("ccrs-50", 1.0, "latch")) as started:
        started.wait_for("started")
        done = aftbed("inject", "radar", "missed", "for", "200ms")
        assert done.code == 0, done.err
        assert "radar missed for 200ms" in done.err
        started.wait_for("fault", "activated")
        outcome = started.stop()
    (found,) = outcome.verdict.faults
    assert (found.receipt.value, found.live) == ("activated", True)
    assert found.detail.endswith("; answered")


def test_a_load_has_no_bus() -> None:
    done = aftbed("run", "--load", "10", "--inject", "omission bus AEB_REQ")
    assert done.code == 2 and "a run of --load has no bus" in done.err
    with Command("--load", "100000@200") as command:
        command.started()
        live = aftbed("inject", "bus", "omission bus AEB_REQ")
        assert live.code == 2 and "a run of --load has no bus" in live.err
        blind = aftbed("inject", "radar", "missed")
        assert blind.code == 2 and "a run of --load has no radar; --scenario has one" in blind.err
        assert aftbed("stop").code == 0
        assert command.done().code == 0

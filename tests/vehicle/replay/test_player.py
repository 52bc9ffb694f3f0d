"""Replay onto a real bus: the log's own times, an answer for each cycle, honest counts."""

import time
from itertools import pairwise
from pathlib import Path

import pytest
from busharness import TestGateway, running_hub
from buslog import read_log

from aftbed.vehicle.can import bus as bus_module
from aftbed.vehicle.can.bus import open_bus
from aftbed.vehicle.can.dbc_file import Codec, load_dbc
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.can.hub import HubOptions
from aftbed.vehicle.replay.player import PlayReport, play

CYCLE_END_ID = 0x22F
START_US = 1_533_198_917_000_181


@pytest.fixture(scope="module")
def codec() -> Codec:
    return load_dbc()


def never() -> bool:
    return False


def log_of(cycles: int, cycle_us: int = 50_000) -> list[Frame]:
    """Three frames of the radar in a batch, and the speed between two batches."""
    entries = []
    for n in range(cycles):
        t_us, data = START_US + n * cycle_us, n.to_bytes(2, "big")
        entries += [Frame(t_us, can_id, data) for can_id in (0x210, 0x211, CYCLE_END_ID)]
        entries.append(Frame(t_us + cycle_us // 2, 0x0B4, data))
    return entries


class Stop:
    """Says stop after `count` questions."""

    def __init__(self, count: int) -> None:
        self.count = count

    def __call__(self) -> bool:
        self.count -= 1
        return self.count < 0


def run(
    log: Path,
    codec: Codec,
    entries: list[Frame],
    pace: float | None,
    answers: list[tuple[int, float] | None],
    stop: Stop | None = None,
    pause_us: int | None = None,
    until_us: int | None = None,
) -> PlayReport:
    """Play `entries` to a gateway that gives `answers` in turn, the last one for good."""
    with running_hub(log, HubOptions(lockstep=pace is None, pace=pace or 1.0)) as hub:
        given = iter(answers)
        last = answers[-1]
        with TestGateway(hub.options, codec, lambda _: next(given, last), track_id=CYCLE_END_ID):
            bus = open_bus(hub.options)
            try:
                return play(
                    entries,
                    codec,
                    bus,
                    pace,
                    ends_cycle=lambda frame: frame.can_id == CYCLE_END_ID,
                    stop=stop or never,
                    pause_us=pause_us,
                    until_us=until_us,
                )
            finally:
                bus.close()


def test_lockstep_follows_the_stamps_and_waits_for_each_answer(tmp_path: Path, codec: Codec) -> None:
    logs = [tmp_path / "1.log", tmp_path / "2.log"]
    entries = log_of(40)
    for log in logs:
        report = run(log, codec, entries, None, [(0, 0.0)])
        assert report == PlayReport(sent=160, cycles=40, answers=40, complete=True)
        assert not report.braked
    assert logs[0].read_bytes() == logs[1].read_bytes()
    played = [entry.frame for entry in read_log(logs[0])[0]]
    relayed = [frame for frame in played if frame.can_id not in (0x100, 0x701)]
    assert relayed == [Frame(entry.t_us - START_US, entry.can_id, entry.data) for entry in entries]
    for before, frame in pairwise(played):
        if frame.can_id == 0x100:  # at the time of the frame that it answers
            assert before.t_us == frame.t_us
            assert before.can_id in (CYCLE_END_ID, 0x701)


@pytest.mark.parametrize(
    ("answer", "stage_max", "braked"),
    [((1, 0.0), 1, False), ((2, 4.0), 2, True), ((3, 9.0), 3, True), ((1, 0.5), 1, True)],
)
def test_braking_is_noticed(
    answer: tuple[int, float], stage_max: int, braked: bool, tmp_path: Path, codec: Codec
) -> None:
    report = run(tmp_path / "bus.log", codec, log_of(5), None, [(0, 0.0), answer, (0, 0.0)])
    assert (report.stage_max, report.braked) == (stage_max, braked)
    assert report.deceleration_ms2_max == pytest.approx(answer[1])


def test_missing_answers_are_counted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, codec: Codec) -> None:
    monkeypatch.setattr(bus_module, "FIRST_ANSWER_S_MAX", 0.2)
    report = run(tmp_path / "bus.log", codec, log_of(10), None, [(0, 0.0), (0, 0.0), None])
    assert (report.cycles, report.answers, report.missing_answers, report.sent) == (10, 2, 8, 40)


def test_paced_play_keeps_the_times_of_the_log(tmp_path: Path, codec: Codec) -> None:
    entries = log_of(20)  # 0.975 s
    before_s = time.monotonic()
    report = run(tmp_path / "bus.log", codec, entries, 5.0, [(0, 0.0)])
    assert time.monotonic() - before_s >= 0.975 / 5
    assert (report.sent, report.answers, report.complete) == (80, 20, True)


@pytest.mark.parametrize("pace", [None, 1.0])
def test_play_can_be_stopped(pace: float | None, tmp_path: Path, codec: Codec) -> None:
    report = run(tmp_path / "bus.log", codec, log_of(10), pace, [(0, 0.0)], stop=Stop(3))
    assert not report.complete
    assert report.sent < 40


def test_a_log_is_played_again_and_again_until_its_time_is_over(tmp_path: Path, codec: Codec) -> None:
    """Two cycles, of which the last frame comes 75 ms after the first, and a pause of 25 ms."""
    given: dict[str, int] = {"pause_us": 25_000, "until_us": 250_001}
    report = run(tmp_path / "bus.log", codec, log_of(2), None, [(0, 0.0)], **given)
    assert (report.sent, report.cycles, report.answers, report.complete) == (8 + 8 + 7, 6, 6, True)
    times_us = [e.frame.t_us for e in read_log(tmp_path / "bus.log")[0] if e.frame.can_id == CYCLE_END_ID]
    assert times_us == [0, 50_000, 100_000, 150_000, 200_000, 250_000]


@pytest.mark.parametrize(("until_us", "sent"), [(0, 0), (1, 3), (25_001, 4), (10_000_000, 8)])
def test_a_log_is_played_until_its_time_is_over_or_it_ends(
    until_us: int, sent: int, tmp_path: Path, codec: Codec
) -> None:
    report = run(tmp_path / "bus.log", codec, log_of(2), None, [(0, 0.0)], until_us=until_us)
    assert (report.sent, report.complete) == (sent, True)


@pytest.mark.parametrize("pause_us", [None, 1000])
def test_an_empty_log_is_played(pause_us: int | None, tmp_path: Path, codec: Codec) -> None:
    played = run(tmp_path / "bus.log", codec, [], None, [(0, 0.0)], pause_us=pause_us)
    assert played == PlayReport(complete=True)

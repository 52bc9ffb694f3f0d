"""Replay: the frames of a log onto the bus, in the place of the car.

The frames of all interfaces of the log go to the one bus, in the order of the log; which of them the bus can
carry was found out before (`PlayedLog`). Bus time starts at 0 with the first of them and then follows the
log's stamps: on the wall clock when paced, or as the virtual time of the hub in lockstep (`pace` None). All
goes through one connection, so the hub takes times and frames in the order in which they are sent.

Only the caller knows which frame ends a radar cycle and so makes a request: most simply by a second gateway
that gets the same frames and decides as the first does. In lockstep time stands still after such a frame
until the AEB_REQ that answers it.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import takewhile

import msgspec

from aftbed.core.errors import PeerError
from aftbed.vehicle.aeb.messages import STAGE_PARTIAL
from aftbed.vehicle.can.bus import AnswerWatch, Bus, Schedule
from aftbed.vehicle.can.dbc_file import Codec
from aftbed.vehicle.can.frame import Frame


class LogReport(msgspec.Struct, frozen=True):
    """What a log held: the frames to play, and those left out, by reason.

    `skipped`: parts of the file that could not be read, the first of them where and why.
    """

    format: str
    frames: int
    left_out: dict[str, int]
    skipped: int
    first_skipped: str


class PlayedLog(msgspec.Struct, frozen=True):
    """Frames to play, in the order of time, by the clock of their log."""

    frames: tuple[Frame, ...]
    report: LogReport


class PlayReport(msgspec.Struct):
    """What was played, and what the function answered.

    `refused` frames were not taken by the hub. `missing_answers` of lockstep are the waits that were
    given up. `complete` is False when the caller's `stop` ended it.
    """

    sent: int = 0
    refused: int = 0
    cycles: int = 0
    answers: int = 0
    missing_answers: int = 0
    malformed_answers: int = 0
    stage_max: int = 0
    deceleration_ms2_max: float = 0.0
    lag_ms_max: float = 0.0
    complete: bool = False

    @property
    def braked(self) -> bool:
        return self.stage_max >= STAGE_PARTIAL or self.deceleration_ms2_max > 0.0


def play(
    log: Sequence[Frame],
    codec: Codec,
    bus: Bus,
    pace: float | None,
    *,
    ends_cycle: Callable[[Frame], bool],
    stop: Callable[[], bool],
    answered: Callable[[int, float], None] = lambda stage, deceleration_ms2: None,
    pause_us: int | None = None,
    until_us: int | None = None,
) -> PlayReport:
    """Play `log` to its end, or until `stop()`, which is asked before every frame.

    With a pause, it begins again that long behind its last frame, and so on. `until_us` of bus time, or
    without it the end of the log, is its end as asked for.

    `ends_cycle` is asked once for each frame, in order, with the bus time in the frame. `answered` is called
    with the stage and the deceleration of each answer. Raises HarnessError when the bus fails.
    """
    return _Player(codec, bus, pace, stop, answered).run(log, ends_cycle, pause_us, until_us)


class _Player:
    def __init__(
        self,
        codec: Codec,
        bus: Bus,
        pace: float | None,
        stop: Callable[[], bool],
        answered: Callable[[int, float], None],
    ) -> None:
        self._report = PlayReport()
        self._codec = codec
        self._bus = bus
        self._stop, self._answered = stop, answered
        self._schedule = None if pace is None else Schedule(pace)
        self._answer_id = codec.can_id("AEB_REQ")
        self._watch = AnswerWatch(bus, self._answer_id, self._receive)

    def run(
        self,
        log: Sequence[Frame],
        ends_cycle: Callable[[Frame], bool],
        pause_us: int | None,
        until_us: int | None,
    ) -> PlayReport:
        report, schedule = self._report, self._schedule
        frames = _in_bus_time(log, pause_us)
        if until_us is not None:
            frames = takewhile(lambda frame: frame.t_us < until_us, frames)
        report.complete = self._play(frames, ends_cycle)
        if report.complete and schedule is not None:
            self._watch.wait(self._stop)
        report.refused = self._bus.errors
        report.answers, report.missing_answers = self._watch.answered, self._watch.missing
        report.lag_ms_max = 0.0 if schedule is None else schedule.lag_ms_max
        return report

    def _play(self, frames: Iterator[Frame], ends_cycle: Callable[[Frame], bool]) -> bool:
        """True if all were sent."""
        last_us = -1
        for frame in frames:
            if self._schedule is not None:
                self._schedule.wait_until(frame.t_us, self._stop)
            elif frame.t_us != last_us:
                self._bus.set_time(frame.t_us)
            last_us = frame.t_us
            if self._stop():
                return False
            asks = ends_cycle(frame)
            if asks:
                self._report.cycles += 1
                self._watch.asked()
            self._bus.send(frame)
            self._report.sent += 1
            if asks and self._schedule is None:
                self._watch.wait(self._stop)
        return True

    def _receive(self, frame: Frame) -> None:
        if frame.can_id != self._answer_id:
            return
        report = self._report
        try:
            answer = self._codec.decode("AEB_REQ", frame.data)
        except PeerError:
            report.malformed_answers += 1
            return
        stage, deceleration_ms2 = int(answer["STAGE"]), answer["DECELERATION"]
        report.stage_max = max(report.stage_max, stage)
        report.deceleration_ms2_max = max(report.deceleration_ms2_max, deceleration_ms2)
        self._answered(stage, deceleration_ms2)


def _in_bus_time(log: Sequence[Frame], pause_us: int | None) -> Iterator[Frame]:
    """The frames of the log once, or with a pause again and again."""
    begins_us = 0
    while log:
        for frame in log:
            yield Frame(begins_us + frame.t_us - log[0].t_us, frame.can_id, frame.data)
        if pause_us is None:
            return
        begins_us += log[-1].t_us - log[0].t_us + pause_us

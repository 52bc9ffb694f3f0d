"""Replay: a candump log onto the bus, in the place of the car.

The frames of all interfaces of the log go to the one bus, in the order of the log. Bus time starts at
0 with the first of them and then follows the log's stamps: on the wall clock when paced, or as the
virtual time of the hub in lockstep (`pace` None). All goes through one connection, so the hub takes
times and frames in the order in which they are sent.

Only the caller knows which frame ends a radar cycle and so makes a request: most simply by a second gateway
that gets the same frames and decides as the first does. In lockstep time stands still after such a frame
until the AEB_REQ that answers it.
"""

from collections.abc import Callable, Sequence
from typing import Final

import msgspec

from aftbed.core.errors import PeerError
from aftbed.vehicle.can.bus import AnswerWatch, Bus, Schedule
from aftbed.vehicle.can.candump import LogFrame
from aftbed.vehicle.can.dbc_file import Codec
from aftbed.vehicle.can.frame import Frame

STAGE_PARTIAL: Final = 2


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
        """True if any answer asked the brakes for anything."""
        return self.stage_max >= STAGE_PARTIAL or self.deceleration_ms2_max > 0.0


def play(
    log: Sequence[LogFrame],
    codec: Codec,
    bus: Bus,
    pace: float | None,
    *,
    ends_cycle: Callable[[Frame], bool],
    stop: Callable[[], bool],
) -> PlayReport:
    """Play `log` to its end, or until `stop()`, which is asked before every frame.

    `ends_cycle` is asked once for each frame, in order, with the bus time in the frame. Raises
    HarnessError when the bus fails.
    """
    return _Player(codec, bus, pace).run(log, ends_cycle, stop)


class _Player:
    def __init__(self, codec: Codec, bus: Bus, pace: float | None) -> None:
        self._report = PlayReport()
        self._codec = codec
        self._bus = bus
        self._schedule = None if pace is None else Schedule(pace)
        self._t_us = -1
        self._answer_id = codec.can_id("AEB_REQ")
        self._watch = AnswerWatch(bus, self._answer_id, self._hear)

    def run(
        self, log: Sequence[LogFrame], ends_cycle: Callable[[Frame], bool], stop: Callable[[], bool]
    ) -> PlayReport:
        start_us = log[0].frame.t_us if log else 0
        for entry in log:
            frame = Frame(entry.frame.t_us - start_us, entry.frame.can_id, entry.frame.data)
            self._pass_time(frame.t_us, stop)
            if stop():
                return self._finished(complete=False)
            self._send(frame, ends_cycle(frame), stop)
        if self._schedule is not None:
            self._watch.wait(stop)
        return self._finished(complete=True)

    def _pass_time(self, t_us: int, stop: Callable[[], bool]) -> None:
        if self._schedule is not None:
            self._schedule.wait_until(t_us, stop)
        elif t_us != self._t_us:
            self._bus.set_time(t_us)
        self._t_us = t_us

    def _send(self, frame: Frame, asks: bool, stop: Callable[[], bool]) -> None:
        if asks:
            self._report.cycles += 1
            self._watch.asked()
        self._bus.send(frame)
        self._report.sent += 1
        if asks and self._schedule is None:
            self._watch.wait(stop)

    def _hear(self, frame: Frame) -> None:
        if frame.can_id != self._answer_id:
            return
        try:
            answer = self._codec.decode("AEB_REQ", frame.data)
        except PeerError:
            self._report.malformed_answers += 1
            return
        self._report.stage_max = max(self._report.stage_max, int(answer["STAGE"]))
        deceleration_ms2 = max(self._report.deceleration_ms2_max, answer["DECELERATION"])
        self._report.deceleration_ms2_max = deceleration_ms2

    def _finished(self, *, complete: bool) -> PlayReport:
        report = self._report
        report.complete = complete
        report.refused = self._bus.errors
        report.answers, report.missing_answers = self._watch.answered, self._watch.missing
        report.lag_ms_max = 0.0 if self._schedule is None else self._schedule.lag_ms_max
        return report

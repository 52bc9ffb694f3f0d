"""The vehicle process: the plant at 1 ms, and its two ECUs as two nodes on the CAN bus.

    radar ECU --RADAR_TRACK--> gateway --request--> the protected function
    brake ECU <---AEB_REQ----- gateway <---reply---
    brake ECU --BRAKE_STATUS, EGO_STATE--> gateway

In each step the brake ECU takes what has arrived, both ECUs send what is due, and the plant moves by
1 ms under the brakes: `body` has them, and the end of the drive; here is what carries their frames.

*Paced* (`pace` 1.0 is real time, N is N times faster): steps stand on a fixed schedule of the wall
clock. After a hiccup they are made up for, never skipped, so the car drives the same road however
loaded the machine is; only the answers come later.

*Lockstep* (`pace` None, "max"): virtual time, as fast as it goes. When frames are due, the hub is
given the time of the step; the brake ECU sends, and the radar sends only after it has seen those
frames, so the hub has them in this order; then time stands still until the AEB_REQ that answers the
RADAR_TRACK has come to the brake ECU. Nothing depends on the machine: the same seed gives the same
frames, byte for byte in the bus log. A function that does not answer is waited for 3 s once, then
shortly (`AnswerWatch`), and its misses are counted: a dead function does not hang the run.
"""

from collections.abc import Callable, Sequence

import msgspec

from aftbed.core.errors import HarnessError
from aftbed.vehicle.body import CarBody, End
from aftbed.vehicle.bus import (
    HUB_ANSWER_S_MAX,
    AnswerWatch,
    Bus,
    BusOptions,
    HubClock,
    Schedule,
    open_bus,
)
from aftbed.vehicle.dbcfile import Codec
from aftbed.vehicle.ecus import BrakePolicy
from aftbed.vehicle.frame import Frame
from aftbed.vehicle.report import Telemetry, VehicleResult
from aftbed.vehicle.scenario import Scenario


class DriveOptions(msgspec.Struct, frozen=True):
    """How to drive. `pace` None is lockstep."""

    pace: float | None = 1.0
    brake_policy: BrakePolicy = "latch"
    seed: int = 0


class DriveReport(msgspec.Struct, frozen=True):
    """A drive, to its end or as far as it came.

    `tracks` were sent and `answers` came back; `missing_answers` of lockstep are the waits that were
    given up. `lag_ms_max` is how late a paced step was at worst.
    """

    result: VehicleResult
    end: End
    t_us: int
    tracks: int
    answers: int
    missing_answers: int
    lag_ms_max: float


class CarBuses:
    """The car's attachments. When this exists they are complete: the drive may begin."""

    def __init__(self, options: BusOptions, *, lockstep: bool) -> None:
        self.clock = HubClock(options) if lockstep else None
        self.brake = open_bus(options)
        self.radar = open_bus(options)

    def close(self) -> None:
        """Leave the bus."""
        self.brake.close()
        self.radar.close()
        if self.clock is not None:
            self.clock.close()


def drive(
    scenario: Scenario,
    codec: Codec,
    buses: CarBuses,
    options: DriveOptions,
    *,
    report: Callable[[Telemetry], None],
    stop: Callable[[], bool],
) -> DriveReport:
    """Drive `scenario` to its end, or until `stop()`, which is asked at every step.

    `report` is called each 50 ms of bus time and at the end. Raises HarnessError when the bus fails.
    """
    return _Car(scenario, codec, buses, options).run(report, stop)


class _Car:
    def __init__(self, scenario: Scenario, codec: Codec, buses: CarBuses, options: DriveOptions) -> None:
        assert (options.pace is None) == (buses.clock is not None), "lockstep, or not?"
        self._options = options
        self._buses = buses
        self._body = CarBody(scenario, codec, options.brake_policy, options.seed)
        self._track_id = codec.can_id("RADAR_TRACK")
        self._tracks = 0
        self._lag_ms_max = 0.0
        self._watch = AnswerWatch(buses.brake, codec.can_id("AEB_REQ"), self._body.hear)

    def run(self, report: Callable[[Telemetry], None], stop: Callable[[], bool]) -> DriveReport:
        schedule = None if self._options.pace is None else Schedule(self._options.pace)
        while (end := self._ended(stop)) is None:
            if schedule is None:
                self._exchange_in_lockstep(stop)
            else:
                schedule.wait_until(self._body.t_us, stop)
                self._lag_ms_max = schedule.lag_ms_max
                self._exchange()
            self._body.step(report)
        report(self._body.telemetry())
        return self._report(end)

    def _ended(self, stop: Callable[[], bool]) -> End | None:
        return self._body.ended() or ("stopped" if stop() else None)

    # -- frames

    def _exchange(self) -> None:
        """Paced: take what has come, send what is due."""
        for frame in self._buses.brake.drain():
            self._watch.take(frame)
        for frame in self._body.brake_frames():
            self._buses.brake.send(frame)
        for frame in self._body.radar_frames():
            self._buses.radar.drain()  # it listens to nothing, but who does not read is put out
            self._buses.radar.send(frame)
            self._tracks += frame.can_id == self._track_id

    def _exchange_in_lockstep(self, stop: Callable[[], bool]) -> None:
        """Send what is due in an order that the hub cannot change, and wait for the answer."""
        brake_frames, radar_frames = self._body.brake_frames(), self._body.radar_frames()
        if not brake_frames and not radar_frames:
            return
        assert self._buses.clock is not None
        self._buses.clock.set_time(self._body.t_us)
        _send_and_see(brake_frames, self._buses.brake, self._buses.radar, _ignore)
        asks = any(frame.can_id == self._track_id for frame in radar_frames)
        if asks:
            self._watch.asked()
        _send_and_see(radar_frames, self._buses.radar, self._buses.brake, self._watch.take)
        if asks:
            self._tracks += 1
            self._watch.wait(stop)

    def _report(self, end: End) -> DriveReport:
        return DriveReport(
            result=self._body.result(),
            end=end,
            t_us=self._body.t_us,
            tracks=self._tracks,
            answers=self._watch.answered,
            missing_answers=self._watch.missing,
            lag_ms_max=self._lag_ms_max,
        )


def _ignore(_: Frame) -> None:
    """What a node does with frames that are not for it."""


def _send_and_see(
    frames: Sequence[Frame], sender: Bus, witness: Bus, take: Callable[[Frame], object]
) -> None:
    """Return when `witness` has seen all `frames`, so that the hub has; `take` gets all it sees."""
    for frame in frames:
        sender.send(frame)
    for frame in frames:
        seen = None
        while seen is None or (seen.can_id, seen.data) != (frame.can_id, frame.data):
            seen = witness.recv(HUB_ANSWER_S_MAX)
            if seen is None:
                raise HarnessError(f"the CAN hub did not relay {frame.can_id:#05x} in {HUB_ANSWER_S_MAX} s")
            take(seen)

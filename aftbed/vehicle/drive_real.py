"""The vehicle process: the plant at 1 ms, and its two ECUs as two nodes on the CAN bus.

    radar ECU --RADAR_TRACK--> gateway --request--> the protected function
    brake ECU <---AEB_REQ----- gateway <---reply---
    brake ECU --BRAKE_STATUS, EGO_STATE--> gateway

In each step the brake ECU takes what has arrived, both ECUs send what is due, and the plant moves by 1 ms
under the brakes (`ecus.CarBody`). This module carries their frames.

*Paced* (`pace` 1.0 is real time, N is N times faster): steps stand on a fixed schedule of the wall
clock. Late steps are made up for, never skipped, so the car drives the same road on a loaded machine; only
the answers come later.

*Lockstep* (`pace` None, "max"): virtual time, as fast as it goes. When frames are due, the hub is
given the time of the step; the brake ECU sends, and the radar sends only after those frames have been
over the wire, so they come in this order; then time stands still until the AEB_REQ that answers the
RADAR_TRACK has come to the brake ECU. Where the bus has faults, the hub sends what more or less there is
to wait for, and when a fault acts next by itself (`HubLine`). Nothing depends on the machine: the
same seed gives the same frames, byte for byte in the bus log. A function that does not answer is waited for
3 s once, then shortly (`AnswerWatch`), and its misses are counted: a dead function does not hang the run.

In both, the conditions at which faults open are checked in every step, before its frames are sent; and what
the brake ECU has found wrong with a frame is reported beside the bus.
"""

from collections.abc import Callable, Sequence

import msgspec

from aftbed.vehicle.can.bus import AnswerWatch, Bus, BusOptions, HubLine, Schedule, open_bus
from aftbed.vehicle.can.bus_model import NODES
from aftbed.vehicle.can.dbc_file import Codec
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.ecus import BrakePolicy, CarBody, End
from aftbed.vehicle.plant import Telemetry, VehicleResult
from aftbed.vehicle.radar import RadarDisturber
from aftbed.vehicle.scenarios.scenario import Scenario

RADAR, BRAKE, _ = NODES


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
    """The car's attachments to the bus, complete."""

    def __init__(self, options: BusOptions, follows: tuple[int, ...] = ()) -> None:
        """`follows` are the identifiers of the frames that the brake ECU follows."""
        self.line = HubLine(options)
        self.brake = open_bus(msgspec.structs.replace(options, node=BRAKE, uses=follows))
        self.radar = open_bus(msgspec.structs.replace(options, node=RADAR))

    def close(self) -> None:
        self.brake.close()
        self.radar.close()
        self.line.close()


def drive(
    scenario: Scenario,
    codec: Codec,
    buses: CarBuses,
    options: DriveOptions,
    *,
    report: Callable[[Telemetry], None],
    stop: Callable[[], bool],
    radar: RadarDisturber | None = None,
) -> DriveReport:
    """Drive `scenario` to its end, or until `stop()`, which is asked at every step.

    `report` is called each 50 ms of bus time and at the end. `radar` has the faults of the radar: they may be
    armed while `stop` is called. Raises HarnessError when the bus fails.
    """
    buses.line.request_conditions()  # those of faults that were armed since the car has attached, too
    return _Drive(scenario, codec, buses, options, stop, radar).run(report)


class _Drive:
    def __init__(
        self,
        scenario: Scenario,
        codec: Codec,
        buses: CarBuses,
        options: DriveOptions,
        stop: Callable[[], bool],
        radar: RadarDisturber | None,
    ) -> None:
        self._buses = buses
        self._body = CarBody(scenario, codec, options.brake_policy, options.seed)
        self._body.radar.disturber = radar
        self._schedule = None if options.pace is None else Schedule(options.pace)
        self._stop = stop
        self._track_id = codec.can_id("RADAR_TRACK")
        self._tracks = 0
        self._sent = {RADAR: 0, BRAKE: 0}
        line = buses.line if options.pace is None else None
        answer_id = codec.can_id("AEB_REQ")
        self._watch = AnswerWatch(buses.brake, answer_id, self._body.receive, self._track_id, line)

    def run(self, report: Callable[[Telemetry], None]) -> DriveReport:
        body, schedule = self._body, self._schedule
        while (end := body.ended() or ("stopped" if self._stop() else None)) is None:
            if schedule is None:
                self._exchange_in_lockstep()
            else:
                schedule.wait_until(body.plant.t_us, self._stop)
                self._exchange()
            body.step(report)
            for notice in body.noticed():
                self._buses.brake.notice(notice)
        report(body.telemetry())
        return DriveReport(
            result=body.result(),
            end=end,
            t_us=body.plant.t_us,
            tracks=self._tracks,
            answers=self._watch.answered,
            missing_answers=self._watch.missing,
            lag_ms_max=0.0 if schedule is None else schedule.lag_ms_max,
        )

    def _exchange(self) -> None:
        """Paced: take the frames that have come, send those that are due."""
        self._buses.line.changes()  # not used: time does not wait
        self._report_conditions()
        for frame in self._buses.brake.drain():
            self._watch.take(frame)
        for frame in self._body.brake_frames():
            self._buses.brake.send(frame)
        for frame in self._body.radar_frames():
            self._buses.radar.drain()  # not used, but the hub disconnects clients that do not read
            self._buses.radar.send(frame)
            self._tracks += frame.can_id == self._track_id

    def _report_conditions(self) -> None:
        """Report to the hub which conditions hold now."""
        line, t_us = self._buses.line, self._body.plant.t_us
        for number, condition in list(line.conditions.items()):
            if self._body.plant.holds(condition):
                if self._schedule is None:
                    line.set_time(t_us)
                line.met(number, t_us)

    def _exchange_in_lockstep(self) -> None:
        """Send the frames that are due in an order that the hub cannot change, and wait for the answer."""
        line, t_us = self._buses.line, self._body.plant.t_us
        if line.conditions:
            self._report_conditions()
        brake_frames, radar_frames = self._body.brake_frames(), self._body.radar_frames()
        due = line.due_us is not None and line.due_us <= t_us
        if not (brake_frames or radar_frames or due):
            return
        line.set_time(t_us)
        if due:
            self._watch.wait(self._stop)  # for the answers to frames that the hub had held back
        self._send(BRAKE, self._buses.brake, brake_frames)
        asks = any(frame.can_id == self._track_id for frame in radar_frames)
        if asks:
            self._watch.asked()
        self._send(RADAR, self._buses.radar, radar_frames)
        self._buses.radar.drain()
        self._tracks += asks
        if asks or line.disturbed:
            self._watch.wait(self._stop)

    def _send(self, node: str, bus: Bus, frames: Sequence[Frame]) -> None:
        """Return when all `frames` have been over the wire."""
        for frame in frames:
            bus.send(frame)
        if frames:
            self._sent[node] += len(frames)
            self._buses.line.carried(node, self._sent[node])

"""The radar ECU, the brake ECU, and the car that they are in, without a bus: frames in, frames out.

Time comes from the plant. The radar measures the plant's state with seeded noise and quantisation, as one
track. The brake ECU follows an AEB_REQ only if E2E accepts it; a request that is late or refused is bridged
with the last one for `HOLD_US`, after that a policy decides:

    hold     keep the last request until the next
    release  no braking without a request
    latch    (default) if the last request above standstill was for full braking, brake to standstill,
             whatever comes in the meantime except a full request; else release

Latch, because a car in emergency braking has, as far as is known, an obstacle ahead: a crash of the function
does not remove it. A weaker request does not end a latch, because a function that has lost its state answers
before it has measured the obstacle again.

Both ECUs are stepped once per millisecond of the plant. Frames due at the same instant come in arbitration
order, and RADAR_STATUS is kept 5 ms off the grid of the others: so RADAR_TRACK is the last frame of its
10 ms batch, and the request it makes has the EGO_STATE of the same instant.

`CarBody` is the plant with both ECUs. `drive_real` and `drive_virtual` carry its frames: the one over a real
bus, paced or in lockstep, the other inside one process. A step is, in both:

    brake_frames, radar_frames   what the ECUs have to send now, in this order
    receive                      what has arrived for the brake ECU
    step                         the brakes follow what was received, and the plant moves by 1 ms

A frame arrives, for an ECU, in the step that finds it. The drive ends one second after the car has come to
stand and stayed there, on contact, when it is as slow as the scenario says, or at the end of the scenario.
"""

from collections import deque
from collections.abc import Callable, Mapping
from enum import IntEnum
from random import Random
from typing import Final, Literal

import msgspec

from aftbed.vehicle.aeb.messages import STAGE_FULL, STAGE_WARN
from aftbed.vehicle.can.bus_model import FALLBACK, GOOD_AGAIN, Notice
from aftbed.vehicle.can.dbc_file import Codec
from aftbed.vehicle.can.e2e import P11, ChannelState, FrameStatus, Receiver, Supervision
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.plant import STEP_US, Plant, Telemetry, VehicleResult
from aftbed.vehicle.radar import RANGE_MAX_M, SPEED_MAX_MS, TRACK_ID, RadarDisturber, Target
from aftbed.vehicle.scenarios.scenario import Scenario, SlowEnd

BrakePolicy = Literal["hold", "release", "latch"]
BRAKE_POLICIES: Final[tuple[BrakePolicy, ...]] = ("hold", "release", "latch")

RANGE_NOISE_M: Final = 0.1  # half width of the noise, as for the two below
SPEED_NOISE_MS: Final = 0.1
LATERAL_NOISE_M: Final = 0.1
RADAR_STATUS_OFFSET_US: Final = 5000

HOLD_US: Final = 60_000
LATE_US: Final = 30_000  # one cycle and a half: from here on a request is missing
AEB_REQ_TIMEOUT_US: Final = 100_000
NOTICED_MAX: Final = 64


class Fallback(IntEnum):
    """FALLBACK in BRAKE_STATUS: why the brakes do not follow a fresh request."""

    NONE = 0
    HOLD = 1
    RELEASE = 2
    LATCH = 3


class Sender:
    """One cyclic, E2E protected message: when it is due, and its counter."""

    def __init__(self, codec: Codec, name: str, offset_us: int = 0) -> None:
        self._codec = codec
        self._name = name
        self._can_id = codec.can_id(name)
        self._protection = P11(codec.data_id(name))
        self._cycle_us = codec.cycle_us(name)
        self._offset_us = offset_us
        self._counter = 0

    def due(self, t_us: int) -> bool:
        """True if the message's cycle falls on `t_us`."""
        return t_us % self._cycle_us == self._offset_us

    def next_us(self, from_us: int) -> int:
        """The first time at or after `from_us` that is due."""
        return from_us + (self._offset_us - from_us) % self._cycle_us

    def frame(self, t_us: int, signals: Mapping[str, float]) -> Frame:
        """The next frame of this message; CRC and counter are filled in."""
        data = self._codec.encode(self._name, {"CRC": 0, "COUNTER": 0, **signals})
        data = self._protection.protect(data, self._counter)
        self._counter = (self._counter + 1) % P11.counter_count
        return Frame(t_us, self._can_id, data)


class RadarEcu:
    """RADAR_TRACK at 0, 20, 40 ms and so on; RADAR_STATUS at 5, 105, 205 ms and so on."""

    def __init__(self, codec: Codec, seed: int) -> None:
        self.track = Sender(codec, "RADAR_TRACK")
        self._status = Sender(codec, "RADAR_STATUS", RADAR_STATUS_OFFSET_US)
        self._random = Random(seed)
        self._track_id: int | None = None  # of the target in the last track; None: there was none
        self._cycle = 0
        self.disturber: RadarDisturber | None = None  # from the first fault on

    def frames(self, plant: Plant) -> list[Frame]:
        """The frames due at `plant.t_us`. To be called once for each plant step."""
        if self.disturber is not None:
            self.disturber.step(plant.t_us, _target(plant), plant.holds)
        if self.track.due(plant.t_us):
            self._cycle += 1
            return [self.track.frame(plant.t_us, self._measure(plant))]
        if self._status.due(plant.t_us):
            status = {"STATE": 1, "TRACKS": int(self._track_id is not None), "CYCLE": self._cycle % 0x10000}
            return [self._status.frame(plant.t_us, status)]
        return []

    def _measure(self, plant: Plant) -> dict[str, float]:
        """The signals of RADAR_TRACK; all 0 if there is no target."""
        noise = [self._noise(width) for width in (RANGE_NOISE_M, SPEED_NOISE_MS, LATERAL_NOISE_M)]
        target = _target(plant)
        if self.disturber is not None:
            target = _in_range(self.disturber.reported(plant.t_us, target))
        before, self._track_id = self._track_id, None if target is None else target.track_id
        range_m = relative_ms = lateral_m = 0.0
        if target is not None:
            range_m = max(0.0, target.range_m + noise[0])
            relative_ms = target.relative_ms + noise[1]
            lateral_m = target.lateral_m + noise[2]
        return {
            "VALID": int(target is not None),
            "NEW_TRACK": int(self._track_id not in (None, before)),
            "TRACK_ID": TRACK_ID if target is None else target.track_id,
            "RANGE": range_m,
            "RELATIVE_SPEED": max(-SPEED_MAX_MS, min(SPEED_MAX_MS, relative_ms)),
            "LATERAL_OFFSET": max(-10.0, min(10.0, lateral_m)),
        }

    def _noise(self, half_width: float) -> float:
        """Bell-shaped and bounded: four uniforms, and none of a platform's own log or cos."""
        return half_width * (sum(self._random.random() for _ in range(4)) - 2.0) / 2.0


def _target(plant: Plant) -> Target | None:
    """What the radar sees."""
    if plant.gap_m is None:
        return None
    return _in_range(Target(plant.gap_m, plant.lead_speed_ms - plant.speed_ms, plant.lateral_m))


def _in_range(target: Target | None) -> Target | None:
    return None if target is None or target.range_m > RANGE_MAX_M else target


class BrakeEcu:
    """Follows AEB_REQ; BRAKE_STATUS and EGO_STATE at 0, 10, 20 ms and so on."""

    def __init__(self, codec: Codec, policy: BrakePolicy) -> None:
        assert policy in BRAKE_POLICIES
        self.stage = 0
        self.fallback = Fallback.NONE
        self.accepted = 0
        self.refused = 0
        self.noticed: deque[Notice] = deque(maxlen=NOTICED_MAX)
        self._objected = self._good_again = False
        self._codec = codec
        self._policy = policy
        self._aeb_req_id = codec.can_id("AEB_REQ")
        self._receiver = Receiver(
            Supervision(P11(codec.data_id("AEB_REQ")), codec.cycle_us("AEB_REQ"), AEB_REQ_TIMEOUT_US)
        )
        self._status = Sender(codec, "BRAKE_STATUS")
        self._ego = Sender(codec, "EGO_STATE")
        self._request: dict[str, float] | None = None  # the last one accepted
        self._request_us = 0
        self._demand_ms2 = 0.0

    def on_frame(self, frame: Frame) -> None:
        """Take any frame off the bus; `frame.t_us` is when it arrived. Ignores all but AEB_REQ."""
        if frame.can_id != self._aeb_req_id:
            return
        first = self._receiver.state is ChannelState.NODATA
        status = self._receiver.check(frame.data, frame.t_us)
        if status is not FrameStatus.OK and not (first and status is FrameStatus.WRONGSEQUENCE):
            self._object(status.name.lower(), frame.t_us)
        if not self._receiver.usable(status):
            self.refused += 1
            return
        self.accepted += 1
        self._good_again = self._objected
        self._request, self._request_us = self._codec.decode("AEB_REQ", frame.data), frame.t_us

    def demand_ms2(self, plant: Plant) -> float:
        """The demand on the brakes in this step: m/s2, 0 or more. Call once per plant step."""
        if self._request is None:
            return 0.0
        self._receiver.poll(plant.t_us)
        before, self.fallback = self.fallback, self._choose(plant, self._request)
        if self.fallback is not before and self.fallback is not Fallback.NONE:
            self._object(FALLBACK, plant.t_us)
        elif self._good_again and self.fallback is Fallback.NONE:  # after a latch, only when that ends
            self._objected = self._good_again = False
            self.noticed.append(Notice(self._aeb_req_id, GOOD_AGAIN, plant.t_us))
        if self.fallback is Fallback.RELEASE:
            self.stage, self._demand_ms2 = 0, 0.0
        elif self.fallback is not Fallback.LATCH:  # a latch keeps the stage and demand that it began with
            self.stage, self._demand_ms2 = int(self._request["STAGE"]), self._request["DECELERATION"]
        return self._demand_ms2

    def frames(self, plant: Plant) -> list[Frame]:
        """The frames due at `plant.t_us`, in arbitration order. Call once for each plant step."""
        t_us = plant.t_us
        if not self._status.due(t_us):
            return []
        status = {
            "STAGE_APPLIED": self.stage,
            "FALLBACK": int(self.fallback),
            "DECELERATION_ACTUAL": max(0.0, min(20.0, -plant.acceleration_ms2)),
            "DECELERATION_DEMANDED": self._demand_ms2,
            "SEQUENCE_FOLLOWED": self._request["SEQUENCE"] if self._request else 0,
        }
        ego = {
            "SPEED_VALID": 1,
            "SPEED": min(65.535, plant.speed_ms),
            "ACCELERATION": max(-20.0, min(20.0, plant.acceleration_ms2)),
        }
        return [self._status.frame(t_us, status), self._ego.frame(t_us, ego)]

    def _object(self, word: str, t_us: int) -> None:
        """To the requests that come, or do not."""
        self._objected = True
        self._good_again = self._good_again and word != FALLBACK
        self.noticed.append(Notice(self._aeb_req_id, word, t_us))

    def _choose(self, plant: Plant, request: dict[str, float]) -> Fallback:
        """Fresh request, bridge, or policy."""
        age_us = plant.t_us - self._request_us
        full = request["STAGE"] == STAGE_FULL
        if self.fallback is Fallback.LATCH and not plant.stopped() and not (full and age_us <= LATE_US):
            return Fallback.LATCH
        if age_us <= HOLD_US:
            return Fallback.NONE if age_us <= LATE_US else Fallback.HOLD
        if self._policy == "hold":
            return Fallback.HOLD
        if self._policy == "latch" and full and (self.fallback is Fallback.LATCH or not plant.stopped()):
            return Fallback.LATCH
        return Fallback.RELEASE


STANDSTILL_US: Final = 1_000_000  # the brakes' dead time and lag are ten times shorter
TELEMETRY_US: Final = 50_000

End = Literal["standstill", "slow", "collision", "duration", "stopped"]


class CarBody:
    """The car of `scenario` at its start. `seed` is the noise of its radar."""

    def __init__(self, scenario: Scenario, codec: Codec, policy: BrakePolicy, seed: int) -> None:
        self.duration_us = scenario.duration_ms * 1000
        self._slow_end = scenario.slow_end
        self._slow_us: int | None = None  # when `_slow_end` ends the drive
        self.plant = Plant(scenario.plant)
        self.radar = RadarEcu(codec, seed)
        self._brake = BrakeEcu(codec, policy)
        self._still_us = 0
        self._demand_max_ms2 = 0.0
        self._fallback_us: int | None = None
        self._warned_us: int | None = None
        self._braked_us: int | None = None  # by the function

    def ended(self) -> End | None:
        """Why the drive is over, None while it is not; "stopped" is left to `drive_real`."""
        if self.plant.collided:
            return "collision"
        if self._still_us >= STANDSTILL_US:
            return "standstill"
        if self._slow_us is not None and self.plant.t_us >= self._slow_us:
            return "slow"
        return "duration" if self.plant.t_us >= self.duration_us else None

    def brake_frames(self) -> list[Frame]:
        """Call once for each step, before `radar_frames`."""
        return self._brake.frames(self.plant)

    def radar_frames(self) -> list[Frame]:
        return self.radar.frames(self.plant)

    def receive(self, frame: Frame) -> None:
        """A frame has come to the brake ECU, which takes it as of this step."""
        accepted = self._brake.accepted
        self._brake.on_frame(Frame(self.plant.t_us, frame.can_id, frame.data))
        if self.radar.disturber is not None and self._brake.accepted > accepted:
            self.radar.disturber.answered()

    def noticed(self) -> list[Notice]:
        """What the brake ECU has found since the last call."""
        found = list(self._brake.noticed)
        self._brake.noticed.clear()
        return found

    def step(self, report: Callable[[Telemetry], None] | None = None) -> None:
        """Advance by 1 ms. `report` is called each 50 ms, after the brake ECU has decided."""
        plant, brake = self.plant, self._brake
        demand_ms2 = brake.demand_ms2(plant)
        if self._fallback_us is None and brake.fallback is not Fallback.NONE:
            self._fallback_us = plant.t_us
        if report is not None and plant.t_us % TELEMETRY_US == 0:
            report(self.telemetry())
        if self._warned_us is None and brake.stage >= STAGE_WARN:
            self._warned_us = plant.t_us
        if demand_ms2 > self._demand_max_ms2:
            self._demand_max_ms2 = demand_ms2
            if self._braked_us is None:
                self._braked_us = plant.t_us
        driver, warned_us = plant.setup.driver, self._warned_us
        if driver and warned_us is not None and plant.t_us - warned_us >= driver.reaction_ms * 1000:
            demand_ms2 = max(demand_ms2, driver.deceleration_ms2)
        plant.step(demand_ms2)
        self._still_us = self._still_us + STEP_US if plant.stopped() else 0
        if self._slow_end is not None and self._slow_us is None and self._is_slow(self._slow_end):
            self._slow_us = plant.t_us + self._slow_end.after_ms * 1000

    def _is_slow(self, end: SlowEnd) -> bool:
        speed_ms = self.plant.speed_ms
        if end.below_ms is not None and speed_ms < end.below_ms:
            return True
        return end.below_lead_ms is not None and speed_ms < self.plant.lead_speed_ms - end.below_lead_ms

    def telemetry(self) -> Telemetry:
        plant, brake = self.plant, self._brake
        return Telemetry(
            t_ms=plant.t_us // 1000,
            speed_ms=plant.speed_ms,
            gap_m=plant.gap_m,
            ttc_s=plant.ttc_s(),
            stage=brake.stage,
            deceleration_ms2=max(0.0, -plant.acceleration_ms2),
            fallback=brake.fallback,
            frames_accepted=brake.accepted,
            frames_refused=brake.refused,
        )

    def result(self) -> VehicleResult:
        warning_s = None
        if self._braked_us is not None and self._warned_us is not None:
            warning_s = (self._braked_us - self._warned_us) / 1e6
        return msgspec.structs.replace(
            self.plant.result(),
            warning_s=warning_s,
            demand_max_ms2=self._demand_max_ms2,
            fallback_s=None if self._fallback_us is None else self._fallback_us / 1e6,
        )

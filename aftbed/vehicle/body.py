"""The car without its bus: the plant, its two ECUs, and when the drive is over.

Two drive it: `car` on a real bus, paced or in lockstep, and `virtual` inside one process. What a step is,
both have from here:

    frames  what the ECUs have to send now, brake ECU first
    hear    what has arrived for the brake ECU
    step    the brakes follow what was heard, and the plant moves by 1 ms

A frame arrives, for an ECU, in the step that finds it. When frames are carried, and by what, is for the
one who drives.

The drive ends one second after the car has come to stand and stayed there, on contact, or at the end
of the scenario.
"""

from collections.abc import Callable
from typing import Final, Literal

import msgspec

from aftbed.core.busfault import Condition
from aftbed.vehicle.aebmessages import STAGE_WARN
from aftbed.vehicle.dbcfile import Codec
from aftbed.vehicle.ecus import BrakeEcu, BrakePolicy, RadarEcu
from aftbed.vehicle.frame import Frame
from aftbed.vehicle.plant import STEP_US, Driver, Plant
from aftbed.vehicle.report import Telemetry, VehicleResult
from aftbed.vehicle.scenario import Scenario

STANDSTILL_US: Final = 1_000_000  # the brakes' dead time and lag are ten times shorter
TELEMETRY_US: Final = 50_000

End = Literal["standstill", "collision", "duration", "stopped"]


class CarBody:
    """The car of `scenario` at its start. `seed` is the noise of its radar."""

    def __init__(self, scenario: Scenario, codec: Codec, policy: BrakePolicy, seed: int) -> None:
        self.duration_us = scenario.duration_ms * 1000
        self._plant = Plant(scenario.plant)
        self._brake = BrakeEcu(codec, policy)
        self._radar = RadarEcu(codec, seed)
        self._still_us = 0
        self._demand_max_ms2 = 0.0
        self._warned_us: int | None = None
        self._braked_us: int | None = None  # by the function

    @property
    def t_us(self) -> int:
        """Microseconds of bus time since the start, a multiple of 1 ms."""
        return self._plant.t_us

    def ended(self) -> End | None:
        """Why the drive is over, None while it is not; "stopped" is for the driver to say."""
        if self._plant.collided:
            return "collision"
        if self._still_us >= STANDSTILL_US:
            return "standstill"
        return "duration" if self._plant.t_us >= self.duration_us else None

    def track_due_us(self, from_us: int) -> int:
        """The bus time of the first RADAR_TRACK at or after `from_us`."""
        return self._radar.track_due_us(from_us)

    def brake_frames(self) -> list[Frame]:
        """What the brake ECU has to send. Call once for each step."""
        return self._brake.frames(self._plant)

    def radar_frames(self) -> list[Frame]:
        """What the radar ECU has to send, after the brake ECU. Call once for each step."""
        return self._radar.frames(self._plant)

    def hear(self, frame: Frame) -> None:
        """A frame has come to the brake ECU, which takes it to be of this step."""
        self._brake.on_frame(Frame(self._plant.t_us, frame.can_id, frame.data))

    def noticed(self) -> list[tuple[int, str]]:
        """What the brake ECU has found wrong since it was last asked: of which frames, and what."""
        found = list(self._brake.noticed)
        self._brake.noticed.clear()
        return found

    def is_so(self, condition: Condition) -> bool:
        """Whether `condition` holds in this instant."""
        return condition.holds(self._plant.ttc_s(), self._plant.gap_m, self._plant.speed_ms)

    def step(self, report: Callable[[Telemetry], None] | None = None) -> None:
        """Go on by 1 ms. `report` is called each 50 ms, with what the brakes have decided here."""
        demand_ms2 = self._brake.demand_ms2(self._plant)
        if report is not None and self._plant.t_us % TELEMETRY_US == 0:
            report(self.telemetry())
        if demand_ms2 > self._demand_max_ms2 or self._warned_us is None:
            self._heed(demand_ms2)
        driver = self._plant.setup.driver
        self._plant.step(demand_ms2 if driver is None else max(demand_ms2, self._pedal_ms2(driver)))
        self._still_us = self._still_us + STEP_US if self._plant.stopped() else 0

    def telemetry(self) -> Telemetry:
        """The car at this instant."""
        plant, brake = self._plant, self._brake
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
        """What the drive came to, so far."""
        warning_s = None
        if self._braked_us is not None and self._warned_us is not None:
            warning_s = (self._braked_us - self._warned_us) / 1e6
        return msgspec.structs.replace(
            self._plant.result(),
            warning_s=warning_s,
            demand_max_ms2=self._demand_max_ms2,
        )

    def _heed(self, demand_ms2: float) -> None:
        """Note what is asked of the brakes now, where it is the first or the most of its kind."""
        if self._warned_us is None and self._brake.stage >= STAGE_WARN:
            self._warned_us = self._plant.t_us
        if self._braked_us is None and demand_ms2 > 0.0:
            self._braked_us = self._plant.t_us
        self._demand_max_ms2 = max(self._demand_max_ms2, demand_ms2)

    def _pedal_ms2(self, driver: Driver) -> float:
        """What the driver asks of the brakes, who has been warned, or not."""
        if self._warned_us is None or self._plant.t_us - self._warned_us < driver.reaction_ms * 1000:
            return 0.0
        return driver.deceleration_ms2

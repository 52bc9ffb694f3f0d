"""The longitudinal motion of the ego car and the car ahead, in fixed steps of 1 ms.

The ego's brakes do nothing for a dead time, then approach the demand as a first-order lag. They give no
more than their own limit, and no tyre gives more than friction times gravity. The driver holds the speed
until the first demand, then releases the accelerator for good: drag and rolling resistance act from there
on. The car ahead stands, drives at constant speed, brakes with a linear ramp, or goes from one speed
to another. It is in our lane, or beside it, or comes into it from the side.

Contact is interpolated inside the step in which the gap closes, so the impact speed does not depend on
the step. After contact the drive is over and nothing moves any more. A car beside us is passed, not hit:
from there on the road is empty. Gaps count only while the car ahead is in our way. Only + - * / on
doubles: the same drive on every machine, bit for bit.

The plant is the only source of `VehicleResult` and `Telemetry`: nothing in them comes off the bus, so a
frame fault cannot make a collision look like a stop. Warning, demand and fallback in them are those of the
brake ECU, from the frames that it accepted.

Limits: the ego keeps its lane; one target, no road gradient, no load transfer, no ABS dynamics.
"""

from collections import deque
from typing import Final

import msgspec

from aftbed.vehicle.condition import Condition


class VehicleResult(msgspec.Struct, frozen=True):
    """A whole drive. `min_gap_m` and `stop_gap_m` are None without a target or without a stop.

    `warning_s` is the time from the first warning to the function's first demand for braking, however small:
    UN R152 calls every such demand emergency braking. 0.0 if the two came together, None without braking.
    `demand_max_ms2` is the greatest demand. `fallback_s` is when the brakes first had no fresh request to
    follow, in bus time since the start; None if they always had one. `braked` is true also when the driver
    has braked after the warning.
    """

    collision: bool
    impact_speed_kmh: float | None
    min_gap_m: float | None
    stop_gap_m: float | None
    max_deceleration_ms2: float
    braked: bool
    warning_s: float | None = None
    demand_max_ms2: float = 0.0
    fallback_s: float | None = None


class Telemetry(msgspec.Struct, frozen=True):
    """One instant of the drive, for the live view. `stage` is the stage that the brakes follow."""

    t_ms: int
    speed_ms: float
    gap_m: float | None
    ttc_s: float | None
    stage: int
    deceleration_ms2: float
    fallback: int
    frames_accepted: int
    frames_refused: int


STEP_US: Final = 1000
GRAVITY_MS2: Final = 9.81
KMH_PER_MS: Final = 3.6
DEAD_TIME_MS: Final = 100  # hydraulics build no pressure yet
LAG_MS: Final = 100
ROLLING_MS2: Final = 0.12  # rolling resistance of a passenger car, 0.012 g
DRAG_PER_M: Final = 0.000_27  # 0.5 rho cd A / m, for 0.66 m2 and 1500 kg
IN_THE_WAY_M: Final = 1.8  # from middle to middle: two cars of this width, side by side, touch


class LeadBraking(msgspec.Struct, frozen=True):
    """The car ahead brakes to `final_ms` from `after_ms` on, reaching `deceleration_ms2` after `ramp_ms`."""

    after_ms: int
    deceleration_ms2: float
    ramp_ms: int = 0
    final_ms: float = 0.0  # at most its speed at the start


class LeadSpeed(msgspec.Struct, frozen=True):
    """The car ahead goes to `final_ms` at `rate_ms2`, up or down, from `after_ms` on."""

    after_ms: int
    final_ms: float
    rate_ms2: float


class CutIn(msgspec.Struct, frozen=True):
    """The car ahead comes to the middle of our lane, from `after_ms` on, in `over_ms`, evenly."""

    after_ms: int
    over_ms: int


class LeadCar(msgspec.Struct, frozen=True):
    """The car ahead at the start of the drive; `lateral_m` is to the left of the middle of our lane.

    `speeds` are in the order of their times, instead of a `braking`; each lasts until the next begins.
    """

    gap_m: float
    speed_ms: float = 0.0
    braking: LeadBraking | None = None
    lateral_m: float = 0.0
    cut_in: CutIn | None = None
    speeds: tuple[LeadSpeed, ...] = ()


class Brakes(msgspec.Struct, frozen=True):
    """What the ego's brakes can. None is no limit: of the jerk but the lag, of the rest but the tyres."""

    dead_time_ms: int = DEAD_TIME_MS
    lag_ms: int = LAG_MS
    jerk_max_ms3: float | None = None
    deceleration_max_ms2: float | None = None


class Driver(msgspec.Struct, frozen=True):
    """Brakes by so much, so long after the warning: the robot of Euro NCAP's tests of warnings."""

    reaction_ms: int
    deceleration_ms2: float


class PlantSetup(msgspec.Struct, frozen=True):
    """The start of a drive. `lead` None is an empty road, `driver` None a driver that ignores the warning."""

    speed_ms: float
    lead: LeadCar | None = None
    friction: float = 0.9
    brakes: Brakes = Brakes()
    driver: Driver | None = None


class Plant:
    """The state of both cars at `t_us`, microseconds of bus time since the start.

    `step_us` is for tests of the influence of the step: all other plants have `STEP_US`.
    """

    def __init__(self, setup: PlantSetup, step_us: int = STEP_US) -> None:
        lead, brakes = setup.lead, setup.brakes
        self.setup = setup
        self.t_us = 0
        self.speed_ms = setup.speed_ms
        self.acceleration_ms2 = 0.0
        self.lead_speed_ms = lead.speed_ms if lead else 0.0
        self.lateral_m = lead.lateral_m if lead else 0.0
        self.gap_m = lead.gap_m if lead else None
        self.collided = False
        self._step_us, self._step_s = step_us, step_us / 1e6
        self._brake_ms2 = 0.0
        self._brake_most_ms2 = setup.friction * GRAVITY_MS2
        if brakes.deceleration_max_ms2 is not None:
            self._brake_most_ms2 = min(self._brake_most_ms2, brakes.deceleration_max_ms2)
        self._gain = min(1.0, self._step_s / (brakes.lag_ms / 1000)) if brakes.lag_ms else 1.0
        delay = brakes.dead_time_ms * 1000 // step_us
        self._pipe = deque([0.0] * (delay + 1), maxlen=delay + 1)
        self._braked = False
        self._impact_speed_ms: float | None = None
        self._min_gap_m = self.gap_m if self._in_the_way() else None
        self._stop_gap_m: float | None = None
        self._max_deceleration_ms2 = 0.0

    def step(self, demand_ms2: float) -> None:
        """Advance by one step with `demand_ms2` demanded of the brakes: m/s2, 0 or more."""
        assert demand_ms2 >= 0.0
        self.t_us += self._step_us
        if self.collided:
            return
        self._braked = self._braked or demand_ms2 > 0.0
        closing_before_ms = self.speed_ms - self.lead_speed_ms
        ego_m = self._move_ego(demand_ms2)
        if self.gap_m is not None:
            self._move_gap(self.gap_m, self._move_lead() - ego_m, closing_before_ms)
        if self.speed_ms == 0.0 and self._stop_gap_m is None and not self.collided:
            self._stop_gap_m = self.gap_m if self._in_the_way() else None

    def stopped(self) -> bool:
        """True when the ego stands still, or the drive has ended in a collision."""
        return self.collided or self.speed_ms == 0.0

    def ttc_s(self) -> float | None:
        """Seconds to contact at the present speeds; None if the gap is not closing."""
        closing_ms = self.speed_ms - self.lead_speed_ms
        return None if self.gap_m is None or closing_ms <= 0.0 else self.gap_m / closing_ms

    def holds(self, condition: Condition) -> bool:
        return condition.holds(self.ttc_s(), self.gap_m, self.speed_ms)

    def result(self) -> VehicleResult:
        impact_ms = self._impact_speed_ms
        return VehicleResult(
            collision=self.collided,
            impact_speed_kmh=None if impact_ms is None else impact_ms * KMH_PER_MS,
            min_gap_m=self._min_gap_m,
            stop_gap_m=self._stop_gap_m,
            max_deceleration_ms2=self._max_deceleration_ms2,
            braked=self._braked,
        )

    def _in_the_way(self) -> bool:
        return -IN_THE_WAY_M < self.lateral_m < IN_THE_WAY_M

    def _move_ego(self, demand_ms2: float) -> float:
        """Metres that the ego moves in this step: dead time, lag, jerk limit, tyres; then resistance."""
        self._pipe.append(demand_ms2)  # the oldest one leaves by itself
        change_ms2 = (min(self._pipe[0], self._brake_most_ms2) - self._brake_ms2) * self._gain
        jerk_max_ms3 = self.setup.brakes.jerk_max_ms3
        if jerk_max_ms3 is not None:
            limit_ms2 = jerk_max_ms3 * self._step_s
            change_ms2 = max(-limit_ms2, min(limit_ms2, change_ms2))
        self._brake_ms2 += change_ms2
        before_ms = self.speed_ms
        resistance_ms2 = ROLLING_MS2 + DRAG_PER_M * before_ms * before_ms if self._braked else 0.0
        self.speed_ms = max(0.0, before_ms - (self._brake_ms2 + resistance_ms2) * self._step_s)
        self.acceleration_ms2 = (self.speed_ms - before_ms) / self._step_s
        self._max_deceleration_ms2 = max(self._max_deceleration_ms2, -self.acceleration_ms2)
        return (before_ms + self.speed_ms) / 2.0 * self._step_s

    def _move_lead(self) -> float:
        """Metres that the car ahead moves in this step, along the lane. A cut-in is even."""
        lead, t_ms = self.setup.lead, self.t_us / 1000
        assert lead is not None
        if lead.cut_in is not None:
            left_ms = lead.cut_in.after_ms + lead.cut_in.over_ms - t_ms
            if left_ms <= 0.0:
                self.lateral_m = 0.0
            elif left_ms < lead.cut_in.over_ms:
                self.lateral_m = lead.lateral_m * (left_ms / lead.cut_in.over_ms)
        deceleration_ms2 = final_ms = 0.0
        if lead.braking is not None and (since_ms := t_ms - lead.braking.after_ms) > 0.0:
            deceleration_ms2, final_ms = lead.braking.deceleration_ms2, lead.braking.final_ms
            if since_ms < lead.braking.ramp_ms:
                deceleration_ms2 = deceleration_ms2 * since_ms / lead.braking.ramp_ms
        before_ms = self.lead_speed_ms
        self.lead_speed_ms = max(final_ms, before_ms - deceleration_ms2 * self._step_s)
        if lead.speeds:
            self._change_lead_speed(lead.speeds, t_ms)
        return (before_ms + self.lead_speed_ms) / 2.0 * self._step_s

    def _change_lead_speed(self, speeds: tuple[LeadSpeed, ...], t_ms: float) -> None:
        """Bring the car ahead closer to the speed of the last change that has begun."""
        begun = [change for change in speeds if t_ms > change.after_ms]
        if begun:
            final_ms, step_ms = begun[-1].final_ms, begun[-1].rate_ms2 * self._step_s
            if self.lead_speed_ms < final_ms:
                self.lead_speed_ms = min(final_ms, self.lead_speed_ms + step_ms)
            else:
                self.lead_speed_ms = max(final_ms, self.lead_speed_ms - step_ms)

    def _move_gap(self, before_m: float, change_m: float, closing_before_ms: float) -> None:
        """Change the gap; find contact inside the step."""
        after_m = before_m + change_m
        if not self._in_the_way():
            self.gap_m = after_m if after_m > 0.0 else None  # None: passed
            return
        if after_m <= 0.0 < before_m:
            part = before_m / (before_m - after_m)
            closing_ms = self.speed_ms - self.lead_speed_ms
            self._impact_speed_ms = closing_before_ms + part * (closing_ms - closing_before_ms)
            self.collided, after_m = True, 0.0
            self.speed_ms = self.lead_speed_ms = self.acceleration_ms2 = 0.0
        self.gap_m = after_m
        if self._min_gap_m is None or after_m < self._min_gap_m:
            self._min_gap_m = after_m
